"""Episodes played by the fused driver, and their conversion to the steps that SB3's callbacks expect."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_uav.common import distributed
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.policies.extractor import Cache


class EpisodeBatch(NamedTuple):
    """
    Complete episodes on which the next update is computed.

    :param instances: ``batch`` instances, those of this process
    :param cache: The encodings of the instances, with gradients; None if each micro-batch is to be encoded by itself
    :param actions: ``(batch, n_samples, n_steps)`` int64
    :param returns: ``(batch, n_samples)`` float64
    :param baseline: Baseline values, float64, broadcastable against ``returns``
    :param micro_batch_size: Number of instances whose gradients are computed at once; all when None
    :param shared: Number of instances of the update in all processes; those of this one when None
    :param n_steps: Number of steps of the episodes of all processes, padding left out; None where it is not needed
    """

    instances: Instances
    cache: Cache | None
    actions: th.Tensor
    returns: th.Tensor
    baseline: th.Tensor
    micro_batch_size: int | None = None
    shared: int | None = None
    n_steps: float | None = None

    @property
    def n_instances(self) -> int:
        """Instances of the update in all processes."""
        return len(self.instances) if self.shared is None else self.shared

    @property
    def rows(self) -> slice:
        """Which of them are those of this process."""
        return distributed.shard(self.n_instances)

    @property
    def weight(self) -> float:
        """The part that this process contributes to a mean over the instances of all."""
        # Where there are fewer instances than processes, each process has all of them.
        n_all = (
            distributed.world_size() * len(self.instances)
            if self.rows.stop - self.rows.start == self.n_instances
            else self.n_instances
        )
        return len(self.instances) / n_all

    def micro_batches(self) -> list[EpisodeBatch]:
        """:return: The parts whose gradients are computed one after the other; the batch itself if there is one"""
        size = self.micro_batch_size
        if size is None or size >= len(self.instances):
            return [self]
        baseline = self.baseline.expand(len(self.instances), -1)
        return [
            EpisodeBatch(
                self.instances[rows],
                None if self.cache is None else self.cache.rows(rows),
                self.actions[rows],
                self.returns[rows],
                baseline[rows],
            )
            for rows in th.arange(len(self.instances), device=self.actions.device).split(size)
        ]

    def rewards_to_go(self, problem: Problem) -> th.Tensor:
        """
        :param problem: The problem that was played
        :return: ``(batch, n_samples, n_steps)`` float32, the sum of the rewards from each step to the end of the episode
        """
        collected = problem.step_rewards(self.instances, self.actions, self.returns)
        return collected.flip(-1).cumsum(-1).flip(-1).float()


class PlayedEpisodes(NamedTuple):
    """
    Results of one complete episode per instance.

    :param returns: ``(batch,)`` float64
    :param lengths: ``(batch,)`` int64, lengths in environment steps
    :param successes: ``(batch,)`` bool, ``is_success`` of the episodes; None where it is undefined
    """

    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None = None


def episodes_by_sample(problem: Problem, instances: Instances, actions: th.Tensor, returns: th.Tensor) -> list[PlayedEpisodes]:
    """
    :param problem: The problem that was played
    :param instances: ``batch`` instances
    :param actions: ``(batch, n_samples, n_steps)`` int64
    :param returns: ``(batch, n_samples)`` float64
    :return: The results of each of the ``n_samples``
    """
    fields = [returns, problem.lengths(instances, actions), problem.successes(instances, returns)]
    columns = [[None] * returns.shape[1] if field is None else field.T.cpu().numpy() for field in fields]
    return [PlayedEpisodes(*sample) for sample in zip(*columns, strict=True)]


class Step(NamedTuple):
    """
    One step of ``batch`` environments in the form of a ``VecEnv``.

    :param rewards: ``(batch,)`` float32
    :param dones: ``(batch,)`` bool, all equal
    :param infos: Statistics of the episodes that end here, one dictionary per environment
    """

    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]


def episodes_of_all(samples: list[PlayedEpisodes], n_instances: int) -> list[PlayedEpisodes]:
    """
    :param samples: The episodes of this process
    :param n_instances: Number of instances of the update in all processes
    :return: The episodes of all processes, so that each of them counts the same steps
    """
    if distributed.world_size() == 1:
        return samples

    first = samples[0]
    # One message for everything; float64 holds all of it exactly.
    fields = [field for played in samples for field in played if field is not None]
    columns = distributed.gather(th.as_tensor(np.stack(fields, 1), dtype=th.float64, device="cpu"), n_instances).numpy().T
    per_sample = columns.reshape(len(samples), -1, n_instances)
    return [
        PlayedEpisodes(*(column.astype(kind.dtype) for column, kind in zip(fields, first, strict=False) if kind is not None))
        for fields in per_sample
    ]


def steps_of_episodes(played: PlayedEpisodes, n_steps: int) -> Iterator[Step]:
    """
    Distribute played episodes over the steps of a ``VecEnv``.

    :param played: Episodes of ``batch`` instances
    :param n_steps: Number of ``VecEnv`` steps, at least 1
    :return: The steps; all episodes end in the last one
    """
    batch = len(played.returns)
    for _ in range(n_steps - 1):
        yield Step(np.zeros(batch, np.float32), np.zeros(batch, bool), [{} for _ in range(batch)])
    infos: list[dict[str, Any]] = [
        {"objective": episode_return, "illegal_actions": 0, "episode": {"r": episode_return, "l": length}}
        for episode_return, length in zip(played.returns.tolist(), played.lengths.tolist(), strict=True)
    ]
    if played.successes is not None:
        for info, is_success in zip(infos, played.successes.tolist(), strict=True):
            info["is_success"] = is_success
    yield Step(played.returns.astype(np.float32), np.ones(batch, bool), infos)

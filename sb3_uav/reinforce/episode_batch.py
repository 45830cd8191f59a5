"""Episodes that the fused driver has played, and how they look to code that expects SB3's step loop."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.policies.extractor import Cache


class EpisodeBatch(NamedTuple):
    """
    Complete episodes waiting for the gradient pass.

    :param instances: ``batch`` instances
    :param cache: Their encodings, with gradients
    :param actions: ``(batch, n_samples, n_steps)`` int64
    :param returns: ``(batch, n_samples)`` float64
    :param baseline: Broadcastable against ``returns``
    """

    instances: Instances
    cache: Cache
    actions: th.Tensor
    returns: th.Tensor
    baseline: th.Tensor

    def rewards_to_go(self, problem: Problem) -> th.Tensor:
        """
        :param problem: The problem that was played
        :return: ``(batch, n_samples, n_steps)`` float32, the sum of the rewards of each step and of those after it
        """
        collected = problem.step_rewards(self.instances, self.actions, self.returns)
        return collected.flip(-1).cumsum(-1).flip(-1).float()


class Step(NamedTuple):
    """
    One step of ``batch`` environments in the form of a ``VecEnv``.

    :param rewards: ``(batch,)`` float32
    :param dones: ``(batch,)`` bool, all alike
    :param infos: Statistics of the episodes that end here, one dictionary per environment
    """

    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]


def steps_of_episodes(returns: np.ndarray, lengths: np.ndarray, n_envs: int) -> Iterator[Step]:
    """
    Spread the episodes of a batch over as many steps as SB3's loop would have taken, ``n_envs`` environment steps each.

    :param returns: ``(batch, n_samples)``
    :param lengths: ``(batch, n_samples)``, environment steps
    :param n_envs: Number of environments
    :return: The steps, sample by sample; all episodes of a sample end in its last one
    """
    for sample_returns, sample_lengths in zip(returns.T, lengths.T, strict=True):
        batch = len(sample_returns)
        for _ in range(math.ceil(sample_lengths.sum() / n_envs) - 1):
            yield Step(np.zeros(batch, np.float32), np.zeros(batch, bool), [{} for _ in range(batch)])
        ended = zip(sample_returns.tolist(), sample_lengths.tolist(), strict=True)
        infos = [{"episode": {"r": episode_return, "l": length}} for episode_return, length in ended]
        yield Step(sample_returns.astype(np.float32), np.ones(batch, bool), infos)

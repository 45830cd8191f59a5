"""Episodes that the fused driver has played, and how they look to code that expects SB3's step loop."""

from __future__ import annotations

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


def steps_of_episodes(returns: np.ndarray, lengths: np.ndarray, n_steps: int) -> Iterator[Step]:
    """
    Spread episodes that have been played over steps of a ``VecEnv``.

    :param returns: ``(batch,)``
    :param lengths: ``(batch,)``, environment steps
    :param n_steps: Number of steps, at least 1
    :return: The steps; all episodes end in the last one
    """
    batch = len(returns)
    for _ in range(n_steps - 1):
        yield Step(np.zeros(batch, np.float32), np.zeros(batch, bool), [{} for _ in range(batch)])
    infos = [
        {"objective": episode_return, "illegal_actions": 0, "episode": {"r": episode_return, "l": length}}
        for episode_return, length in zip(returns.tolist(), lengths.tolist(), strict=True)
    ]
    yield Step(returns.astype(np.float32), np.ones(batch, bool), infos)

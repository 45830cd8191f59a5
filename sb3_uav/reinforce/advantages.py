"""Advantages: returns minus a baseline."""

from __future__ import annotations

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_uav.common import distributed
from sb3_uav.reinforce.baselines import Baseline

# Value of ``normalize_advantage``.
BY_INSTANCE = "instance"
# Prevents a division by zero if all advantages are equal, as in SB3.
_EPSILON = 1e-8


def scale_advantages(advantages: th.Tensor) -> th.Tensor:
    """
    :param advantages: Advantages of any shape
    :return: The advantages divided by their standard deviation; a single advantage is returned unchanged
    """
    return advantages / (advantages.std() + _EPSILON) if advantages.numel() > 1 else advantages


def scale_steps(advantages: th.Tensor) -> th.Tensor:
    """
    :param advantages: ``(n_steps,)``, those of this process
    :return: The advantages divided by the standard deviation over all processes, as :func:`scale_advantages` does
    """
    if distributed.world_size() == 1:
        return scale_advantages(advantages)
    count = distributed.total(advantages.numel())
    mean = distributed.total(float(advantages.double().sum())) / count
    squares = distributed.total(float(((advantages.double() - mean) ** 2).sum()))
    return advantages / ((squares / max(count - 1, 1)) ** 0.5 + _EPSILON)


def scale_by_instance(advantages: th.Tensor) -> th.Tensor:
    """
    Scale the advantages of every instance by themselves, so that instances with large values do not outweigh the others.

    :param advantages: ``(batch, n_samples)``
    :return: Those of each instance divided by their standard deviation plus the median of these deviations, which keeps
        differences of almost nothing small
    """
    if advantages.shape[-1] < 2:
        return scale_advantages(advantages)
    deviation = advantages.std(-1, keepdim=True)
    return advantages / (deviation + deviation.median() + _EPSILON)


def complete_steps(buffer: RolloutBuffer, last_episode_starts: np.ndarray) -> np.ndarray:
    """
    :param buffer: A full buffer of SB3's loop
    :param last_episode_starts: ``(n_envs,)``, whether an episode ended at the last step of the buffer
    :return: ``(n_steps, n_envs)`` bool, True at steps of episodes that end within the buffer
    """
    ended_after = np.vstack([buffer.episode_starts[1:], last_episode_starts]).astype(bool)
    return np.logical_or.accumulate(ended_after[::-1])[::-1]


def step_advantages(buffer: RolloutBuffer, complete: np.ndarray, baseline: Baseline, normalize: bool) -> np.ndarray:
    """
    :param buffer: A full buffer of SB3's loop
    :param complete: ``(n_steps, n_envs)`` bool, the steps to train on
    :param baseline: The baseline to subtract from the returns
    :param normalize: Whether to normalize the advantages to mean 0 and standard deviation 1
    :return: ``(n_steps, n_envs)``, return minus baseline at the steps to train on, 0 elsewhere
    """
    advantages = np.zeros_like(buffer.advantages)
    if complete.any():
        returns = np.where(complete, buffer.returns, np.nan)
        gain = (returns - baseline.of_steps(returns, buffer.values))[complete]
        if normalize:
            gain = (gain - gain.mean()) / (gain.std() + _EPSILON)
        # Scaled so that the mean over the buffer equals the mean over the steps to train on.
        advantages[complete] = gain * (complete.size / complete.sum())
    return advantages

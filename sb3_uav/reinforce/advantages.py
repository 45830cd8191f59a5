"""What an action is worth beyond the baseline."""

from __future__ import annotations

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_uav.reinforce.baselines import Baseline

# Keeps equal advantages from being divided by 0, as in SB3.
EPSILON = 1e-8


def scale_advantages(advantages: th.Tensor) -> th.Tensor:
    """
    :param advantages: Advantages of any shape
    :return: The same divided by their standard deviation; a single one, which has none, unchanged
    """
    return advantages / (advantages.std() + EPSILON) if advantages.numel() > 1 else advantages


def complete_steps(buffer: RolloutBuffer, last_episode_starts: np.ndarray) -> np.ndarray:
    """
    :param buffer: A full buffer of SB3's loop
    :param last_episode_starts: ``(n_envs,)``, whether an episode ended with the buffer's last step
    :return: ``(n_steps, n_envs)`` bool, True at steps of episodes that end within the buffer
    """
    ended_after = np.vstack([buffer.episode_starts[1:], last_episode_starts]).astype(bool)
    return np.logical_or.accumulate(ended_after[::-1])[::-1]


def step_advantages(buffer: RolloutBuffer, complete: np.ndarray, baseline: Baseline, normalize: bool) -> np.ndarray:
    """
    :param buffer: A full buffer of SB3's loop
    :param complete: ``(n_steps, n_envs)`` bool, steps to learn from
    :param baseline: What to subtract from the returns
    :param normalize: Whether to give the advantages mean 0 and standard deviation 1
    :return: ``(n_steps, n_envs)`` return minus baseline, 0 at steps not to learn from
    """
    advantages = np.zeros_like(buffer.advantages)
    if complete.any():
        returns = np.where(complete, buffer.returns, np.nan)
        gain = (returns - baseline.of_steps(returns, buffer.values))[complete]
        if normalize:
            gain = (gain - gain.mean()) / (gain.std() + EPSILON)
        # The mean over the buffer becomes the mean over the steps to learn from.
        advantages[complete] = gain * (complete.size / complete.sum())
    return advantages

"""Rewards of the user, given at the end of an episode in place of the total value of the visited tasks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th

from sb3_uav.envs.instances import Instances

# Values one complete schedule per row: the instances, and the tours as (batch, n_uavs, n_steps) int64 task indices from 0 in
# the order of their visits, with -1 as padding -> (batch,). Tensors are on the device of the instances.
Reward = Callable[[Instances, th.Tensor], th.Tensor]


def score_tours(reward: Reward, instances: Instances, tours: th.Tensor) -> th.Tensor:
    """
    :param reward: The user's reward
    :param instances: ``batch`` instances
    :param tours: ``(batch, n_samples, n_uavs, n_steps)`` int64, tasks from 0, -1 as padding
    :return: ``(batch, n_samples)`` float64
    :raises ValueError: If the reward does not return one finite number per row
    """
    values = [_checked(reward(instances, tours[:, sample]), len(instances)) for sample in range(tours.shape[1])]
    return th.stack(values, dim=1).to(instances.device)


def _checked(found: Any, batch_size: int) -> th.Tensor:
    if not isinstance(found, th.Tensor) or found.shape != (batch_size,) or found.is_complex():
        what = f"a tensor of shape {tuple(found.shape)}" if isinstance(found, th.Tensor) else f"{found!r:.60}"
        raise ValueError(f"it returned {what}; return a tensor of shape ({batch_size},), one number per row.")
    values = found.double()
    if not values.isfinite().all():
        raise ValueError(f"it returned {values[~values.isfinite()][0].item()}; return finite numbers.")
    return values


def at_the_end(returns: th.Tensor, lengths: th.Tensor, n_steps: int) -> th.Tensor:
    """
    :param returns: ``(batch, n_samples)``
    :param lengths: ``(batch, n_samples)`` int64, lengths of the episodes, at least 1
    :param n_steps: Number of steps of the longest
    :return: ``(batch, n_samples, n_steps)``, the returns in the last steps of their episodes, and zeros
    """
    rewards = th.zeros(*returns.shape, n_steps, dtype=returns.dtype, device=returns.device)
    return rewards.scatter(-1, lengths[..., None] - 1, returns[..., None])


class TourState(NamedTuple):
    """
    The state of route planning with a reward of the user: that of the plain dynamics, and the tour so far.

    :param tour: ``(batch, n_samples, n_tasks + 1)`` int64, tasks from 0 in the order of their visits, -1 as padding
    """

    position: th.Tensor
    visited: th.Tensor
    traveled: th.Tensor
    done: th.Tensor
    action_mask: th.Tensor
    tour: th.Tensor

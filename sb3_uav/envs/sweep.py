"""The order of the tasks in a sweep around the depot."""

from __future__ import annotations

import math

import torch as th

from sb3_uav.envs.instances import Instances


def sweep_center(instances: Instances) -> th.Tensor:
    """
    :param instances: ``batch`` instances
    :return: ``(batch, 2)``, the depot; where UAVs differ, the mean of the points midway between start and end of those that
        can fly
    """
    if instances.start is None and instances.end is None:
        return instances.depot
    flies = instances.can_fly | ~instances.can_fly.any(1, keepdim=True)
    middle = (instances.uav_start + instances.uav_end) / 2
    return (middle * flies[..., None]).sum(1) / flies.sum(1, keepdim=True)


def sweep_order(instances: Instances, gap: int = 0, clockwise: bool = False) -> th.Tensor:
    """
    Sort tasks by their polar angle around the depot, starting after a wide gap between two of them.

    Where UAVs differ, the center is another one, see :func:`sweep_center`.

    :param instances: ``batch`` instances
    :param gap: Rank of the gap to start after: 0 for the widest, 1 for the second widest, ...
    :param clockwise: Whether to sweep clockwise
    :return: ``(batch, n_tasks)`` int64, the index of the task in each place; padded tasks keep their places at the end
    """
    offset = instances.tasks - sweep_center(instances)[:, None]
    angle = th.atan2(offset[..., 1], offset[..., 0])
    angle, order = (-angle if clockwise else angle).masked_fill(~instances.task_mask, th.inf).sort(dim=1, stable=True)
    places = th.arange(instances.n_tasks, device=angle.device)
    n_real = instances.task_mask.sum(1, keepdim=True).clamp(min=1)
    is_last = places == n_real - 1
    following = th.where(is_last, angle[:, :1] + 2 * math.pi, angle.roll(-1, 1))
    width = th.where(places < n_real, following - angle, -th.inf)
    ranked = width.argsort(dim=1, descending=True, stable=True)
    first = ranked.gather(1, gap % n_real) + 1
    return order.gather(1, th.where(places < n_real, (places + first) % n_real, places))

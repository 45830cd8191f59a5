"""Sizes of instances: which are allowed, and how many instances of a size make a training batch."""

from __future__ import annotations

import numpy as np

from sb3_uav.envs.instance_checks import MAX_UAVS

# Exponent that reduces the batch size of larger instances. With 1, all batches would hold equally many tasks; less than that
# is better, because small tensors spend more time on launching operations.
_FEWER_INSTANCES = 0.85


def check_size(n_tasks: int, n_uavs: int, max_distance: float) -> None:
    """
    :param n_tasks: Number of tasks
    :param n_uavs: Number of UAVs
    :param max_distance: Maximum flight distance
    :raises ValueError: If a size is not allowed; the message names it
    """
    if n_tasks < 1:
        raise ValueError(f"n_tasks is {n_tasks}, but an instance needs at least 1 task.")
    if not 1 <= n_uavs <= MAX_UAVS:
        raise ValueError(f"n_uavs is {n_uavs}, but a fleet needs at least 1 UAV, and {MAX_UAVS} at most.")
    if not (np.isfinite(max_distance) and max_distance > 0):
        raise ValueError(f"max_distance is {max_distance}, but the maximum flight distance must be a finite number > 0.")


def n_instances_of(batch_size: int, least: int, n_tasks: int) -> int:
    """
    :param batch_size: Number of instances of the smallest size
    :param least: That size, in tasks
    :param n_tasks: Number of tasks of the instances of a batch
    :return: How many of them the batch holds, at least 2
    """
    return max(round(batch_size * (least / n_tasks) ** _FEWER_INSTANCES), 2)

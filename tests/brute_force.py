"""The best schedule of a tiny instance, by trying all of them."""

from __future__ import annotations

import math

from sb3_uav.envs import Instances
from sb3_uav.envs.distances import DISTANCE_TOLERANCE


def largest_value(instances: Instances, row: int = 0) -> float:
    """
    Written without any of the solvers' code: the shortest tour of every set of tasks by dynamic programming over its subsets,
    then the best division of the tasks among the UAVs. Takes time in proportion to ``3 ** n_tasks``.

    :param instances: The instances
    :param row: Which of them
    :return: The largest total value of any feasible schedule
    """
    n_tasks = int(instances.task_mask[row].sum())
    points = [instances.depot[row].tolist(), *instances.tasks[row, :n_tasks].tolist()]
    values = instances.values[row].tolist()
    distance = [[math.hypot(ax - bx, ay - by) for bx, by in points] for ax, ay in points]
    limit = float(instances.max_distance[row]) * (1 + DISTANCE_TOLERANCE)

    # Of every set of tasks and its last one: the length of the shortest path from the depot.
    path = [[math.inf] * n_tasks for _ in range(1 << n_tasks)]
    worth = [-math.inf] * (1 << n_tasks)
    worth[0] = 0.0
    for tasks in range(1, 1 << n_tasks):
        members = [task for task in range(n_tasks) if tasks >> task & 1]
        for last in members:
            rest = tasks & ~(1 << last)
            before = [path[rest][task] + distance[task + 1][last + 1] for task in members if task != last]
            path[tasks][last] = min(before, default=distance[0][last + 1])
        if min(path[tasks][last] + distance[last + 1][0] for last in members) <= limit:
            worth[tasks] = math.fsum(values[task] for task in members)

    best = worth
    for _ in range(instances.n_uavs - 1):
        best = [max(best[tasks & ~own] + worth[own] for own in _subsets(tasks)) for tasks in range(1 << n_tasks)]
    return max(best)


def _subsets(tasks: int) -> list[int]:
    """All subsets of a set, both as bits, the empty one included."""
    subsets = [0]
    own = tasks
    while own:
        subsets.append(own)
        own = (own - 1) & tasks
    return subsets

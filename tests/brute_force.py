"""The best schedule of a tiny instance, by trying all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sb3_uav.envs import Instances
from sb3_uav.envs.distances import DISTANCE_TOLERANCE

Point = tuple[float, float]


def largest_value(instances: Instances, row: int = 0) -> float:
    """
    Written without any of the solvers' code: the shortest tour of every set of tasks by dynamic programming over its subsets,
    then the best division of the tasks among the UAVs. Takes time in proportion to ``3 ** n_tasks``.

    :param instances: Instances of the whole problem
    :param row: Which of them
    :return: The largest sum of prizes of any feasible schedule: its value, if no task must be served
    """
    n_tasks = int(instances.task_mask[row].sum())
    points = [(x, y) for x, y in instances.tasks[row, :n_tasks].tolist()]
    prizes, service = instances.prizes[row].tolist(), instances.service_cost[row].tolist()
    fleet = [
        (tuple(start), tuple(end), limit * (1 + DISTANCE_TOLERANCE))
        for start, end, limit in zip(
            *(field[row].tolist() for field in (instances.uav_start, instances.uav_end, instances.uav_distance)), strict=True
        )
    ]
    # Of every set of tasks, what it is worth to a UAV: nothing is feasible for one that has to visit it and cannot.
    worth = {uav: _worth(points, prizes, service, *uav) for uav in set(fleet)}
    best = worth[fleet[0]]
    for uav in fleet[1:]:
        own = worth[uav]
        best = [max(best[tasks & ~mine] + own[mine] for mine in _subsets(tasks)) for tasks in range(1 << n_tasks)]
    return max(best)


def _worth(
    points: Sequence[Point], prizes: Sequence[float], service: Sequence[float], start: Point, end: Point, limit: float
) -> list[float]:
    """
    :param points: The tasks
    :param prizes: What each is worth
    :param service: What serving each costs
    :param start: Start of a UAV
    :param end: Its end
    :param limit: How far it flies
    :return: What every set of tasks, as bits, is worth; -inf where the UAV cannot visit it. None at all is always allowed
    """
    n_tasks = len(points)
    # Of every set of tasks and its last one: the length of the shortest path from the start, with the services.
    path = [[math.inf] * n_tasks for _ in range(1 << n_tasks)]
    worth = [-math.inf] * (1 << n_tasks)
    worth[0] = 0.0
    for tasks in range(1, 1 << n_tasks):
        members = [task for task in range(n_tasks) if tasks >> task & 1]
        for last in members:
            rest = tasks & ~(1 << last)
            before = [path[rest][task] + math.dist(points[task], points[last]) for task in members if task != last]
            path[tasks][last] = min(before, default=math.dist(start, points[last])) + service[last]
        if min(path[tasks][last] + math.dist(points[last], end) for last in members) <= limit:
            worth[tasks] = math.fsum(prizes[task] for task in members)
    return worth


def _subsets(tasks: int) -> list[int]:
    """All subsets of a set, both as bits, the empty one included."""
    subsets = [0]
    own = tasks
    while own:
        subsets.append(own)
        own = (own - 1) & tasks
    return subsets

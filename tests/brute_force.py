"""The best schedule of a tiny instance, by trying all of them."""

from __future__ import annotations

import math

from sb3_uav.envs import Instances
from sb3_uav.envs.distances import DISTANCE_TOLERANCE


def largest_value(instances: Instances, row: int = 0) -> float:
    """
    :param instances: The instances
    :param row: Which of them
    :return: The largest sum of prizes of any feasible schedule: its value, if no task must be served
    """
    n_must, value = best_score(instances, row)
    if n_must == 0:
        return value
    total = float((instances.values * instances.task_mask)[row].sum())
    return value + n_must * (2 * total if total > 0 else 1.0)


def best_score(instances: Instances, row: int = 0) -> tuple[int, float]:
    """
    Written without any of the solvers' code: for every UAV the shortest tour of every set of tasks by dynamic programming over
    its subsets, then the best division of the tasks among the UAVs. Takes time in proportion to ``3 ** n_tasks``.

    :param instances: The instances
    :param row: Which of them
    :return: Of the best schedule: the number of tasks that must be served on it, and the total value
    """
    n_tasks = int(instances.task_mask[row].sum())
    points = instances.tasks[row, :n_tasks].tolist()
    values, service = instances.values[row].tolist(), instances.service_cost[row].tolist()
    must = [False] * n_tasks if instances.must_serve is None else instances.must_serve[row].tolist()
    legs = [[math.hypot(ax - bx, ay - by) for bx, by in points] for ax, ay in points]
    uavs = zip(
        instances.uav_start[row].tolist(), instances.uav_end[row].tolist(), instances.uav_distance[row].tolist(), strict=True
    )
    scores = [
        (sum(must[task] for task in members), math.fsum(values[task] for task in members))
        for members in ([task for task in range(n_tasks) if tasks >> task & 1] for tasks in range(1 << n_tasks))
    ]
    best: list[tuple[int, float]] | None = None
    previous: list[tuple[int, float]] = []
    for start, end, limit in uavs:
        outward, homeward = ([math.hypot(x - site[0], y - site[1]) for x, y in points] for site in (start, end))
        feasible = _feasible_sets(legs, outward, homeward, service, limit * (1 + DISTANCE_TOLERANCE))
        own_scores = [score if fits else (0, 0.0) for score, fits in zip(scores, feasible, strict=True)]
        if best is None:
            best = [max(own_scores[own] for own in _subsets(tasks)) for tasks in range(1 << n_tasks)]
            continue
        previous = best
        best = [
            max(
                (previous[tasks & ~own][0] + own_scores[own][0], previous[tasks & ~own][1] + own_scores[own][1])
                for own in _subsets(tasks)
            )
            for tasks in range(1 << n_tasks)
        ]
    assert best is not None
    return best[-1]


def _feasible_sets(
    legs: list[list[float]], outward: list[float], homeward: list[float], service: list[float], limit: float
) -> list[bool]:
    """
    :param legs: Distances between tasks
    :param outward: Distances from the start to the tasks
    :param homeward: Distances from the tasks to the end
    :param service: What serving each task costs
    :param limit: How far the UAV can fly
    :return: Of every set of tasks, as bits, whether it can serve them all
    """
    n_tasks = len(outward)
    # Of every set of tasks and its last one: the length of the shortest path from the start, with what serving them costs.
    path = [[math.inf] * n_tasks for _ in range(1 << n_tasks)]
    feasible = [True] * (1 << n_tasks)
    for tasks in range(1, 1 << n_tasks):
        members = [task for task in range(n_tasks) if tasks >> task & 1]
        for last in members:
            rest = tasks & ~(1 << last)
            before = [path[rest][task] + legs[task][last] for task in members if task != last]
            path[tasks][last] = min(before, default=outward[last]) + service[last]
        feasible[tasks] = min(path[tasks][last] + homeward[last] for last in members) <= limit
    return feasible


def _subsets(tasks: int) -> list[int]:
    """All subsets of a set, both as bits, the empty one included."""
    subsets = [0]
    own = tasks
    while own:
        subsets.append(own)
        own = (own - 1) & tasks
    return subsets

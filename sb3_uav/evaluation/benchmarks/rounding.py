"""
OPLib's rule for lengths: every edge counts with its Euclidean length rounded to the nearest whole number (TSPLIB's EUC_2D).

Solvers see Euclidean lengths, by which the paper's checker accepts their schedules. Rounding makes a tour shorter or longer.
One that the rule finds too long is shortened: first by reversing parts of it, then by leaving out tasks. Best-known values are
compared with what remains. On demand, the room that rounding leaves is used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule

# Longer tours are shortened only by leaving out tasks, and not filled: all pairs of their edges take too much memory.
_MOST_REVERSED = 1000
RULE = "EUC_2D: the length of every edge is rounded to the nearest whole number"


class RoundedReport(NamedTuple):
    """
    Result of checking a schedule by the rule.

    :param objective: Total value of the visited tasks
    :param lengths: Length of every route by the rule
    """

    objective: float
    lengths: tuple[float, ...]


def rounded_distance(a: Sequence[float], b: Sequence[float]) -> int:
    """
    :param a: x and y
    :param b: x and y
    :return: TSPLIB's ``nint`` of the Euclidean distance, which rounds halves up
    """
    return math.floor(math.hypot(a[0] - b[0], a[1] - b[1]) + 0.5)


def check_rounded(instance: Instances, schedule: Schedule) -> RoundedReport:
    """
    Check a schedule by the rule, in plain Python numbers and without code of the repair.

    :param instance: A batch of one, whose UAVs fly from the depot to the depot, equally far
    :param schedule: The schedule
    :return: Objective and lengths by the rule
    :raises InfeasibleScheduleError: If a route is too long, a task is unknown or visited twice, or there are too many routes
    """
    depot, tasks = instance.depot[0].tolist(), instance.tasks[0].tolist()
    limit, values = float(instance.max_distance[0]), instance.values[0].tolist()
    visited = [task for route in schedule.routes for task in route]
    if len(schedule.routes) > instance.n_uavs or len(set(visited)) != len(visited):
        raise InfeasibleScheduleError("There are more routes than UAVs, or a task is visited twice.")
    if not all(0 <= task < int(instance.task_mask[0].sum()) for task in visited):
        raise InfeasibleScheduleError("A route visits a task that does not exist.")
    lengths = []
    for uav, route in enumerate(schedule.routes):
        stops = [depot, *(tasks[task] for task in route), depot]
        lengths.append(float(sum(rounded_distance(a, b) for a, b in itertools.pairwise(stops))))
        if lengths[-1] > limit:
            raise InfeasibleScheduleError(f"UAV {uav} flies {lengths[-1]:g} by the rounded lengths, more than {limit:g}.")
    return RoundedReport(math.fsum(values[task] for task in visited), tuple(lengths))


def fit_to_rule(instance: Instances, schedule: Schedule) -> Schedule:
    """
    Shorten routes that the rule finds too long; the others stay as they are.

    :param instance: A batch of one, whose UAVs fly from the depot to the depot, equally far
    :param schedule: A schedule that is feasible with Euclidean lengths
    :return: A schedule that is feasible by the rule
    """
    depot, tasks = instance.depot[0].tolist(), instance.tasks[0].tolist()
    values, limit = instance.values[0].tolist(), float(instance.max_distance[0])
    routes = []
    for route in schedule.routes:
        # Node 0 is the depot.
        points = np.array([depot, *(tasks[task] for task in route)])
        worth = np.array([0.0, *(values[task] for task in route)])
        tour = _shortened(np.arange(len(points)), points, worth, limit)
        routes.append([route[node - 1] for node in tour[1:].tolist()])
    return Schedule(routes)


def fill(instance: Instances, schedule: Schedule) -> Schedule:
    """
    Use the room that rounding leaves: put in further tasks, the most valuable per length first, as long as the rule admits it.

    :param instance: A batch of one, whose UAVs fly from the depot to the depot, equally far
    :param schedule: A schedule that is feasible by the rule
    :return: A schedule that is feasible by the rule; its Euclidean lengths may be greater than the limit
    """
    # Node 0 is the depot.
    points = np.concatenate([instance.depot[0].numpy()[None], instance.tasks[0].numpy()])
    worth = np.concatenate([[0.0], instance.values[0].numpy()])
    left = np.flatnonzero(worth > 0)
    left = left[~np.isin(left, [task + 1 for route in schedule.routes for task in route])]
    routes = []
    for route in schedule.routes:
        tour = np.array([0, *(task + 1 for task in route)])
        tour, left = _filled(tour, left, points, worth, float(instance.max_distance[0]))
        routes.append((tour[1:] - 1).tolist())
    return Schedule(routes)


def _filled(
    tour: np.ndarray, left: np.ndarray, points: np.ndarray, worth: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """
    :param tour: ``(n,)``, nodes of a closed tour, the depot first
    :param left: Nodes that may be put in
    :param points: ``(n_nodes, 2)``
    :param worth: ``(n_nodes,)``
    :param limit: Greatest length
    :return: The tour with some of these nodes, and the others
    """
    while len(left) > 0 and len(tour) <= _MOST_REVERSED:
        room = limit - _length(tour, points)
        here, after = points[tour][:, None], points[np.roll(tour, -1)][:, None]
        new = points[left][None]
        added = _rounded(here, new) + _rounded(new, after) - _rounded(here, after)
        place, cost = added.argmin(0), added.min(0)
        fits = cost <= room
        if fits.any():
            # One that makes the tour no longer costs nothing.
            best = int(np.where(fits, worth[left] / np.maximum(cost, 1e-9), -1.0).argmax())
            tour = np.insert(tour, place[best] + 1, left[best])
            left = np.delete(left, best)
            continue
        tour = tour[_reversed_parts(np.arange(len(tour)), points[tour])]
        if limit - _length(tour, points) <= room:
            break
    return tour, left


def _rounded(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """:return: Rounded distances between points, ``(..., 2)`` each"""
    return np.floor(np.hypot(a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]) + 0.5)


def _length(tour: np.ndarray, points: np.ndarray) -> float:
    """:return: Length of a closed tour"""
    return float(_rounded(points[tour], points[np.roll(tour, -1)]).sum())


def _shortened(tour: np.ndarray, points: np.ndarray, worth: np.ndarray, limit: float) -> np.ndarray:
    """
    :param tour: ``(n,)``, nodes of a closed tour, the depot first
    :param points: ``(n, 2)``
    :param worth: ``(n,)``
    :param limit: Greatest length
    :return: The tour, or as much of it as the limit admits
    """
    if _length(tour, points) <= limit:
        return tour
    if len(tour) <= _MOST_REVERSED:
        reversed_parts = _reversed_parts(tour, points)
        # It has to remain feasible with Euclidean lengths too.
        offsets = points[reversed_parts] - points[np.roll(reversed_parts, -1)]
        if np.hypot(*offsets.T).sum() <= limit:
            tour = reversed_parts
    while len(tour) > 1 and (excess := _length(tour, points) - limit) > 0:
        here, before, after = points[tour], points[np.roll(tour, 1)], points[np.roll(tour, -1)]
        saved = (_rounded(before, here) + _rounded(here, after) - _rounded(before, after))[1:]
        lost = worth[tour][1:]
        # The least valuable task that alone is enough; otherwise, that which loses the least per length.
        enough = saved >= excess
        cost = np.where(enough, lost, math.inf) if enough.any() else lost / np.maximum(saved, 1e-9)
        tour = np.delete(tour, 1 + int(cost.argmin()))
    return tour


def _reversed_parts(tour: np.ndarray, points: np.ndarray) -> np.ndarray:
    """:return: The tour after reversals of parts of it that shorten it, as long as there are any (2-opt)"""
    distances = _rounded(points[:, None], points[None])
    tour = tour.copy()
    while True:
        following = np.roll(tour, -1)
        edges = distances[tour, following]
        # Instead of edges i and j, those between their first ends and between their second ends.
        gain = edges[:, None] + edges[None] - distances[np.ix_(tour, tour)] - distances[np.ix_(following, following)]
        gain = np.triu(gain, 1)
        first, second = np.unravel_index(int(gain.argmax()), gain.shape)
        if gain[first, second] <= 0:
            return tour
        tour[first + 1 : second + 1] = tour[first + 1 : second + 1][::-1].copy()

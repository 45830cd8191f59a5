"""Cheapest insertion: a simple baseline that plans all tours at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.solvers.base import OneByOneSolver, Solution

# Insertions that add no length are all equally good, whatever rounding makes of their lengths; the value decides among them.
_SMALLEST_DETOUR = 1e-12


class GreedyInsertion(OneByOneSolver):
    """
    Insert the task with the largest value per added length where it adds the least, into any tour that has room for it, until
    no task fits. Where some tasks are worth so much more than others that they seem to have to be served, also these first;
    the better schedule counts.
    """

    name = "greedy-insertion"
    solves_whole_problem = True
    uses_time_limit = False

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        reduced = ReducedInstance.of(instance)
        routes = insert_greedily(reduced)
        if reduced.is_dear.any():
            routes = max(routes, insert_greedily(reduced, dear_first=True), key=reduced.total_value)
        return Solution(reduced.schedule(routes))


def insert_greedily(
    reduced: ReducedInstance, given: Sequence[Sequence[int]] = (), dear_first: bool = False
) -> list[list[int]]:
    """
    :param reduced: What to plan
    :param given: Routes of the first UAVs to start from, as nodes; empty ones when there are fewer than useful UAVs
    :param dear_first: Whether tasks that seem to have to be served come before all others
    :return: One route per useful UAV, as nodes
    """
    routes = [list(route) for route in given] + [[] for _ in range(reduced.n_uavs - len(given))]
    if reduced.n_tasks == 0:
        return routes
    slack = reduced.limits - [reduced.tour_length(route, uav) for uav, route in enumerate(routes)]
    # Of every task into every tour: the least added length, and the position where it is least.
    positions, detours = zip(
        *(_cheapest_insertions(reduced, reduced.tour(route, uav)) for uav, route in enumerate(routes)), strict=True
    )
    position, detour = np.stack(positions), np.stack(detours)
    free = np.ones(reduced.n_tasks, dtype=bool)
    free[[node - reduced.n_sites for route in routes for node in route]] = False
    dear_first = dear_first and bool(reduced.is_dear.any())
    while True:
        eligible = free & reduced.is_dear if dear_first else free
        rate = np.where(eligible & (detour <= slack[:, None]), reduced.values / np.maximum(detour, _SMALLEST_DETOUR), 0.0)
        uav, task = map(int, np.unravel_index(rate.argmax(), rate.shape))
        if rate[uav, task] == 0:
            if not dear_first:
                return routes
            dear_first = False
            continue
        routes[uav].insert(position[uav, task], task + reduced.n_sites)
        slack[uav] -= detour[uav, task]
        free[task] = False
        position[uav], detour[uav] = _cheapest_insertions(reduced, reduced.tour(routes[uav], uav))


def _cheapest_insertions(reduced: ReducedInstance, tour: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """
    :param reduced: What to plan
    :param tour: A route, as nodes, with its start and its end
    :return: Of every task, the place in the route where it adds the least length, ``(n,)`` int64, and that length, ``(n,)``
    """
    stops = np.array(tour)
    to_stops = reduced.distances[stops, reduced.n_sites :]
    added = to_stops[:-1] + to_stops[1:] - reduced.distances[stops[:-1], stops[1:]][:, None]
    return added.argmin(0), added.min(0)

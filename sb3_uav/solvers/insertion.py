"""Cheapest insertion: the trivial reference among the solvers that plan all tours at once."""

from __future__ import annotations

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.solvers.base import OneByOneSolver, Solution

# Insertions that add no length are all equally good, whatever rounding makes of their lengths; the value decides among them.
SMALLEST_DETOUR = 1e-12


class GreedyInsertion(OneByOneSolver):
    """
    Insert the task with the largest value per added length where it adds the least, into any tour that has room for it, until
    no task fits.
    """

    name = "greedy-insertion"
    uses_time_limit = False

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        reduced = ReducedInstance.of(instance)
        return Solution(reduced.schedule(insert_greedily(reduced)))


def insert_greedily(reduced: ReducedInstance) -> list[list[int]]:
    """
    :param reduced: What to plan
    :return: One route per useful UAV, as nodes
    """
    routes: list[list[int]] = [[] for _ in range(reduced.n_uavs)]
    if reduced.n_tasks == 0:
        return routes
    slack = np.ones(reduced.n_uavs)
    # Of every task into every tour: the least added length, and the position where it is least.
    detour = np.tile(2 * reduced.distances[0, 1:], (reduced.n_uavs, 1))
    position = np.zeros(detour.shape, dtype=np.int64)
    free = np.ones(reduced.n_tasks, dtype=bool)
    while True:
        rate = np.where(free & (detour <= slack[:, None]), reduced.values / np.maximum(detour, SMALLEST_DETOUR), 0.0)
        uav, task = np.unravel_index(rate.argmax(), rate.shape)
        if rate[uav, task] == 0:
            return routes
        routes[uav].insert(position[uav, task], int(task) + 1)
        slack[uav] -= detour[uav, task]
        free[task] = False
        stops = np.array([0, *routes[uav], 0])
        to_stops = reduced.distances[stops, 1:]
        added = to_stops[:-1] + to_stops[1:] - reduced.distances[stops[:-1], stops[1:]][:, None]
        position[uav] = added.argmin(0)
        detour[uav] = added.min(0)

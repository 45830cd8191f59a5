"""What general-purpose solvers need of an instance: the tasks worth visiting, with scaled or integer distances and prizes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sb3_uav.envs.distances import DISTANCE_TOLERANCE
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule

# Solvers leave this part of the tolerance of the dynamics and of the checker to the rounding of sums of distances: far more
# than they can err by, hundreds of legs long.
_MARGIN = 1e-3
USABLE_TOLERANCE = (1.0 - _MARGIN) * DISTANCE_TOLERANCE
# Rounding of values that are multiples of one another, as a part of them.
_MULTIPLE_TOLERANCE = 1e-12
# The maximum flight distance in integers, for costs.
RESOLUTION = 2_000_000
# The same for limits: so fine that rounding up every leg of a tour, of up to 17,000, stays within the usable tolerance. Even,
# so that it never forbids a flight to a reachable task either.
FINE_RESOLUTION = 2**45


@dataclass(frozen=True)
class ReducedInstance:
    """
    An instance without the tasks that no schedule can reach or that are worth nothing.

    Nodes are numbered from 0, the depot; node ``i > 0`` is task ``tasks[i - 1]``. Distances are scaled: a tour is feasible if
    its length is at most 1.

    :param tasks: ``(n,)`` int64, indices of the remaining tasks; possibly none
    :param values: ``(n,)`` float64, all positive
    :param distances: ``(n + 1, n + 1)`` float64, between nodes
    :param fleet_size: Number of UAVs of the instance
    """

    tasks: np.ndarray
    values: np.ndarray
    distances: np.ndarray
    fleet_size: int

    @classmethod
    def of(cls, instance: Instances) -> ReducedInstance:
        """
        :param instance: A batch of one
        :return: Its reduction
        """
        depot, points, values = (field[0].numpy() for field in (instance.depot, instance.tasks, instance.values))
        limit = float(instance.max_distance[0]) * (1 + USABLE_TOLERANCE)
        home = np.hypot(*(points - depot).T) / limit
        (tasks,) = np.nonzero(instance.task_mask[0].numpy() & (values > 0) & (2 * home <= 1))
        nodes = np.vstack([depot, points[tasks]])
        distances = np.hypot(*(axis[:, None] - axis for axis in nodes.T)) / limit
        return cls(tasks, values[tasks], distances, instance.n_uavs)

    @property
    def n_tasks(self) -> int:
        return len(self.tasks)

    @property
    def n_uavs(self) -> int:
        """How many UAVs can be of use: never more than there are tasks."""
        return min(self.fleet_size, self.n_tasks)

    def schedule(self, routes: Iterable[Iterable[int]]) -> Schedule:
        """
        :param routes: Nodes in flying order, without the depot; missing routes are empty
        :return: The schedule of the whole fleet
        """
        found = [[self.tasks[node - 1] for node in route] for route in routes]
        return Schedule(found + [[]] * (self.fleet_size - len(found)))

    def routes(self, schedule: Schedule) -> list[list[int]]:
        """
        :param schedule: A schedule of the instance
        :return: Its non-empty routes as nodes, without the tasks that are worth nothing
        """
        node_of = {int(task): node for node, task in enumerate(self.tasks, start=1)}
        routes = [[node_of[task] for task in route if task in node_of] for route in schedule.routes]
        return [route for route in routes if route]

    def coarse_distances(self) -> np.ndarray:
        """
        Rounded down: every feasible tour is at most :data:`RESOLUTION` long, but a tour of this length may be infeasible by
        one unit per leg.

        :return: ``(n + 1, n + 1)`` int64
        """
        return np.floor(self.distances * RESOLUTION).astype(np.int64)

    def fine_distances(self) -> np.ndarray:
        """
        Rounded up: a tour of at most :data:`FINE_RESOLUTION` is feasible, and so long is every tour that keeps to the maximum
        flight distance without any tolerance.

        :return: ``(n + 1, n + 1)`` int64
        """
        return np.ceil(self.distances * FINE_RESOLUTION).astype(np.int64)

    def tour_length(self, route: Iterable[int]) -> float:
        """
        :param route: Nodes in flying order, without the depot
        :return: Length of the closed tour, which is feasible if that is at most 1
        """
        return math.fsum(self.distances[a, b] for a, b in pairwise((0, *route, 0)))

    def integer_prizes(self, finest: int, largest_sum: int) -> np.ndarray:
        """
        Prizes in units of distance, so that any gain of value outweighs all the distance that the fleet can save.

        Values keep their exact proportions if all are whole, or all multiples of the smallest, and at most ``finest``. Others
        are rounded to a ``finest``-th of the greatest, or less finely where the sum would grow too large, and may then compare
        differently: also sums of them that were equal.

        :param finest: Greatest prize, in multiples of the smallest that outweighs all distances
        :param largest_sum: Bound of the sum of the prizes, so that a solver's integers do not overflow
        :return: ``(n,)`` int64
        """
        smallest_prize = self.n_uavs * RESOLUTION + 1
        finest = max(1, min(finest, largest_sum // (self.n_tasks * smallest_prize)))
        counts = np.maximum(1, np.rint(self.values / self.values.max() * finest)).astype(np.int64)
        for unit in (1.0, self.values.min()):
            with np.errstate(over="ignore"):
                multiples = self.values / unit
            whole = np.rint(multiples)
            if whole.max() <= finest and (np.abs(multiples - whole) <= _MULTIPLE_TOLERANCE * multiples).all():
                counts = whole.astype(np.int64)
                break
        return counts // np.gcd.reduce(counts) * smallest_prize

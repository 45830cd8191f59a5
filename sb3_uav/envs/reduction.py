"""What general-purpose solvers need of an instance: the tasks worth visiting, with scaled or integer distances and prizes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise

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
# Tasks that must be served are worth this many times what all others are together, and of one another no more than this
# part, see Instances.prizes.
_OUTWEIGHING, _ALIKE = 2.0, 1.5
# The maximum flight distance in integers, for costs.
RESOLUTION = 2_000_000
# The same for limits: so fine that rounding up every leg of a tour, of up to 17,000, stays within the usable tolerance. Even,
# so that it never forbids a flight to a reachable task either. A UAV that flies a thousandth as far as the one that flies
# farthest has a thousandth of these legs.
FINE_RESOLUTION = 2**45


@dataclass(frozen=True)
class UavKind:
    """
    UAVs that fly from the same place to the same place, equally far.

    :param start: The node where they are
    :param end: The node where they have to arrive
    :param limit: How far each can fly, 1 for those of the instance that fly farthest
    :param members: Their numbers in the instance, in ascending order
    """

    start: int
    end: int
    limit: float
    members: Sequence[int]


@dataclass(frozen=True)
class _Fleet:
    """
    Kinds of UAVs before it is known which can be of use; lengths are in the unit of the coordinates.

    :param start: ``(n_kinds, 2)``
    :param end: ``(n_kinds, 2)``
    :param limit: ``(n_kinds,)``, in units of the greatest
    :param members: Numbers of the UAVs of each kind
    """

    start: np.ndarray
    end: np.ndarray
    limit: np.ndarray
    members: list[Sequence[int]]

    @classmethod
    def of(cls, instance: Instances) -> _Fleet:
        """
        :param instance: A batch of one
        :return: Its fleet
        """
        if instance.has_equal_uavs:
            # An absurdly large fleet takes no memory.
            depot = instance.depot.numpy()
            return cls(depot, depot, np.ones(1), [range(instance.n_uavs)])
        start, end, distance = (
            field[0].numpy() for field in (instance.uav_start, instance.uav_end, instance.uav_distance[..., None])
        )
        # Adding 0 turns -0 into 0.
        uavs = np.concatenate([start, end, distance / distance.max()], axis=1) + 0.0
        kinds, first, kind_of = np.unique(uavs, axis=0, return_index=True, return_inverse=True)
        members = np.split(kind_of.ravel().argsort(kind="stable"), np.bincount(kind_of.ravel()).cumsum()[:-1])
        order = first.argsort()
        kinds = kinds[order]
        return cls(kinds[:, :2], kinds[:, 2:4], kinds[:, 4], [members[kind].tolist() for kind in order])

    def select(self, useful: np.ndarray) -> tuple[np.ndarray, tuple[UavKind, ...]]:
        """
        :param useful: ``(n_kinds,)`` bool
        :return: The sites of these kinds, ``(n_sites, 2)``, and the kinds
        """
        if self.end is self.start:
            # One kind, at the depot: without the time that sorting takes.
            sites, start, end = self.start[useful], [0], [0]
        else:
            sites, site_of = np.unique(np.concatenate([self.start[useful], self.end[useful]]), axis=0, return_inverse=True)
            start, end = site_of.reshape(2, -1).tolist()
        members = [self.members[kind] for kind in np.flatnonzero(useful)]
        return sites, tuple(map(UavKind, start, end, self.limit[useful].tolist(), members))


def _distances(a: np.ndarray, b: np.ndarray, unit: float) -> np.ndarray:
    """
    :param a: ``(n, 2)``
    :param b: ``(m, 2)``
    :param unit: What to measure in
    :return: ``(n, m)``
    """
    return np.hypot(*(x[:, None] - y for x, y in zip(a.T, b.T, strict=True))) / unit


@dataclass(frozen=True)
class ReducedInstance:
    """
    An instance without the tasks that no schedule can reach or that are worth nothing, and without the UAVs that can serve
    none of the others.

    The first nodes are the sites, where UAVs start or end: node 0, the depot, where that is where all do. Node
    ``n_sites + i`` is task ``tasks[i]``. Distances are scaled: a tour is feasible if its length is at most the limit of its
    UAV. What serving a task costs is part of them, half of it on the way there and half on the way on, so that they are
    symmetric and keep the triangle inequality.

    UAVs are numbered from 0 here, those of each kind one after the other, and no more of a kind than there are tasks.

    :param tasks: ``(n,)`` int64, indices of the remaining tasks; possibly none
    :param values: ``(n,)`` float64, all positive; what must be served is a matter of value here, see
        :attr:`~sb3_uav.envs.instances.Instances.prizes`
    :param distances: ``(n_sites + n, n_sites + n)`` float64, between nodes
    :param kinds: The UAVs; none if there are no tasks
    :param fleet_size: Number of UAVs of the instance
    """

    tasks: np.ndarray
    values: np.ndarray
    distances: np.ndarray
    kinds: tuple[UavKind, ...]
    fleet_size: int

    @classmethod
    def of(cls, instance: Instances) -> ReducedInstance:
        """
        :param instance: A batch of one
        :return: Its reduction
        """
        points, values = instance.tasks[0].numpy(), instance.prizes[0].numpy()
        unit = float(instance.unit[0]) * (1 + USABLE_TOLERANCE)
        service = None if instance.service is None else instance.service[0].numpy() / unit
        fleet = _Fleet.of(instance)
        outward = _distances(fleet.start, points, unit)
        length = outward + (outward if fleet.end is fleet.start else _distances(fleet.end, points, unit))
        if service is not None:
            length += service
        reach = length <= fleet.limit[:, None]
        (tasks,) = np.nonzero(instance.task_mask[0].numpy() & (values > 0) & reach.any(0))
        sites, kinds = fleet.select(reach[:, tasks].any(1))
        nodes = np.vstack([sites, points[tasks]])
        distances = _distances(nodes, nodes, unit)
        if service is not None:
            half = np.concatenate([np.zeros(len(sites)), service[tasks] / 2])
            distances += half[:, None] + half
            np.fill_diagonal(distances, 0.0)
        return cls(tasks, values[tasks], distances, kinds, instance.n_uavs)

    @property
    def n_tasks(self) -> int:
        return len(self.tasks)

    @property
    def n_sites(self) -> int:
        return len(self.distances) - len(self.tasks)

    @cached_property
    def uavs(self) -> tuple[UavKind, ...]:
        """The kind of every UAV that can be of use."""
        return tuple(kind for kind in self.kinds for _ in kind.members[: self.n_tasks])

    def uavs_of_kinds(self) -> list[range]:
        """:return: The numbers of the UAVs of each kind here, not in the instance"""
        last = list(accumulate(min(len(kind.members), self.n_tasks) for kind in self.kinds))
        return [range(first, end) for first, end in zip([0, *last], last, strict=False)]

    @property
    def n_uavs(self) -> int:
        """How many UAVs can be of use: of a kind never more than there are tasks."""
        return len(self.uavs)

    @property
    def limits(self) -> np.ndarray:
        """How far each UAV can fly, ``(n_uavs,)``."""
        return np.array([uav.limit for uav in self.uavs])

    def schedule(self, routes: Sequence[Iterable[int]]) -> Schedule:
        """
        :param routes: Nodes in flying order, without start and end, of UAV after UAV; missing routes are empty
        :return: The schedule of the whole fleet
        """
        numbers = [number for kind in self.kinds for number in kind.members[: self.n_tasks]]
        found: list[list[int]] = [[]] * self.fleet_size
        for number, route in zip(numbers, routes, strict=False):
            found[number] = [self.tasks[node - self.n_sites] for node in route]
        return Schedule(found)

    def routes(self, schedule: Schedule) -> list[list[int]]:
        """
        :param schedule: A schedule of the instance
        :return: Its routes as nodes, of UAV after UAV, without the tasks that are worth nothing; routes of equal UAVs are
            those of the first of them, and trailing empty routes are left out
        """
        node_of = {int(task): node for node, task in enumerate(self.tasks, start=self.n_sites)}
        flown = {
            number: route
            for number, tasks in enumerate(schedule.routes)
            if (route := [node_of[task] for task in tasks if task in node_of])
        }
        return self.of_kinds([[flown[number] for number in flown if number in kind.members] for kind in self.kinds])

    def of_kinds(self, routes: Sequence[list[list[int]]]) -> list[list[int]]:
        """
        :param routes: Routes of the UAVs of each kind, no more than there are useful ones
        :return: Routes of UAV after UAV; trailing empty routes are left out
        """
        of_uavs = []
        for uavs, own in zip(self.uavs_of_kinds(), routes, strict=True):
            of_uavs += own + [[] for _ in range(len(uavs) - len(own))]
        while of_uavs and not of_uavs[-1]:
            del of_uavs[-1]
        return of_uavs

    def coarse_distances(self) -> np.ndarray:
        """
        Rounded down: every feasible tour is at most as long as :meth:`coarse_limit` says, but a tour of this length may be
        infeasible by one unit per leg. Between sites it is 0: a UAV without tasks costs nothing.

        :return: ``(n_sites + n, n_sites + n)`` int64
        """
        return np.floor(self._legs() * RESOLUTION).astype(np.int64)

    @staticmethod
    def coarse_limit(kind: UavKind) -> int:
        """:return: How far such a UAV can fly, :data:`RESOLUTION` for those that fly farthest"""
        return math.floor(kind.limit * RESOLUTION)

    def arc_costs(self) -> np.ndarray:
        """
        Rounded up, in the units of :meth:`coarse_distances`: for comparing tours, not for their limit.

        :return: ``(n_sites + n, n_sites + n)`` int64
        """
        return np.ceil(self._legs() * RESOLUTION).astype(np.int64)

    def fine_distances(self) -> np.ndarray:
        """
        Rounded up: a tour that keeps to :meth:`fine_limits` is feasible, and so does every tour that keeps to the maximum
        flight distance without any tolerance. Between sites it is 0.

        :return: ``(n_sites + n, n_sites + n)`` int64
        """
        return np.ceil(self._legs() * FINE_RESOLUTION).astype(np.int64)

    def fine_limits(self) -> np.ndarray:
        """:return: ``(n_uavs,)`` int64, :data:`FINE_RESOLUTION` for the UAVs that fly farthest"""
        return np.floor(self.limits * FINE_RESOLUTION).astype(np.int64)

    def _legs(self) -> np.ndarray:
        """:return: The distances, 0 between sites"""
        if self.n_sites == 1:
            return self.distances
        legs = self.distances.copy()
        legs[: self.n_sites, : self.n_sites] = 0.0
        return legs

    def tour(self, route: Iterable[int], uav: int = 0) -> tuple[int, ...]:
        """
        :param route: Nodes in flying order, without start and end
        :param uav: The UAV that flies it
        :return: The same with its start and its end
        """
        return self.uavs[uav].start, *route, self.uavs[uav].end

    def tour_length(self, route: Iterable[int], uav: int = 0) -> float:
        """
        :param route: Nodes in flying order, without start and end
        :param uav: The UAV that flies it
        :return: Length of the tour from its start to its end, which is feasible if that is at most its limit
        """
        return math.fsum(self.distances[a, b] for a, b in pairwise(self.tour(route, uav)))

    def fits(self, route: Iterable[int], uav: int = 0) -> bool:
        """
        :param route: Nodes in flying order, without start and end
        :param uav: The UAV that flies it
        :return: Whether it can fly so far
        """
        return self.tour_length(route, uav) <= self.uavs[uav].limit

    def integer_prizes(self, finest: int, largest_sum: int) -> np.ndarray:
        """
        Prizes in units of distance, so that any gain of value outweighs all the distance that the fleet can save.

        Values keep their exact proportions if all are whole, or all multiples of the smallest, and not too great for that.
        Others are rounded to a ``finest``-th of the greatest (of those that need not be served), or less finely where the sum
        would grow too large, and may then compare differently: also sums of them that were equal.

        :param finest: Greatest prize of a task whose value is rounded, in multiples of the smallest that outweighs all
            distances
        :param largest_sum: Bound of the number of tasks times the greatest prize, so that a solver's integers do not overflow
        :return: ``(n,)`` int64
        """
        smallest_prize = self.n_uavs * RESOLUTION + 1
        greatest = max(1, largest_sum // (self.n_tasks * smallest_prize))
        finest = min(finest, greatest)
        ordinary = self.values[~self.is_dear]
        # Where a task is worth just twice as much as the others together, nothing says that it is not one of them.
        just_twice = _OUTWEIGHING * (1 + _MULTIPLE_TOLERANCE) * ordinary.sum()
        has_dear = len(ordinary) < self.n_tasks and self.values[self.is_dear].min() > just_twice
        reference = ordinary.max() if has_dear else self.values.max()
        finer = greatest * (reference / self.values.max())
        if not has_dear or finer < 1:
            counts = self.values / self.values.max() * finest
        else:
            counts = self.values / reference * min(finest, finer)
        counts = np.clip(np.rint(counts), 1, greatest).astype(np.int64)
        for unit in (1.0, self.values.min()):
            with np.errstate(over="ignore"):
                multiples = self.values / unit
            whole = np.rint(multiples)
            if whole.max() <= greatest and (np.abs(multiples - whole) <= _MULTIPLE_TOLERANCE * multiples).all():
                counts = whole.astype(np.int64)
                break
        return counts // np.gcd.reduce(counts) * smallest_prize

    @cached_property
    def is_dear(self) -> np.ndarray:
        """
        Which tasks have to be served, as far as can be seen: those of about the same value that outweigh all others together;
        none where there are no others. ``(n,)`` bool.
        """
        if self.n_tasks < 2:
            return np.zeros(self.n_tasks, dtype=bool)
        ordered = np.sort(self.values)
        smaller = np.cumsum(ordered)[:-1]
        outweighs = ordered[1:] >= _OUTWEIGHING * (1 - _MULTIPLE_TOLERANCE) * smaller
        outweighs &= ordered[-1] <= _ALIKE * (1 + _MULTIPLE_TOLERANCE) * ordered[1:]
        return self.values >= (ordered[1:][outweighs.argmax()] if outweighs.any() else np.inf)

    def total_value(self, routes: Iterable[Iterable[int]]) -> float:
        """
        :param routes: Routes as nodes
        :return: The total value of the tasks on them
        """
        return math.fsum(self.values[node - self.n_sites] for route in routes for node in route)

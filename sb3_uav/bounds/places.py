"""What bounds need of an instance: places with values, and kinds of UAVs that fly a little farther than allowed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sb3_uav.bounds.kernels import Fleet, Grid
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.envs.schedule import Schedule

# Tasks nearer to each other than this, in units of the maximum flight distance, are one place.
COINCIDENT = 1e-12
# By how much flights are longer here than the checker allows, relative to what each UAV can fly: for rounding errors.
_MARGIN = 1e-11
# The shortest limit, so that nothing is divided by 0.
_SHORTEST = 1e-12
# How many steps a flight has on the grid.
_N_STEPS = 1000
# How many places each place remembers at most: bits of an int32, without its sign.
MOST_NEAR = 24


@dataclass(frozen=True)
class Kind:
    """
    Equal UAVs.

    :param n_uavs: How many there are, of use
    :param distances: ``(n, n)``, between places, in units of what the UAV that flies farthest can fly
    :param outward: ``(n,)``, from the start
    :param homeward: ``(n,)``, to the end
    :param limit: How far each flies
    :param grid: Their lengths, rounded down
    :param backward: The same from the end to the start; the same object where that is one place
    """

    n_uavs: int
    distances: np.ndarray
    outward: np.ndarray
    homeward: np.ndarray
    limit: float
    grid: Grid
    backward: Grid

    def fleets(self, near: np.ndarray, position: np.ndarray) -> tuple[Fleet, Fleet]:
        """:return: The data of the kernels, from the start to the end and from the end to the start"""
        limit = np.array([self.limit, self.limit / 2])
        forward = Fleet(self.distances, self.outward, self.homeward, limit, near, position)
        if self.backward is self.grid:
            return forward, forward
        return forward, Fleet(self.distances, self.homeward, self.outward, limit, near, position)


@dataclass(frozen=True)
class Places:
    """
    An instance of which a bound is asked. What must be served counts by its value only.

    :param values: ``(n,)``, total value of each place
    :param kinds: The kinds of UAVs
    :param place_of: ``(n_tasks,)`` int64, of each task of the instance; -1 for those that no UAV reaches or that are worth
        nothing
    :param members: Numbers in the instance of the UAVs of each kind
    """

    values: np.ndarray
    kinds: tuple[Kind, ...]
    place_of: np.ndarray
    members: tuple[frozenset[int], ...]

    @classmethod
    def of(cls, instance: Instances) -> Places:
        """
        :param instance: A batch of one
        :return: Its places
        """
        # The reduction leaves a part of the checker's tolerance unused; a bound has to allow all of it.
        longer = replace(instance, max_distance=instance.max_distance * (1 + _MARGIN), must_serve=None)
        reduced = ReducedInstance.of(longer)
        first, n = reduced.n_sites, reduced.n_tasks
        place_of = np.full(instance.n_tasks, -1)
        if n == 0:
            return cls(np.zeros(0), (), place_of, ())
        owner = (reduced.distances[first:, first:] <= COINCIDENT).argmax(1)
        while (owner[owner] != owner).any():
            owner = owner[owner]
        kept, numbers = np.unique(owner, return_inverse=True)
        place_of[reduced.tasks] = numbers
        values = np.bincount(numbers, weights=reduced.values)
        # A task is off its place by that at most, on the way there and on the way on.
        slack = 2 * COINCIDENT * n * (n - len(kept))
        nodes = kept + first
        kinds = []
        for kind in reduced.kinds:
            between, outward, homeward = (
                np.ascontiguousarray(part)
                for part in (
                    reduced.distances[np.ix_(nodes, nodes)],
                    reduced.distances[kind.start, nodes],
                    reduced.distances[nodes, kind.end],
                )
            )
            limit = max(kind.limit * (1 + _MARGIN) + slack, _SHORTEST)
            n_uavs = min(len(kind.members), len(kept))
            if kind.start == kind.end:
                homeward = outward
            grid = _grid(between, homeward, limit)
            backward = grid if kind.start == kind.end else _grid(between, outward, limit)
            kinds.append(Kind(n_uavs, between, outward, homeward, limit, grid, backward))
        return cls(values, tuple(kinds), place_of, tuple(frozenset(kind.members) for kind in reduced.kinds))

    @property
    def n(self) -> int:
        return len(self.values)

    def routes(self, schedule: Schedule) -> list[tuple[int, list[int]]]:
        """
        :param schedule: A schedule of the instance
        :return: Kind and places of every route that serves something
        """
        found = []
        for uav, route in enumerate(schedule.routes):
            places = [int(place) for place in dict.fromkeys(self.place_of[list(route)].tolist()) if place >= 0]
            kinds = [kind for kind, members in enumerate(self.members) if uav in members]
            if places and kinds:
                found.append((kinds[0], places))
        return found


def _grid(distances: np.ndarray, homeward: np.ndarray, limit: float) -> Grid:
    """
    :param distances: ``(n, n)``
    :param homeward: ``(n,)``
    :param limit: How far a UAV flies
    :return: Its grid
    """
    step = limit / _N_STEPS

    def steps(lengths: np.ndarray) -> np.ndarray:
        return np.clip(np.floor(lengths / step - 1e-9), 0, _N_STEPS + 1).astype(np.int64)

    n = len(distances)
    near = steps(distances) == 0
    cluster = np.arange(n)
    while True:
        least = np.where(near, cluster, n).min(1)
        if (least == cluster).all():
            break
        cluster = least
    _, cluster = np.unique(cluster, return_inverse=True)
    size = np.bincount(cluster)
    only = np.full(len(size), -1)
    for place in range(n):
        if size[cluster[place]] == 1:
            only[cluster[place]] = place
    legs = np.full((len(size), len(size)), np.inf)
    np.minimum.at(legs, (cluster[:, None], cluster[None, :]), distances)
    home = np.full(len(size), np.inf)
    np.minimum.at(home, cluster, homeward)
    legs_in_steps = steps(legs)
    np.fill_diagonal(legs_in_steps, -1)
    order = legs_in_steps.argsort(1, kind="stable")[:, 1:]
    return Grid(step, cluster, only, legs_in_steps, np.ascontiguousarray(order), steps(home))


def near_lists(distances: np.ndarray, n_near: int) -> tuple[np.ndarray, np.ndarray]:
    """
    :param distances: ``(n, n)``
    :param n_near: How many neighbors each place remembers, itself included
    :return: ``near`` and ``position`` of :class:`~sb3_uav.bounds.kernels.Fleet`
    """
    n = len(distances)
    own = distances.copy()
    np.fill_diagonal(own, -1.0)
    ranked = own.argsort(1, kind="stable")[:, :n_near]
    near = np.full((n, MOST_NEAR), -1)
    near[:, : ranked.shape[1]] = ranked[:, :MOST_NEAR]
    return near, positions(near)


def positions(near: np.ndarray) -> np.ndarray:
    """
    :param near: ``(n, MOST_NEAR)`` int64, -1 where there are fewer
    :return: ``(n, n)`` int8, see :class:`~sb3_uav.bounds.kernels.Fleet`
    """
    position = np.full((len(near), len(near)), -1, np.int8)
    rows, slots = np.nonzero(near >= 0)
    position[rows, near[rows, slots]] = slots
    return position


def value_unit(values: np.ndarray) -> float:
    """
    :param values: ``(n,)``, of tasks
    :return: What all sums of them are multiples of; 0 if they are not whole or too large to say
    """
    if len(values) == 0 or values.max() > 2**40 or (values != np.rint(values)).any():
        return 0.0
    return float(math.gcd(*values.astype(np.int64).tolist()))

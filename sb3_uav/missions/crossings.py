"""Places where two UAVs fly over the same point at one altitude."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan, Route

#: Below this many meters between them, two altitudes count as one: barometers and GPS are not better.
SEPARATION_M = 5.0
# Within this many meters, two points on the ground are the same.
_SAME_PLACE_M = 1.0
# Two legs are parallel if the sine of their angle is below this.
_PARALLEL = 1e-9
_BLOCK = 512


@dataclass(frozen=True)
class Crossing:
    """
    Two legs that cross.

    :param uavs: The two UAVs, by their numbers from 0
    :param legs: The leg of each, by its number from 0, which is the number of stops before it
    :param point: ``(2,)``, where, in the user's coordinates
    """

    uavs: tuple[int, int]
    legs: tuple[int, int]
    point: np.ndarray


@dataclass(frozen=True)
class _Legs:
    """
    The legs of a UAV.

    :param a: ``(n, 3)``, their first points, in meters, with the altitude
    :param b: ``(n, 3)``, their last points
    :param sites: ``(2, 2)``, where it takes off and lands
    """

    a: np.ndarray
    b: np.ndarray
    sites: np.ndarray

    @property
    def altitudes(self) -> tuple[float, float]:
        """The lowest and the highest, in meters; both infinite, and the wrong way round, without legs."""
        both = np.concatenate([self.a[:, 2], self.b[:, 2]])
        return float(both.min(initial=np.inf)), float(both.max(initial=-np.inf))

    @classmethod
    def of(cls, plan: Plan, uav: int, route: Route, flight: FlightOptions) -> _Legs:
        """
        :param plan: The plan
        :param uav: Number of the UAV
        :param route: Its route
        :param flight: Says at which altitude it flies
        :return: Its legs; none if it stays where it is
        """
        plane = plan.tasks.coordinates().to_plane(route.points)
        own = flight.altitude_of(plan.fleet.level_of(uav))
        wanted = plan.tasks.altitudes[list(route.stops)]
        altitudes = np.array([own, *np.where(np.isnan(wanted), own, wanted), own])
        points = np.column_stack([plane, altitudes])
        flown = route.legs_m > 0
        return cls(points[:-1][flown], points[1:][flown], plane[[0, -1]])


def find_crossings(plan: Plan, flight: FlightOptions) -> list[Crossing]:
    """
    Crossings where UAVs take off or land together are left out: there it is the order that keeps them apart.

    :param plan: A plan
    :param flight: Says how high the UAVs fly
    :return: All pairs of legs of different UAVs that cross or overlap with less than :data:`SEPARATION_M` between them
    """
    flown = [_Legs.of(plan, uav, route, flight) for uav, route in enumerate(plan.routes)]
    numbers = [np.flatnonzero(route.legs_m > 0) for route in plan.routes]
    coordinates = plan.tasks.coordinates()
    found = []
    # Most pairs of UAVs never come to one altitude, and there may be many pairs.
    heights = [legs.altitudes for legs in flown]
    for u, v in itertools.combinations([uav for uav, legs in enumerate(flown) if len(legs.a)], 2):
        if max(heights[u][0], heights[v][0]) - min(heights[u][1], heights[v][1]) >= SEPARATION_M:
            continue
        for begin in range(0, len(flown[u].a), _BLOCK):
            block = _Legs(flown[u].a[begin : begin + _BLOCK], flown[u].b[begin : begin + _BLOCK], flown[u].sites)
            for i, j, point in _pairs(block, flown[v]):
                legs = int(numbers[u][begin + i]), int(numbers[v][j])
                found.append(Crossing((u, v), legs, coordinates.from_plane(point[None])[0]))
    return found


def _pairs(first: _Legs, second: _Legs) -> list[tuple[int, int, np.ndarray]]:
    """
    :param first: ``m`` legs
    :param second: ``n`` legs
    :return: Numbers of two legs that cross at one altitude, and where
    """
    if not len(first.a) or not len(second.a):
        return []
    along, other = (first.b - first.a)[:, None], (second.b - second.a)[None]
    between = second.a[None] - first.a[:, None]
    lengths = np.hypot(along[..., 0], along[..., 1]), np.hypot(other[..., 0], other[..., 1])
    sine = _cross(along, other)
    parallel = np.abs(sine) <= _PARALLEL * lengths[0] * lengths[1]
    divisor = np.where(parallel, 1.0, sine)
    t, s = _cross(between, other) / divisor, _cross(between, along) / divisor
    slack = 1e-9
    crosses = ~parallel & (t >= -slack) & (t <= 1 + slack) & (s >= -slack) & (s <= 1 + slack)
    # Parallel legs overlap if they lie on one line and share more than a point of it.
    squared = lengths[0] ** 2
    ends = [(to[..., :2] * along[..., :2]).sum(-1) / squared for to in (between, between + other)]
    low, high = np.maximum(np.minimum(*ends), 0.0), np.minimum(np.maximum(*ends), 1.0)
    on_line = np.abs(_cross(between, along)) <= _SAME_PLACE_M * lengths[0]
    overlaps = parallel & on_line & ((high - low) * lengths[0] > _SAME_PLACE_M)
    middle = (low + high) / 2
    span = np.where(overlaps, ends[1] - ends[0], 1.0)
    t, s = np.where(overlaps, middle, t), np.where(overlaps, (middle - ends[0]) / span, s)
    i, j = np.nonzero(crosses | overlaps)
    t, s = np.clip(t[i, j], 0, 1)[:, None], np.clip(s[i, j], 0, 1)[:, None]
    here, there = first.a[i] + t * along[i, 0], second.a[j] + s * other[0, j]
    shared = _is_near(here[:, :2], first.sites) & _is_near(here[:, :2], second.sites)
    chosen = (np.abs(here[:, 2] - there[:, 2]) < SEPARATION_M) & ~shared
    return [(int(m), int(n), point) for m, n, point in zip(i[chosen], j[chosen], here[chosen, :2], strict=True)]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    product: np.ndarray = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    return product


def _is_near(points: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """:return: ``(n,)`` bool, whether a point is one of the sites"""
    near: np.ndarray = (np.hypot(*(points[:, None] - sites).transpose(2, 0, 1)) <= _SAME_PLACE_M).any(axis=1)
    return near

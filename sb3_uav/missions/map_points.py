"""A plan in meters around its depot, as maps show it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.tasks import TaskList

# How many times larger than what is flown the map may be.
_MAX_RATIO = 5.0


class MapPoints(NamedTuple):
    """
    Positions in meters, the first coordinate to the right (east, or x) and the second up (north, or y), the depot at 0.

    :param tasks: ``(n, 2)``
    :param routes: ``(n_stops + 2, 2)`` of every UAV, start, stops and end; of a UAV that stays where it is the start twice
    :param spacing: How far a stop typically is from the one that is nearest to it, 0 with less than 2 stops
    :param focus: ``(2, 2)``, the lower left and the upper right corner of what is flown, with the depot
    :param whole: The same of everything
    """

    tasks: np.ndarray
    routes: tuple[np.ndarray, ...]
    spacing: float
    focus: np.ndarray
    whole: np.ndarray

    @property
    def is_focused(self) -> bool:
        """Whether a map of everything would show too little of what is flown, because some tasks lie far away."""
        flown, everything = (float(np.ptp(corners, axis=0).max()) for corners in (self.focus, self.whole))
        return 0 < flown * _MAX_RATIO < everything

    @property
    def extent(self) -> float:
        """The longer side in meters of what a map shows at first, not 0."""
        corners = self.focus if self.is_focused else self.whole
        return float(np.ptp(corners, axis=0).max()) or 1.0

    @property
    def n_outside(self) -> int:
        """How many tasks are not on what a map shows at first."""
        low, high = self.focus
        return int((~((self.tasks >= low) & (self.tasks <= high)).all(axis=1)).sum()) if self.is_focused else 0


def map_points(plan: Plan) -> MapPoints:
    """
    :param plan: A plan
    :return: Its positions. Latitudes and longitudes lie in the plane in which the plan was made, so a mission across the
        antimeridian is in one piece
    """
    tasks = from_depot(plan.tasks, plan.tasks.points)
    routes = tuple(_grounded(route, from_depot(plan.tasks, route.points)) for route in plan.routes)
    flown = np.vstack([np.zeros((1, 2)), *routes])
    everything = np.vstack([flown, tasks])
    focus, whole = (np.array([points.min(axis=0), points.max(axis=0)]) for points in (flown, everything))
    stops = tasks[[stop for route in plan.routes for stop in route.stops]]
    return MapPoints(tasks, routes, spacing_of(stops), focus, whole)


def from_depot(tasks: TaskList, points: np.ndarray) -> np.ndarray:
    """
    :param tasks: Tasks with a depot
    :param points: ``(n, 2)`` in their coordinates
    :return: ``(n, 2)``, meters to the right of the depot and up
    :raises ValueError: If there is no depot
    """
    coordinates = tasks.coordinates()
    assert tasks.depot is not None
    offsets: np.ndarray = coordinates.to_plane(points) - coordinates.to_plane(tasks.depot[None])
    return offsets


def spacing_of(points: np.ndarray) -> float:
    """
    :param points: ``(n, 2)``
    :return: Median of the lengths from every point to the one nearest to it; 0 with less than 2 points
    """
    if len(points) < 2:
        return 0.0
    nearest = np.empty(len(points))
    # In blocks, so that many points need little memory.
    for start in range(0, len(points), 500):
        block = points[start : start + 500]
        lengths = np.hypot(*(block[:, None] - points).transpose(2, 0, 1))
        lengths[np.arange(len(block)), np.arange(start, start + len(block))] = np.inf
        nearest[start : start + 500] = lengths.min(axis=1)
    return float(np.median(nearest))


def _grounded(route: Route, points: np.ndarray) -> np.ndarray:
    """Do not draw a flight to an end that an idle UAV does not fly."""
    return points if route.flies else points[[0, 0]]

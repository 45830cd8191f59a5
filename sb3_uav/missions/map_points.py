"""A plan in meters around its depot, as maps show it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_uav.missions.labels import flies
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.tasks import TaskList


class MapPoints(NamedTuple):
    """
    Positions in meters, the first coordinate to the right (east, or x) and the second up (north, or y), the depot at 0.

    :param tasks: ``(n, 2)``
    :param routes: ``(n_stops + 2, 2)`` of every UAV, start, stops and end; of a UAV that stays where it is the start twice
    :param spacing: How far a stop typically is from the one that is nearest to it, 0 with less than 2 stops
    :param extent: The longer side of the smallest rectangle around everything, not 0
    """

    tasks: np.ndarray
    routes: tuple[np.ndarray, ...]
    spacing: float
    extent: float


def map_points(plan: Plan) -> MapPoints:
    """
    :param plan: A plan
    :return: Its positions. Latitudes and longitudes lie in the plane in which the plan was made, so a mission across the
        antimeridian is in one piece
    """
    tasks = from_depot(plan.tasks, plan.tasks.points)
    routes = tuple(_grounded(route, from_depot(plan.tasks, route.points)) for route in plan.routes)
    everything = np.vstack([np.zeros((1, 2)), tasks, *routes])
    extent = float(np.ptp(everything, axis=0).max()) or 1.0
    stops = tasks[[stop for route in plan.routes for stop in route.stops]]
    return MapPoints(tasks, routes, spacing_of(stops), extent)


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
    return points if flies(route) else points[[0, 0]]

"""Old routes in a new situation: what of them still fits, and how to keep their order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from sb3_uav.envs.distances import DISTANCE_TOLERANCE
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule

_Point = list[float]


class OldRoutes:
    """
    :param instance: A batch of one
    :param routes: What is left of the route of every UAV
    """

    def __init__(self, instance: Instances, routes: Sequence[Sequence[int]]) -> None:
        self._routes = [list(route) for route in routes]
        self._points: list[_Point] = instance.tasks[0].tolist()
        self._service: list[float] = instance.service_cost[0].tolist()
        self._values: list[float] = instance.values[0].tolist()
        must = instance.must_serve
        self._must: list[bool] = [False] * len(self._points) if must is None else must[0].tolist()
        self._starts: list[_Point] = instance.uav_start[0].tolist()
        self._ends: list[_Point] = instance.uav_end[0].tolist()
        # What the checker admits.
        self._limits = [limit + DISTANCE_TOLERANCE * limit for limit in instance.uav_distance[0].tolist()]

    def fitting(self) -> Schedule:
        """
        :return: The routes without the stops that are worth least for the range that they take, those that must be served
            last, until every UAV can fly its own
        """
        return Schedule(self._fitting(uav, route) for uav, route in enumerate(self._routes))

    def in_old_order(self, schedule: Schedule) -> Schedule:
        """
        :param schedule: A feasible schedule
        :return: The same stops for every UAV, in their old order with the new ones where they cost least, wherever the range
            admits it and more of the old legs are kept
        """
        routes = []
        for uav, (old, given) in enumerate(zip(self._routes, schedule.routes, strict=True)):
            stops = [task for task in old if task in set(given)]
            for task in given:
                if task not in set(old):
                    stops.insert(self._cheapest(uav, stops, self._points[task]), task)
            is_better = self._kept(old, stops) > self._kept(old, given) and self._length(uav, stops) <= self._limits[uav]
            routes.append(stops if is_better else list(given))
        return Schedule(routes)

    def _fitting(self, uav: int, route: Sequence[int]) -> list[int]:
        stops = list(route)
        if math.dist(self._starts[uav], self._ends[uav]) > self._limits[uav]:
            return []
        while stops and self._length(uav, stops) > self._limits[uav]:
            way = self._way(uav, stops)
            worth = []
            for place, task in enumerate(stops):
                before, here, after = way[place : place + 3]
                saved = math.dist(before, here) + math.dist(here, after) - math.dist(before, after) + self._service[task]
                worth.append((self._must[task], self._values[task] / max(saved, 1e-9)))
            del stops[worth.index(min(worth))]
        return stops

    def _cheapest(self, uav: int, stops: Sequence[int], point: _Point) -> int:
        """:return: Before which stop to put a further one"""
        way = self._way(uav, stops)
        added = [math.dist(a, point) + math.dist(point, b) - math.dist(a, b) for a, b in pairwise(way)]
        return added.index(min(added))

    def _way(self, uav: int, stops: Sequence[int]) -> list[_Point]:
        return [self._starts[uav], *(self._points[task] for task in stops), self._ends[uav]]

    def _length(self, uav: int, stops: Sequence[int]) -> float:
        """As the checker measures it."""
        length = 0.0
        for a, b in pairwise(self._way(uav, stops)):
            length += math.hypot(a[0] - b[0], a[1] - b[1])
        return length + math.fsum(self._service[task] for task in stops)

    @staticmethod
    def _kept(old: Sequence[int], new: Sequence[int]) -> int:
        """:return: Number of legs that are in both"""
        return len(set(pairwise([-1, *old, -1])) & set(pairwise([-1, *new, -1])))

"""Making feasible what a solver found with rounded distances, at the least loss of value."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.solvers.insertion import insert_greedily


def with_feasible_tours(reduced: ReducedInstance, routes: Sequence[Sequence[int]]) -> list[list[int]]:
    """
    Shorten the tours that are too long, first in another order of their tasks, then without some of them; then fill the gaps.

    :param reduced: What is planned
    :param routes: At most one route per useful UAV, in their order, as nodes; no task twice
    :return: Feasible routes, the given ones if they are feasible
    """
    fitting = [_shortened(reduced, route, uav) for uav, route in enumerate(routes)]
    if all(len(short) == len(route) for short, route in zip(fitting, routes, strict=True)):
        return fitting
    return insert_greedily(reduced, fitting, dear_first=True)


def _shortened(reduced: ReducedInstance, route: Sequence[int], uav: int) -> list[int]:
    """
    :param reduced: What is planned
    :param route: A route, as nodes
    :param uav: The UAV that flies it
    :return: The route, in another order or without some tasks if it was too long
    """
    route = list(route)
    limit = reduced.uavs[uav].limit
    if not reduced.fits(route, uav):
        route = _reordered(reduced, route, uav)
    while route and (length := reduced.tour_length(route, uav)) > limit:
        rests = [route[:place] + route[place + 1 :] for place in range(len(route))]
        lengths = [reduced.tour_length(rest, uav) for rest in rests]
        # The least valuable task of those that suffice, if one does; of equal ones, the one whose detour is longest.
        suffices = min(lengths) <= limit
        places = [place for place in range(len(route)) if not suffices or lengths[place] <= limit]
        out = min(places, key=lambda place: (reduced.values[route[place] - reduced.n_sites], lengths[place]))
        if lengths[out] >= length:
            # Only tasks on a straight way between others add no length: take the one that is farthest from the start.
            out = max(range(len(route)), key=lambda place: reduced.distances[reduced.uavs[uav].start, route[place]])
        route = rests[out]
    return route


def _reordered(reduced: ReducedInstance, route: list[int], uav: int) -> list[int]:
    """
    :param reduced: What is planned
    :param route: A route, as nodes
    :param uav: The UAV that flies it
    :return: Its tasks in an order that no reversal of a part makes shorter, or the first such order that is short enough
    """
    limit = reduced.uavs[uav].limit
    length = reduced.tour_length(route, uav)
    improved = True
    while improved and length > limit:
        improved = False
        for first, last in combinations(range(len(route) + 1), 2):
            other = route[:first] + route[first:last][::-1] + route[last:]
            if (found := reduced.tour_length(other, uav)) < length:
                route, length, improved = other, found, True
    return route

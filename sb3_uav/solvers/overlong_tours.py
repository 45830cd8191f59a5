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
    :param routes: At most one route per useful UAV, as nodes; no task twice
    :return: Feasible routes, the given ones if they are feasible
    """
    fitting = [_shortened(reduced, route) for route in routes]
    if all(len(short) == len(route) for short, route in zip(fitting, routes, strict=True)):
        return fitting
    return insert_greedily(reduced, fitting)


def _shortened(reduced: ReducedInstance, route: Sequence[int]) -> list[int]:
    """
    :param reduced: What is planned
    :param route: A route, as nodes
    :return: The route, in another order or without some tasks if it was too long
    """
    route = list(route)
    if reduced.tour_length(route) > 1.0:
        route = _reordered(reduced, route)
    while (length := reduced.tour_length(route)) > 1.0:
        rests = [route[:place] + route[place + 1 :] for place in range(len(route))]
        lengths = [reduced.tour_length(rest) for rest in rests]
        # The least valuable task of those that suffice, if one does; of equal ones, the one whose detour is longest.
        suffices = min(lengths) <= 1.0
        places = [place for place in range(len(route)) if not suffices or lengths[place] <= 1.0]
        out = min(places, key=lambda place: (reduced.values[route[place] - 1], lengths[place]))
        if lengths[out] >= length:
            # Only tasks on a straight way between others add no length: take the one that is farthest from the depot.
            out = max(range(len(route)), key=lambda place: reduced.distances[0, route[place]])
        route = rests[out]
    return route


def _reordered(reduced: ReducedInstance, route: list[int]) -> list[int]:
    """
    :param reduced: What is planned
    :param route: A route, as nodes
    :return: Its tasks in an order that no reversal of a part makes shorter, or the first such order that is short enough
    """
    length = reduced.tour_length(route)
    improved = True
    while improved and length > 1.0:
        improved = False
        for first, last in combinations(range(len(route) + 1), 2):
            other = route[:first] + route[first:last][::-1] + route[last:]
            if (found := reduced.tour_length(other)) < length:
                route, length, improved = other, found, True
    return route

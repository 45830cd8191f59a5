"""The routes that are worth more than they cost, and how much a route can be worth at most."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_uav.bounds import kernels
from sb3_uav.bounds.kernels import Completion, Fleet, Grid, Labels
from sb3_uav.bounds.places import Kind

# Lengths of routes are sorted into so many buckets.
_N_BUCKETS = 32
# How many labels are continued between two looks at the clock.
_CHUNK = 500
# How many routes one search returns.
_MOST_ROUTES = 60


class Found(NamedTuple):
    """
    :param routes: Routes that are worth more than the threshold, the best first
    :param most: What any route is worth at most
    :param is_complete: Whether the search came to its end
    """

    routes: list[list[int]]
    most: float
    is_complete: bool


class LabelMemory:
    """Memory for the labels of both directions, used again and again; it grows as needed."""

    def __init__(self) -> None:
        self._labels = [np.zeros(0, kernels.LABEL), np.zeros(0, kernels.LABEL)]

    def of(self, direction: int, n_places: int, n_labels: int) -> Labels:
        """
        :param direction: 0 or 1
        :param n_places: Number of places
        :param n_labels: Of labels
        :return: Memory, not filled
        """
        n_labels += n_places
        if len(self._labels[direction]) < n_labels:
            self._labels[direction] = np.zeros(n_labels, kernels.LABEL)
        return Labels(
            self._labels[direction][:n_labels],
            np.zeros((n_places, _N_BUCKETS), np.int32),
            np.zeros((n_places, _N_BUCKETS)),
            np.zeros(_N_BUCKETS, np.int32),
            np.zeros(4, np.int64),
        )


class _Direction:
    """
    Routes from one end.

    :param grid: Lengths, rounded down
    :param fleet: The UAVs
    :param profits: ``(n,)``
    """

    def __init__(self, grid: Grid, fleet: Fleet, profits: np.ndarray) -> None:
        self.grid, self.fleet, self.profits = grid, fleet, profits
        n_clusters = len(grid.only)
        limit = fleet.limit[0]
        shape = (round(limit / grid.step) + 1, n_clusters)
        of_clusters = np.bincount(grid.cluster, weights=profits, minlength=n_clusters)
        self.completion = Completion(np.empty(shape), np.empty(shape, np.int32), np.empty(shape), of_clusters)
        kernels.complete(grid, of_clusters, *self.completion[:3])
        left = ((limit - fleet.outward) / grid.step + 1e-9).astype(np.int64)
        can = (fleet.outward + fleet.homeward <= limit) & (profits > 0)
        clusters = grid.cluster[can]
        self.most = float((self.completion.best[left[can], clusters] + of_clusters[clusters]).max(initial=0.0))

    def search(self, threshold: float, exact: bool, found: Labels, is_late: Callable[[], bool]) -> bool:
        """
        :param threshold: Routes that are not worth more do not count
        :param exact: Whether no route may be missed
        :param found: Memory for labels, filled up to half of the length
        :param is_late: Says when to give up
        :return: Whether the search came to its end
        """
        data = (self.grid, self.fleet, self.completion, self.profits, threshold, found, exact)
        kernels.begin(*data)
        state = kernels.RUNNING
        while state == kernels.RUNNING and not is_late():
            state = kernels.proceed(*data, _CHUNK)
        return bool(state == kernels.FINISHED)


class Pricing:
    """
    One kind of UAVs at given prices.

    :param kind: The kind
    :param forward: The same for the kernels
    :param backward: The same from the end to the start; the same object where that is one place
    :param profits: ``(n,)``, value of each place less its price, >= 0
    :param memory: Memory for labels
    """

    def __init__(self, kind: Kind, forward: Fleet, backward: Fleet, profits: np.ndarray, memory: LabelMemory) -> None:
        self._profits, self._memory = profits, memory
        self._directions = [_Direction(kind.grid, forward, profits)]
        if backward is not forward:
            self._directions.append(_Direction(kind.backward, backward, profits))
        self.most = min(direction.most for direction in self._directions)

    def search(self, threshold: float, exact: bool, n_labels: int, is_late: Callable[[], bool]) -> Found:
        """
        :param threshold: Routes that are not worth more do not count
        :param exact: Whether the result is a bound; a faster search may miss the best routes
        :param n_labels: After how many labels to give up
        :param is_late: Says when to give up
        :return: What was found; what it bounds holds in any case
        """
        is_complete, halves = True, []
        for number, direction in enumerate(self._directions):
            found = self._memory.of(number, len(self._profits), n_labels)
            is_complete = direction.search(threshold, exact, found, is_late) and is_complete
            halves.append(found.labels[: int(found.state[0])])
        front, back = halves[0], halves[-1]
        routes = _whole_routes(front, threshold)
        if back is not front:
            routes += [(profit, route[::-1]) for profit, route in _whole_routes(back, threshold)]
        routes += self._joined(front, back, threshold)
        routes.sort(key=lambda pair: -pair[0])
        best = max([threshold, *(profit for profit, _ in routes)])
        most = min(self.most, best) if exact and is_complete else self.most
        return Found([route for _, route in routes[:_MOST_ROUTES]], most, is_complete)

    def _joined(self, front: np.ndarray, back: np.ndarray, threshold: float) -> list[tuple[float, list[int]]]:
        """
        :param front: Beginnings of routes
        :param back: Ends of routes
        :param threshold: Routes that are not worth more do not count
        :return: Profits and places of the best routes that are longer than half a flight both ways
        """
        n = len(self._profits)
        starts, ends = (np.flatnonzero(half["alive"] == 1) for half in (front, back))
        ends = ends[np.lexsort((-back["profit"][ends], back["place"][ends]))]
        first = np.searchsorted(back["place"][ends], np.arange(n + 1))
        best, own, other = np.full(n, threshold), np.full(n, -1), np.full(n, -1)
        kernels.join(self._directions[0].fleet, front[starts], back[ends], first, best, own, other)
        return [
            (float(best[k]), _route(front, int(starts[own[k]])) + _route(back, int(ends[other[k]]))[::-1])
            for k in np.flatnonzero(own >= 0)
        ]


def _whole_routes(labels: np.ndarray, threshold: float) -> list[tuple[float, list[int]]]:
    """
    :param labels: Beginnings of routes, which may end where they are
    :param threshold: Routes that are not worth more do not count
    :return: Profit and places of the best that ends at each place
    """
    good = np.flatnonzero(labels["profit"] > threshold)
    ranked = good[labels["profit"][good].argsort()[::-1]]
    _, first = np.unique(labels["place"][ranked], return_index=True)
    return [(float(labels["profit"][k]), _route(labels, k)) for k in ranked[first].tolist()]


def _route(labels: np.ndarray, k: int) -> list[int]:
    """:return: The places of a label, in flying order"""
    route = []
    while k >= 0:
        route.append(int(labels["place"][k]))
        k = int(labels["before"][k])
    return route[::-1]

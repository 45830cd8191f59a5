"""The routes that are worth more than they cost, and how much a route can be worth at most."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_uav.bounds import kernels
from sb3_uav.bounds.kernels import Completion, Fleet, Labels
from sb3_uav.bounds.places import Kind

# Lengths of routes are sorted into so many buckets.
_N_BUCKETS = 64
# How many labels are continued between two looks at the clock.
_CHUNK = 2000
# The memory of one search for labels: 48 bytes each.
_MOST_LABELS = 4_000_000
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
    """Memory for labels, used again and again; it grows as needed."""

    def __init__(self) -> None:
        self._labels = np.zeros(0, kernels.LABEL)

    def of(self, n_places: int, n_labels: int) -> Labels:
        n_labels = min(n_labels, _MOST_LABELS) + n_places
        if len(self._labels) < n_labels:
            self._labels = np.zeros(n_labels, kernels.LABEL)
        return Labels(
            self._labels[:n_labels],
            np.zeros((n_places, _N_BUCKETS), np.int32),
            np.zeros((n_places, _N_BUCKETS)),
            np.zeros(_N_BUCKETS, np.int32),
            np.zeros(4, np.int64),
        )


class Pricing:
    """
    One kind of UAVs at given prices.

    :param kind: The kind
    :param fleet: The same for the kernels
    :param profits: ``(n,)``, value of each place less its price, >= 0
    :param memory: Memory for labels
    """

    def __init__(self, kind: Kind, fleet: Fleet, profits: np.ndarray, memory: LabelMemory) -> None:
        self._kind, self._fleet, self._profits, self._memory = kind, fleet, profits, memory
        n_clusters = len(kind.grid.only)
        shape = (int(round(kind.limit / kind.grid.step)) + 1, n_clusters)
        of_clusters = np.bincount(kind.grid.cluster, weights=profits, minlength=n_clusters)
        self._completion = Completion(np.empty(shape), np.empty(shape, np.int32), np.empty(shape), of_clusters)
        kernels.complete(kind.grid, of_clusters, *self._completion[:3])
        self.most = self._first_bound()

    def _first_bound(self) -> float:
        """:return: What any route is worth at most, without a search"""
        kind, completion = self._kind, self._completion
        left = ((kind.limit - kind.outward) / kind.grid.step + 1e-9).astype(np.int64)
        can = (kind.outward + kind.homeward <= kind.limit) & (self._profits > 0)
        clusters = kind.grid.cluster[can]
        return float((completion.best[left[can], clusters] + completion.profit[clusters]).max(initial=0.0))

    def search(self, threshold: float, exact: bool, n_labels: int, is_late: Callable[[], bool]) -> Found:
        """
        :param threshold: Routes that are not worth more do not count
        :param exact: Whether the result is a bound; a faster search may miss the best routes
        :param n_labels: After how many labels to give up
        :param is_late: Says when to give up
        :return: What was found; what it bounds holds in any case
        """
        found = self._memory.of(len(self._profits), n_labels)
        data = (self._kind.grid, self._fleet, self._completion, self._profits, threshold, found, exact)
        kernels.begin(*data)
        state = kernels.RUNNING
        while state == kernels.RUNNING and not is_late():
            state = kernels.proceed(*data, _CHUNK)
        is_complete = state == kernels.FINISHED
        n = int(found.state[0])
        profits = found.labels["profit"][:n]
        good = np.flatnonzero(profits > threshold)
        best = float(profits[good].max(initial=threshold))
        most = min(self.most, best) if exact and is_complete else self.most
        return Found(self._routes(found, good), most, is_complete)

    def _routes(self, found: Labels, good: np.ndarray) -> list[list[int]]:
        """:return: The best route to each last place, the best first"""
        labels = found.labels
        ranked = good[labels["profit"][good].argsort()[::-1]]
        _, first = np.unique(labels["place"][ranked], return_index=True)
        routes = []
        for k in ranked[np.sort(first)[:_MOST_ROUTES]].tolist():
            route = []
            while k >= 0:
                route.append(int(labels["place"][k]))
                k = int(labels["before"][k])
            routes.append(route[::-1])
        return routes

"""Column generation: routes are found as they are needed, and prices of places and UAVs bound what any schedule is worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from sb3_uav.bounds.master import Master, Prices
from sb3_uav.bounds.places import MOST_NEAR, Places, near_lists, positions
from sb3_uav.bounds.pricing import LabelMemory, Pricing

# How many neighbors a place remembers at first, itself included.
_N_NEAR = 9
# Prices are looked at so far from the program's towards the best known: its own jump about.
_SMOOTHING = 0.5
# What is worth less, in units of the greatest value, is a rounding error.
_TOLERANCE = 1e-7
# How many labels an exact search writes at first and at last, and a fast one.
_FIRST_LABELS, _LAST_LABELS, _FAST_LABELS = 1_000_000, 4_000_000, 200_000
# Where an exact search fails, its threshold is raised by this part of the way to what routes are worth at most; how far.
_RISE, _HIGHEST = 0.15, 0.9
# An exact search may take this part of the time that is left, a search for a first bound that one, which is due whenever only
# this part of the time is left that was left after the last one.
_EXACT_SHARE, _PROBE_SHARE, _PROBING = 0.5, 0.2, 0.75
# How many exact searches with all the memory there is may fail.
_MOST_FAILURES = 3
# Of more routes than so many per place, those that are far from being taken are forgotten.
_MOST_ROUTES_PER_PLACE = 60


class ColumnGeneration:
    """
    A bound that falls step by step, and holds whenever it is looked at.

    For any prices, a schedule is worth no more than the sum of all prices, and for every UAV what a route is worth at most
    beyond the prices of its places (Lagrange, Farley). Routes may return to a place once they have forgotten it (ng-routes,
    Baldacci et al., https://doi.org/10.1287/opre.1110.0975); where that makes a difference, more is remembered.

    :param places: At least one place
    :param is_late: Says when to stop
    :param seconds_left: Says how long that is from now
    :ivar bound: Total value of the best schedule at most, in the unit of the values
    :ivar is_finished: Whether more time changes nothing
    """

    def __init__(self, places: Places, is_late: Callable[[], bool], seconds_left: Callable[[], float]) -> None:
        self._places, self._is_late, self._seconds_left = places, is_late, seconds_left
        self._unit = float(places.values.max())
        self._values = places.values / self._unit
        self._n_uavs = np.array([kind.n_uavs for kind in places.kinds], float)
        self.master = Master(self._values, self._n_uavs.tolist())
        self._near, self._position = near_lists(places.kinds[0].distances, _N_NEAR)
        self._memory = LabelMemory()
        # All places at their full value: no route is worth more.
        self._inner = Prices(self._values.copy(), np.zeros(len(self._n_uavs)), math.fsum(self._values))
        self._n_failures = 0
        self._next_probe = seconds_left() * _PROBING
        self._n_labels = np.full(len(self._n_uavs), _FIRST_LABELS)
        self.is_finished = False

    @property
    def bound(self) -> float:
        return self._inner.value * self._unit

    @property
    def prices(self) -> np.ndarray:
        """What the last bound takes each place to be worth, ``(n,)``, in the unit of the values."""
        return self._inner.places * self._unit

    def add(self, routes: Sequence[tuple[int, Sequence[int]]]) -> None:
        """
        :param routes: Kind and places of each, feasible
        """
        for kind, route in routes:
            self.master.add(kind, route)

    def step(self, enough: float = -math.inf) -> None:
        """
        Solve the program, look for routes, and lower the bound if that succeeds.

        :param enough: A bound, in the unit of the values, below which it need not fall; at most the best schedule's value
        """
        outer = self.master.solve(self._seconds_left())
        if outer is None:
            return
        goal = max(outer.value, enough / self._unit)
        if self._inner.value - goal <= _TOLERANCE * max(1.0, goal):
            self._remember_more()
            return
        self._forget(outer)
        probes = self._seconds_left() < self._next_probe
        for smoothing in (_SMOOTHING, 0.0):
            prices = Prices(
                smoothing * self._inner.places + (1 - smoothing) * outer.places,
                smoothing * self._inner.uavs + (1 - smoothing) * outer.uavs,
                0.0,
            )
            before = self._inner.value
            if self._price(prices, probes or smoothing == 0.0, probes) or self._is_late():
                break
        else:
            if self._inner.value == before:
                # The exact search has failed: it may have more memory, and half of the time that is left.
                self.is_finished = bool((self._n_labels >= _LAST_LABELS).all()) and self._n_failures > _MOST_FAILURES
                self._n_labels = np.minimum(self._n_labels * 2, _LAST_LABELS)
                self._n_failures += 1
            else:
                self._n_failures = 0
        if probes:
            self._next_probe = self._seconds_left() * _PROBING

    def _price(self, prices: Prices, exact: bool, probes: bool) -> bool:
        """
        :param prices: Any, >= 0
        :param exact: Whether to search exactly if the fast search finds nothing
        :param probes: Whether to search exactly in any case, for routes that are worth more than those found
        :return: Whether new routes were found
        """
        profits = np.maximum(self._values - prices.places, 0.0)
        profits[profits < _TOLERANCE] = 0.0
        used = self._values - profits
        kinds: list[Pricing] = []
        for own in self._places.kinds:
            if self._is_late():
                return False
            kinds.append(Pricing(own, *own.fleets(self._near, self._position), profits, self._memory))
        self._accept(used, np.array([kind.most for kind in kinds]))
        thresholds = prices.uavs + _TOLERANCE
        n_new = 0
        for number, kind in enumerate(kinds):
            if kind.most > thresholds[number]:
                found = kind.search(float(thresholds[number]), False, _FAST_LABELS, self._is_late)
                n_new += sum(self.master.add(number, route) for route in found.routes)
                if probes and found.routes:
                    thresholds[number] = max(sum(profits[place] for place in route) for route in found.routes) + _TOLERANCE
        if (n_new > 0 and not probes) or not exact or self._is_late():
            return n_new > 0
        most = np.empty(len(kinds))
        for number, kind in enumerate(kinds):
            share = self._seconds_left() * (_PROBE_SHARE if probes else _EXACT_SHARE) / (len(kinds) - number)
            routes, most[number] = self._exact(number, kind, float(thresholds[number]), share)
            n_new += sum(self.master.add(number, route) for route in routes)
        self._accept(used, most)
        return n_new > 0

    def _has_less_than(self, seconds: float) -> bool:
        return self._seconds_left() < seconds

    def _exact(self, number: int, kind: Pricing, threshold: float, seconds: float) -> tuple[list[list[int]], float]:
        """
        Look for routes that are worth more than a threshold; if there are too many labels, than a higher one.

        :param number: Number of the kind
        :param kind: The kind at some prices
        :param threshold: What routes have to be worth
        :param seconds: How long each of the searches may take, of which the next takes half
        :return: Routes, and what any route is worth at most
        """
        height = 0.0
        while kind.most > threshold and height < _HIGHEST and not self._is_late():
            end = self._seconds_left() - seconds
            found = kind.search(
                threshold + height * (kind.most - threshold),
                True,
                int(self._n_labels[number]),
                partial(self._has_less_than, end),
            )
            if found.is_complete or found.routes:
                return found.routes, found.most
            height += _RISE * (1 - height)
            seconds /= 2
        return [], kind.most

    def _accept(self, places: np.ndarray, uavs: np.ndarray) -> None:
        """
        :param places: Prices of places
        :param uavs: What a route of each kind is worth at most beyond them
        """
        value = (math.fsum(places) + math.fsum(self._n_uavs * np.maximum(uavs, 0.0))) * (1 + 1e-12)
        if value < self._inner.value:
            self._inner = Prices(places, np.maximum(uavs, 0.0), value)

    def _forget(self, outer: Prices) -> None:
        """
        :param outer: The program's prices
        """
        if len(self.master.routes) <= _MOST_ROUTES_PER_PLACE * (self._places.n + 10):
            return
        worth = np.array(
            [
                self._values[list(route)].sum() - outer.places[list(route)].sum() - outer.uavs[k]
                for k, route in self.master.routes
            ]
        )
        self.master.keep((worth >= np.median(worth)).tolist())

    def _remember_more(self) -> None:
        """Forbid the returns in the routes that the program takes; without any, nothing more can be done."""
        changed = False
        for (_, route), weight in zip(self.master.routes, self.master.weights(), strict=True):
            if weight > 1e-6:
                for first, last in _returns(route):
                    changed |= self._remember(route[first], route[first + 1 : last])
        if not changed:
            self.is_finished = True
            return
        self._position = positions(self._near)
        self.master.keep([self._is_allowed(route) for _, route in self.master.routes])

    def _remember(self, place: int, between: Sequence[int]) -> bool:
        """
        :param place: A place that a route returns to
        :param between: The places between
        :return: Whether all of them remember it now, and not all did before
        """
        missing = [other for other in set(between) if self._position[other, place] < 0 and place not in self._near[other]]
        if not missing or any(self._near[other, MOST_NEAR - 1] >= 0 for other in missing):
            return False
        for other in missing:
            self._near[other, int((self._near[other] >= 0).sum())] = place
        return True

    def _is_allowed(self, route: Sequence[int]) -> bool:
        """:return: Whether the route returns to no place that it remembers"""
        return not any(
            all(self._position[other, route[first]] >= 0 for other in route[first + 1 : last])
            for first, last in _returns(route)
        )


def _returns(route: Sequence[int]) -> list[tuple[int, int]]:
    """
    :param route: Places in flying order
    :return: Positions of every two visits of a place, with no other one of it between them
    """
    visits: dict[int, list[int]] = {}
    for position, place in enumerate(route):
        visits.setdefault(place, []).append(position)
    return [pair for own in visits.values() for pair in pairwise(own)]

"""The choice among the routes found so far: a linear program, solved by HiGHS from where it was left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_uav.common.optional import require


class Prices(NamedTuple):
    """
    A solution of the dual program.

    :param places: ``(n,)``, of serving each place
    :param uavs: ``(n_kinds,)``, of a UAV of each kind
    :param value: Objective
    """

    places: np.ndarray
    uavs: np.ndarray
    value: float


class Master:
    """
    Maximize the value of routes, each taken as a fraction, so that no place is served more than once.

    :param values: ``(n,)``, of places
    :param n_uavs: Of each kind
    :raises ImportError: If HiGHS is not installed
    """

    def __init__(self, values: np.ndarray, n_uavs: Sequence[int]) -> None:
        self._highspy = require("highspy", "A bound", "solvers")
        self.values = values
        self._n_uavs = np.array(n_uavs, float)
        self.routes: list[tuple[int, tuple[int, ...]]] = []
        self._known: set[tuple[int, tuple[int, ...]]] = set()
        self._start()

    def _start(self) -> None:
        program = self._highspy.Highs()
        program.setOptionValue("output_flag", False)
        program.setOptionValue("threads", 1)
        program.setOptionValue("solver", "simplex")
        program.changeObjectiveSense(self._highspy.ObjSense.kMaximize)
        infinity = self._highspy.kHighsInf
        none = np.zeros(0, np.int32)
        for most in (*np.ones(len(self.values)), *self._n_uavs):
            program.addRow(-infinity, float(most), 0, none, np.zeros(0))
        self._program = program

    def add(self, kind: int, route: Sequence[int]) -> bool:
        """
        :param kind: Kind of the UAV
        :param route: Places in flying order, perhaps some of them several times
        :return: Whether the route is new
        """
        key = (kind, tuple(sorted(route)))
        if key in self._known:
            return False
        self._known.add(key)
        self.routes.append((kind, tuple(route)))
        self._add(kind, route)
        return True

    def _add(self, kind: int, route: Sequence[int]) -> None:
        places, counts = np.unique(np.array(route, np.int32), return_counts=True)
        rows = np.append(places, len(self.values) + kind).astype(np.int32)
        value = float(self.values[places] @ counts)
        self._program.addCol(value, 0.0, self._highspy.kHighsInf, len(rows), rows, np.append(counts, 1.0).astype(float))

    def keep(self, kept: Sequence[bool]) -> None:
        """
        :param kept: Of each route, whether it stays
        """
        self.routes = [route for route, stays in zip(self.routes, kept, strict=True) if stays]
        self._known = {(kind, tuple(sorted(route))) for kind, route in self.routes}
        self._start()
        for kind, route in self.routes:
            self._add(kind, route)

    def solve(self, seconds: float) -> Prices | None:
        """
        :param seconds: When to give up
        :return: The prices, none below 0; None without a solution
        """
        self._program.setOptionValue("time_limit", self._program.getRunTime() + max(seconds, 0.0))
        self._program.run()
        if self._program.getModelStatus() != self._highspy.HighsModelStatus.kOptimal:
            return None
        duals = np.array(self._program.getSolution().row_dual).clip(0)
        n = len(self.values)
        return Prices(np.minimum(duals[:n], self.values), duals[n:], float(self._program.getInfo().objective_function_value))

    def weights(self) -> np.ndarray:
        """:return: ``(n_routes,)``, how much of each route the last solution takes"""
        return np.array(self._program.getSolution().col_value)

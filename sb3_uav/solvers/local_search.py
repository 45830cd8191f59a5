"""Local search from cheapest insertion: what repair and polish do without any network."""

from __future__ import annotations

import time

import numpy as np

from sb3_uav.common.optional import require
from sb3_uav.envs.instances import Instances
from sb3_uav.solvers.base import Solution
from sb3_uav.solvers.limits import TimeLimitedSolver
from sb3_uav.solvers.postprocess import polish


class LocalSearchSolver(TimeLimitedSolver):
    """
    Repaired cheapest insertion, polished until the time is up: the same search as ``dl-drl:repair=1,polish=...`` from another
    start, so that the two show what the networks add.

    :param time_limit: Seconds per instance
    :raises ImportError: If numba is not installed
    :raises ValueError: If the time limit is not a finite number above 0
    """

    name = "local-search"
    solves_whole_problem = True

    def __init__(self, time_limit: float = 1.0) -> None:
        super().__init__(time_limit)
        require("numba", f"Solver {self.name}", "solvers")

    def prepare(self) -> None:
        from sb3_uav.local_search.search import warm_up

        warm_up()

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        from sb3_uav.local_search.search import repaired_insertion

        deadline = self.deadline(time_limit)
        found = repaired_insertion(instance, deadline - time.perf_counter())
        left = deadline - time.perf_counter()
        return Solution(polish(instance, found, left, int(rng.integers(2**31))) if left > 0 else found)

"""Repair and polishing of the networks' schedules, always reported separately from the networks alone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import torch as th

from sb3_uav.common.optional import require
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule

# How many of the best schedules of an instance are repaired, in a few milliseconds each. Of 128, repairing 64 gave 0.2 to
# 0.8 % more tasks than repairing 8 at 80 to 200 tasks; repairing all gave no more.
_N_REPAIRED = 64
# Fraction of the polishing time for ruin and recreate, before PyVRP. In one second, from the same schedules, ruin and recreate
# found more than PyVRP from 500 tasks on, and less at 80 to 200 tasks; half and half was as good as the better of the two.
_RUIN_SHARE = 0.5
# Fraction of a time limit reserved for repair, and for polishing.
_REPAIR_SHARE, _POLISH_SHARE = 0.3, 0.75
# Seconds for the repair when the networks have used up the time limit.
_LEAST_REPAIR_SECONDS = 0.05


class Refinement:
    """
    Repairs and polishes schedules.

    Repaired cheapest insertion is always among them, so that the result is never worse, however strange an instance is to the
    networks and however short the time.

    Works on several instances at once, in as many threads as torch may use; compiled code and PyVRP do most of the work.

    :param repair: Whether to repair the best schedules of every instance and keep the best
    :param polish: Seconds per instance for further improvement; 0 for none
    :raises ImportError: If a package is needed and not installed
    :raises ValueError: If ``polish`` is negative or not finite
    """

    def __init__(self, repair: bool = False, polish: float = 0.0) -> None:
        if not 0 <= polish < math.inf:
            raise ValueError(f"polish is {polish:g}; give a number of seconds, 0 for none.")
        self.repair = repair
        self.polish = polish
        if self.is_wanted:
            require("numba", "Solver dl-drl with repair or polish", "solvers")
            from sb3_uav.local_search.search import warm_up

            warm_up()

    @property
    def is_wanted(self) -> bool:
        return self.repair or self.polish > 0

    @property
    def share(self) -> float:
        """Fraction of a time limit reserved for it."""
        return _POLISH_SHARE if self.polish > 0 else _REPAIR_SHARE if self.repair else 0.0

    @property
    def n_candidates(self) -> int:
        """How many candidate schedules of an instance it considers."""
        return _N_REPAIRED if self.repair else 1

    @property
    def label(self) -> str:
        """Its part of a solver's name."""
        return (" + repair" if self.repair else "") + (f" + polish {self.polish:g} s" if self.polish > 0 else "")

    def first_candidates(self, instances: Instances, deadline: float) -> list[list[Schedule]]:
        """
        What needs no networks, found before they run, which may take all the time.

        :param instances: ``batch`` instances on the CPU
        :param deadline: When to end, in seconds of ``time.perf_counter``
        :return: A feasible schedule of each; none if nothing is repaired or polished
        """
        if not self.is_wanted:
            return [[] for _ in range(len(instances))]
        from sb3_uav.local_search.search import repaired_insertion

        n_threads, n_rounds = _threads(instances)
        seconds = (deadline - time.perf_counter()) / n_rounds
        with ThreadPoolExecutor(n_threads) as pool:
            return list(pool.map(lambda i: [repaired_insertion(instances[i], seconds)], range(len(instances))))

    def __call__(
        self,
        instances: Instances,
        candidates: Sequence[Sequence[Schedule]],
        deadline: float,
        seed: int = 0,
        report: Callable[[int, Schedule], None] = lambda row, schedule: None,
    ) -> list[Schedule]:
        """
        :param instances: ``batch`` instances on the CPU
        :param candidates: At least one feasible schedule of each
        :param deadline: When to end, in seconds of ``time.perf_counter``
        :param seed: Seed for polishing
        :param report: Told the row of an instance and what was found for it before polishing ends
        :return: One schedule for each, not worse than its best candidate; if nothing is wanted, its first
        """
        if not self.is_wanted:
            return [found[0] for found in candidates]
        from sb3_uav.local_search.search import repair_best

        # The remaining time is divided equally among the instances; polishing, if requested, gets 70 % of it.
        n_threads, n_rounds = _threads(instances)
        left = (deadline - time.perf_counter()) / n_rounds
        repairing = left * (_REPAIR_SHARE if self.polish > 0 else 1.0)
        if not self.repair:
            seconds: float | None = 0.0
        else:
            seconds = None if math.isinf(repairing) else max(repairing, _LEAST_REPAIR_SECONDS)
        with ThreadPoolExecutor(n_threads) as pool:
            best = list(pool.map(lambda i: repair_best(instances[i], candidates[i], seconds), range(len(instances))))
            for row, schedule in enumerate(best):
                report(row, schedule)
            seconds = min(self.polish, (deadline - time.perf_counter()) / n_rounds)
            if seconds <= 0:
                return best

            def polished(row: int) -> Schedule:
                return polish(instances[row], best[row], seconds, seed, partial(report, row))

            return list(pool.map(polished, range(len(instances))))


def _threads(instances: Instances) -> tuple[int, int]:
    """
    :param instances: ``batch`` instances
    :return: How many to treat at once, and how many one thread treats in turn
    """
    n_threads = min(th.get_num_threads(), len(instances))
    return n_threads, math.ceil(len(instances) / n_threads)


def polish(
    instance: Instances,
    schedule: Schedule,
    seconds: float,
    seed: int = 0,
    report: Callable[[Schedule], None] = lambda schedule: None,
) -> Schedule:
    """
    Improve a schedule: first by ruin and recreate, then by PyVRP, starting from its result.

    Without PyVRP, which needs Python 3.11 or newer, ruin and recreate gets all the time.

    :param instance: A batch of one
    :param schedule: A feasible schedule of it
    :param seconds: Wall time
    :param seed: Seed for both
    :param report: Told what ruin and recreate found
    :return: A feasible schedule of at least the same value
    :raises ImportError: If numba is not installed
    :raises ValueError: If the time is not a finite number above 0
    """
    from sb3_uav.local_search.search import improve
    from sb3_uav.solvers.pyvrp_search import has_pyvrp, polish_schedule

    start = time.perf_counter()
    share = _RUIN_SHARE if has_pyvrp() else 1.0
    n_tasks = max(int(instance.task_mask.sum()), 1)
    instance = instance.trim(n_tasks)
    found = improve(instance, schedule, share * seconds, seed)
    report(found)
    left = start + seconds - time.perf_counter()
    if share == 1.0 or left <= 0:
        return found
    return polish_schedule(instance, found, left, seed)

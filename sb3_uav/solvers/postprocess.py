"""What makes the schedules of the networks better, reported apart from them: repair and polish."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import torch as th

from sb3_uav.common.optional import require
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule

# How many of the best schedules of an instance are repaired, in some milliseconds each. Of 128, 64 gave 0.2 to 0.8 % more
# tasks than 8 at 80 to 200 tasks, and all of them no more.
N_REPAIRED = 64
# The part of the polishing that ruin and recreate gets before PyVRP. In one second, from the same schedules, it found more
# than PyVRP from 500 tasks on and less at 80 to 200; PyVRP with the second half lost nothing of either.
RUIN_SHARE = 0.5
# The part of a time limit that is kept for it.
REPAIR_SHARE, POLISH_SHARE = 0.3, 0.75
# Where the networks have used up all the time, schedules are repaired for so long nevertheless.
LEAST_REPAIR_SECONDS = 0.05


class Refinement:
    """
    Repairs and polishes schedules.

    Instances are treated in threads, as many at once as torch may use; compiled code and PyVRP do most of the work.

    :param repair: Whether to repair the best schedules of every instance and keep the best
    :param polish: Seconds per instance to go on from there; 0 for none
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
        """The part of a time limit that it should be left."""
        return POLISH_SHARE if self.polish > 0 else REPAIR_SHARE if self.repair else 0.0

    @property
    def n_candidates(self) -> int:
        """How many schedules of an instance it looks at."""
        return N_REPAIRED if self.repair else 1

    @property
    def label(self) -> str:
        """What it adds to the name of a solver."""
        return (" + repair" if self.repair else "") + (f" + polish {self.polish:g} s" if self.polish > 0 else "")

    def __call__(
        self, instances: Instances, candidates: Sequence[Sequence[Schedule]], deadline: float, seed: int = 0
    ) -> list[Schedule]:
        """
        :param instances: ``batch`` instances on the CPU
        :param candidates: At least one feasible schedule of each, the best first
        :param deadline: When to end, in seconds of ``time.perf_counter``
        :param seed: Of the polishing
        :return: One schedule for each, not worse than its best candidate
        """
        if not self.is_wanted:
            return [found[0] for found in candidates]
        from sb3_uav.local_search.search import repair_best

        n_threads = min(th.get_num_threads(), len(instances))
        # Of the time that is left, every instance gets an equal share, and the polishing, if there is any, three quarters.
        n_rounds = math.ceil(len(instances) / n_threads)
        left = (deadline - time.perf_counter()) / n_rounds
        repairing = left * (REPAIR_SHARE if self.polish > 0 else 1.0)
        with ThreadPoolExecutor(n_threads) as pool:
            best = [found[0] for found in candidates]
            if self.repair:
                seconds = None if math.isinf(repairing) else max(repairing, LEAST_REPAIR_SECONDS)
                best = list(pool.map(lambda i: repair_best(instances[i], candidates[i], seconds), range(len(instances))))
            seconds = min(self.polish, (deadline - time.perf_counter()) / n_rounds)
            if seconds <= 0:
                return best
            return list(pool.map(lambda i: polish(instances[i], best[i], seconds, seed), range(len(instances))))


def polish(instance: Instances, schedule: Schedule, seconds: float, seed: int = 0) -> Schedule:
    """
    Search on from a schedule: ruin and recreate first, then PyVRP, which starts from what that found.

    Without PyVRP (it needs Python 3.11 or newer) ruin and recreate gets all the time.

    :param instance: A batch of one
    :param schedule: A feasible schedule of it
    :param seconds: Wall time
    :param seed: Of the random numbers
    :return: A feasible schedule of at least the same value
    :raises ImportError: If numba is not installed
    :raises ValueError: If the time is not a finite number above 0
    """
    from sb3_uav.local_search.search import improve
    from sb3_uav.solvers.pyvrp_search import has_pyvrp, polish_schedule

    start = time.perf_counter()
    share = RUIN_SHARE if has_pyvrp() else 1.0
    n_tasks = max(int(instance.task_mask.sum()), 1)
    instance = instance.trim(n_tasks)
    found = improve(instance, schedule, share * seconds, seed)
    left = start + seconds - time.perf_counter()
    if share == 1.0 or left <= 0:
        return found
    return polish_schedule(instance, found, left, seed)

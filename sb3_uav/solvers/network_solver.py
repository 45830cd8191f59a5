"""Solvers that solve many instances at once, as networks do."""

from __future__ import annotations

import hashlib
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence

import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.policies import EpisodicPolicy
from sb3_uav.solvers.base import Solver, SolverResult
from sb3_uav.solvers.counting_tasks import CountingTasks


class BatchedSolver(Solver):
    """
    A solver that solves as many instances at once as memory allows.

    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :raises ValueError: If it is less than 1
    :ivar serves_any_fleet: Whether it can solve an instance with fewer UAVs than :meth:`check` admitted
    """

    uses_time_limit = False
    serves_any_fleet = True

    def __init__(self, batch_size: int | None = None) -> None:
        if batch_size is not None and batch_size < 1:
            raise ValueError(f"batch_size is {batch_size}; give at least 1.")
        self.batch_size = batch_size
        self._report: Callable[[int, Schedule], None] = _tell_nobody

    @abstractmethod
    def rows_that_fit(self, instances: Instances) -> int:
        """
        :param instances: The instances to solve
        :return: How many of them fit into memory at once, at least 1
        """

    @abstractmethod
    def solve_batch(
        self, instances: Instances, rows: Sequence[int], seed: int, time_limit: float | None = None
    ) -> list[Schedule]:
        """
        :param instances: ``batch`` instances, trimmed to the largest of them and without the tasks that cannot count
        :param rows: Their row indices in the solved batch, on which random numbers depend
        :param seed: Seed for all random numbers
        :param time_limit: Seconds per instance, on average, for solvers that use it
        :return: A schedule for each instance
        """

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        self.check(instances)
        if len(rows) == 0:
            return
        counting = CountingTasks.of(instances[list(rows)])
        fleets = counting.n_useful_uavs() if self.serves_any_fleet else [instances.n_uavs] * len(rows)
        # A batch holds fleets of one size, so that the schedule of an instance does not depend on the others in its batch.
        for n_uavs in dict.fromkeys(fleets):
            group = counting.instances.with_fleet(n_uavs)
            places = [place for place, fleet in enumerate(fleets) if fleet == n_uavs]
            fitting = self.rows_that_fit(group)
            batch_size = min(self.batch_size or fitting, fitting)
            for first in range(0, len(places), batch_size):
                taken = places[first : first + batch_size]
                start = time.perf_counter()
                batch = group[taken]
                n_tasks = max(int(batch.task_mask.sum(1).max()), 1)
                self._report = self._reporter(counting, rows, taken)
                try:
                    found = self.solve_batch(batch.trim(n_tasks), [rows[place] for place in taken], seed, time_limit)
                finally:
                    # It holds the instances and what the caller has given, and is of no use to another batch.
                    self._report = _tell_nobody
                seconds = (time.perf_counter() - start) / len(taken)
                for place, schedule in zip(taken, found, strict=True):
                    yield rows[place], SolverResult(counting.schedule(place, schedule), seconds, len(taken))

    def _reporter(self, counting: CountingTasks, rows: Sequence[int], taken: Sequence[int]) -> Callable[[int, Schedule], None]:
        """
        :param counting: What counts of the instances
        :param rows: Their row indices
        :param taken: Those of a batch, by their place among the rows
        :return: Takes the place of an instance in the batch and a schedule of it, for :attr:`on_incumbent`
        """
        on_incumbent = self.on_incumbent
        if on_incumbent is None:
            return _tell_nobody
        return lambda place, schedule: on_incumbent(rows[taken[place]], counting.schedule(taken[place], schedule))

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        results = dict(self.solve_rows(instances, range(len(instances)), time_limit, seed))
        return [results[row] for row in range(len(instances))]


def _tell_nobody(place: int, schedule: Schedule) -> None:
    """What solvers report to if nobody has set :attr:`~sb3_uav.solvers.base.Solver.on_incumbent`."""


def parameters_hash(policy: EpisodicPolicy) -> str:
    """
    :param policy: Any policy of ours
    :return: SHA-256 of its parameters and buffers, which depends neither on the device nor on the file
    """
    digest = hashlib.sha256()
    for name, value in policy.state_dict().items():
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        # As bytes, because NumPy has no bfloat16.
        digest.update(value.detach().cpu().flatten().view(th.uint8).numpy().tobytes())
    return digest.hexdigest()

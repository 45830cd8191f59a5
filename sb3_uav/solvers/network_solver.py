"""Solvers that treat many instances at once, as networks do."""

from __future__ import annotations

import hashlib
import time
from abc import abstractmethod
from collections.abc import Iterator, Sequence

import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.policies import EpisodicPolicy
from sb3_uav.solvers.base import Solver, SolverResult


class BatchedSolver(Solver):
    """
    A solver that treats as many instances at once as memory allows.

    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :raises ValueError: If it is less than 1
    """

    uses_time_limit = False

    def __init__(self, batch_size: int | None = None) -> None:
        if batch_size is not None and batch_size < 1:
            raise ValueError(f"batch_size is {batch_size}; give at least 1.")
        self.batch_size = batch_size

    @abstractmethod
    def rows_that_fit(self, instances: Instances) -> int:
        """
        :param instances: What is being solved
        :return: How many of them fit into the memory at once, at least 1
        """

    @abstractmethod
    def solve_batch(
        self, instances: Instances, rows: Sequence[int], seed: int, time_limit: float | None = None
    ) -> list[Schedule]:
        """
        :param instances: ``batch`` instances, trimmed to the largest of them
        :param rows: Their indices in what is being solved, on which random numbers depend
        :param seed: Of all the randomness
        :param time_limit: Seconds per instance, on average, for solvers that use it
        :return: A schedule for each
        """

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        self.check(instances)
        fitting = self.rows_that_fit(instances)
        batch_size = min(self.batch_size or fitting, fitting)
        for first in range(0, len(rows), batch_size):
            taken = list(rows[first : first + batch_size])
            start = time.perf_counter()
            batch = instances[taken]
            n_tasks = max(int(batch.task_mask.sum(1).max()), 1)
            found = self.solve_batch(batch.trim(n_tasks), taken, seed, time_limit)
            seconds = (time.perf_counter() - start) / len(taken)
            for row, schedule in zip(taken, found, strict=True):
                yield row, SolverResult(schedule, seconds, len(taken))

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [result for _, result in self.solve_rows(instances, range(len(instances)), time_limit, seed)]


def parameters_hash(policy: EpisodicPolicy) -> str:
    """
    :param policy: Any policy of ours
    :return: SHA-256 of its parameters and buffers, the same on every device and whatever file they came from
    """
    digest = hashlib.sha256()
    for name, value in policy.state_dict().items():
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        # As bytes, because numpy has no bfloat16.
        digest.update(value.detach().cpu().flatten().view(th.uint8).numpy().tobytes())
    return digest.hexdigest()

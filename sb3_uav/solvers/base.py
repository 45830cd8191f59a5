"""What every solver looks like."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.random_streams import keyed_generator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.solvers.counting_tasks import CountingTasks


@dataclass(frozen=True)
class SolverResult:
    """
    What a solver found for one instance.

    :param schedule: The schedule; nobody has checked it yet
    :param seconds: Wall time of the instance: that of its batch, divided by the size of the batch
    :param batch_size: How many instances were solved at once
    :param bound: A proven upper bound of the objective, where the solver knows one
    """

    schedule: Schedule
    seconds: float
    batch_size: int = 1
    bound: float | None = None


class NoScheduleError(RuntimeError):
    """
    A solver that ended without any schedule.

    :param message: Why
    :param bound: A proven upper bound of the objective, where the solver knows one
    """

    def __init__(self, message: str, bound: float | None = None) -> None:
        super().__init__(message)
        self.bound = bound

    def __reduce__(self) -> tuple[type[NoScheduleError], tuple[str, float | None]]:
        # Exceptions travel between processes, and would lose what is not an argument of theirs.
        return type(self), (str(self), self.bound)


class Solver(ABC):
    """
    Turns instances into schedules.

    :ivar uses_time_limit: Whether it may find other schedules with another time limit; if not, evaluations at several time
        limits run it once
    :ivar name: How tables and files call it
    :ivar spec: The text that :func:`~sb3_uav.solvers.registry.make_solver` made it from
    :ivar files: Files that it was made from, by their purpose; evaluations record their hashes
    """

    uses_time_limit: bool = True
    name: str
    spec: str | None = None
    files: Mapping[str, Path] = {}

    def settings(self) -> dict[str, Any] | None:
        """
        :return: What decides its results beside instances, time limit and seed, as plain data; results of earlier evaluations
            are used again only if it is the same. None for a solver that has no results
        """
        return {} if self.spec is None else {"spec": self.spec}

    def check(self, instances: Instances) -> None:  # noqa: B027 (most solvers take any instances)
        """
        Called for all instances before any solver runs, so that a long evaluation does not fail half-way.

        :param instances: What is going to be solved
        :raises ValueError: If the solver cannot treat them; the message says why
        """

    def prepare(self) -> None:  # noqa: B027 (most solvers have nothing to prepare)
        """
        Called in every process before it solves an instance, often more than once; what it takes does not count as time of the
        instance. For what is the same for all of them, such as loading code.
        """

    @abstractmethod
    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        """
        :param instances: ``batch`` instances on the CPU, possibly padded
        :param time_limit: Seconds per instance for solvers that can use more or less of them; their own default when None.
            Others ignore it
        :param seed: Of all the randomness; without a time limit the same seed gives the same schedules
        :return: One result per instance
        :raises ValueError: If the solver cannot treat these instances, see :meth:`check`
        :raises NoScheduleError: If it found no schedule for one of them
        """

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        """
        Solve some of the instances exactly as :meth:`solve` solves them among all, and hand out what is known already.

        :param instances: ``batch`` instances on the CPU, possibly padded
        :param rows: Indices of those to solve
        :param time_limit: As for :meth:`solve`
        :param seed: As for :meth:`solve`
        :return: Index and result of each
        """
        results = self.solve(instances, time_limit, seed)
        if len(results) != len(instances):
            raise ValueError(f"{self.name} returned {len(results)} results for {len(instances)} instances.")
        for row in rows:
            yield row, results[row]


class Solution(NamedTuple):
    """
    :param schedule: The schedule
    :param bound: A proven upper bound of the objective, where the solver knows one
    """

    schedule: Schedule
    bound: float | None = None


class OneByOneSolver(Solver):
    """A solver that treats every instance alone, with random numbers that depend on the seed and its row only."""

    @abstractmethod
    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        """
        :param instance: A batch of one, without padding, without the tasks that cannot count, and with at most as many UAVs
            as there are tasks
        :param time_limit: Seconds, or None for the solver's own default
        :param rng: The source of randomness
        :return: The schedule, and a bound where one is known
        :raises NoScheduleError: If there is none
        """

    def solve_row(self, instance: Instances, row: int, time_limit: float | None = None, seed: int = 0) -> SolverResult:
        """
        :param instance: A batch of one, possibly padded
        :param row: Its index in what is being solved
        :param time_limit: As for :meth:`solve`
        :param seed: As for :meth:`solve`
        :return: What :meth:`solve` finds for that row
        """
        self.prepare()
        start = time.perf_counter()
        counting = CountingTasks.of(instance)
        # A row that is all padding keeps one slot, because no instance has none.
        n_tasks = max(int(counting.instances.task_mask.sum()), 1)
        reduced = replace(counting.instances.trim(n_tasks), n_uavs=counting.n_useful_uavs()[0])
        solution = self.solve_one(reduced, time_limit, keyed_generator(seed, row))
        schedule = counting.schedule(0, solution.schedule)
        return SolverResult(schedule, time.perf_counter() - start, bound=solution.bound)

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        for row in rows:
            yield row, self.solve_row(instances[row], row, time_limit, seed)

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [result for _, result in self.solve_rows(instances, range(len(instances)), time_limit, seed)]

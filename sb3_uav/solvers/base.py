"""What every solver looks like."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
    The result of a solver for one instance.

    :param schedule: The schedule, not checked yet
    :param seconds: Wall time of the instance: the time of its batch divided by the batch size
    :param batch_size: How many instances were solved at once
    :param bound: A proven upper bound of the objective, if the solver has one
    """

    schedule: Schedule
    seconds: float
    batch_size: int = 1
    bound: float | None = None


class NoScheduleError(RuntimeError):
    """
    A solver ended without any schedule.

    :param message: The reason
    :param bound: A proven upper bound of the objective, if the solver has one
    """

    def __init__(self, message: str, bound: float | None = None) -> None:
        super().__init__(message)
        self.bound = bound

    def __reduce__(self) -> tuple[type[NoScheduleError], tuple[str, float | None]]:
        # Pickling restores an exception from its arguments alone, without the bound.
        return type(self), (str(self), self.bound)


class Solver(ABC):
    """
    Turns instances into schedules.

    :ivar uses_time_limit: Whether the schedules may depend on the time limit; if not, evaluations at several time limits run
        the solver once
    :ivar solves_whole_problem: Whether UAVs may have their own starts, ends and distances, and tasks service costs
    :ivar remedy: What to do about instances that it cannot solve for that reason
    :ivar name: Label in tables and files
    :ivar spec: The text that :func:`~sb3_uav.solvers.registry.make_solver` made it from
    :ivar files: Files that it was loaded from, by their purpose; evaluations record their hashes
    :ivar on_incumbent: Called with the row of an instance and a feasible schedule of it as soon as one is known, in any
        thread, by solvers that find one after the other; a later one may be worse
    """

    uses_time_limit: bool = True
    solves_whole_problem: bool = False
    remedy: str = "choose another solver"
    name: str
    spec: str | None = None
    files: Mapping[str, Path] = {}
    on_incumbent: Callable[[int, Schedule], None] | None = None

    def settings(self) -> dict[str, Any] | None:
        """
        :return: Plain data that the results depend on, besides instances, time limit and seed; earlier results are reused only
            if it is the same. None for a solver that has no results
        """
        return {} if self.spec is None else {"spec": self.spec}

    def check(self, instances: Instances) -> None:
        """
        Called for all instances before any solver runs, so that a long evaluation does not fail halfway.

        :param instances: The instances to solve
        :raises ValueError: If the solver cannot solve them; the message says why
        """
        beyond = instances.beyond_the_paper
        if beyond and not self.solves_whole_problem:
            raise ValueError(
                f"{self.name} solves only instances whose UAVs all fly equally far, from the depot to the depot, without "
                f"service costs; these have {', '.join(beyond)}; {self.remedy}."
            )

    def prepare(self) -> None:  # noqa: B027 (most solvers have nothing to prepare)
        """
        Called in every process before it solves an instance, often more than once. For preparations that are independent of
        the instance, such as loading code; their time is not counted.
        """

    @abstractmethod
    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        """
        :param instances: ``batch`` instances on the CPU, possibly padded
        :param time_limit: Seconds per instance, for solvers that use a time limit; their own default when None
        :param seed: Seed for all random numbers; without a time limit the same seed gives the same schedules
        :return: One result per instance
        :raises ValueError: If the solver cannot solve these instances, see :meth:`check`
        :raises NoScheduleError: If it found no schedule for one of them
        """

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        """
        Solve some of the instances, with the same results as :meth:`solve` on all of them, and yield each as it becomes known.

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
    :param bound: A proven upper bound of the objective, if the solver has one
    """

    schedule: Schedule
    bound: float | None = None


class OneByOneSolver(Solver):
    """A solver that solves each instance alone, with random numbers that depend only on the seed and the row."""

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
        :param row: Its row index in the solved batch
        :param time_limit: As for :meth:`solve`
        :param seed: As for :meth:`solve`
        :return: The result that :meth:`solve` has for that row
        """
        self.check(instance)
        self.prepare()
        start = time.perf_counter()
        counting = CountingTasks.of(instance)
        # A row that is all padding keeps one slot, because every instance has one.
        n_tasks = max(int(counting.instances.task_mask.sum()), 1)
        reduced = counting.instances.trim(n_tasks).with_fleet(counting.n_useful_uavs()[0])
        solution = self.solve_one(reduced, time_limit, keyed_generator(seed, row))
        schedule = counting.schedule(0, solution.schedule)
        # With tasks that must be served, it bounds prizes, not values.
        bound = solution.bound if instance.must_serve is None else None
        return SolverResult(schedule, time.perf_counter() - start, bound=bound)

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        for row in rows:
            yield row, self.solve_row(instances[row], row, time_limit, seed)

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [result for _, result in self.solve_rows(instances, range(len(instances)), time_limit, seed)]

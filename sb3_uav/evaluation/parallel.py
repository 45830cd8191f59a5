"""Running a solver on instances, in this process or in others, with failures kept apart."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait as wait_for_handles
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.results import one_line
from sb3_uav.solvers.base import NoScheduleError, OneByOneSolver, Solver, SolverResult

# One being solved, and the next one, so that no process waits for the main process.
_TASKS_PER_PROCESS = 2


class Failure(NamedTuple):
    """
    :param message: The reason, in one line
    :param bound: A proven upper bound of the objective, if the solver has one
    """

    message: str
    bound: float | None = None

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """
        :param error: An exception of a solver
        :return: The failure
        """
        text = one_line(error)
        # Our messages are whole sentences; in others, the type often says most.
        is_ours = isinstance(error, ValueError | ImportError | NoScheduleError)
        bound = error.bound if isinstance(error, NoScheduleError) else None
        return cls(text if text and is_ours else f"{type(error).__name__}: {text}", bound)


class _Task(NamedTuple):
    """
    One instance for a worker, as NumPy arrays, because torch passes tensors through shared memory.

    :param solver: The solver
    :param n_uavs: Number of UAVs
    :param arrays: The other fields of :class:`Instances`, a batch of one
    :param row: Index of the instance in its set
    :param time_limit: Seconds
    :param seed: Seed of the solver
    """

    solver: OneByOneSolver
    n_uavs: int
    arrays: dict[str, np.ndarray]
    row: int
    time_limit: float | None
    seed: int

    @classmethod
    def of(cls, solver: OneByOneSolver, instances: Instances, row: int, time_limit: float | None, seed: int) -> _Task:
        fields = vars(instances[row])
        arrays = {name: value.numpy() for name, value in fields.items() if isinstance(value, th.Tensor)}
        return cls(solver, instances.n_uavs, arrays, row, time_limit, seed)

    def run(self) -> SolverResult | Failure:
        arrays = {name: th.from_numpy(value) for name, value in self.arrays.items()}
        instance = Instances(n_uavs=self.n_uavs, **arrays)
        return _solve_row(self.solver, instance, self.row, self.time_limit, self.seed)


def _solve_row(
    solver: OneByOneSolver, instance: Instances, row: int, time_limit: float | None, seed: int
) -> SolverResult | Failure:
    """
    :param solver: The solver
    :param instance: A batch of one
    :param row: Its index in its set
    :param time_limit: Seconds
    :param seed: Seed of the solver
    :return: The result, or the failure
    """
    try:
        return solver.solve_row(instance, row, time_limit, seed)
    except Exception as error:
        # Solvers call packages that raise exceptions of any kind; the other evaluations must continue.
        return Failure.of(error)


def _start_worker() -> None:
    """Initialize a worker."""
    th.set_num_threads(1)
    # Ctrl-C reaches all processes of a terminal; the main process ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker with the main process. Otherwise, if that is killed, workers run on or wait forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


class _RecordingContext(SpawnContext):
    """
    Starts the processes of an executor and records them, because executors cannot end their processes before Python 3.14.

    :ivar processes: All processes started so far
    """

    def __init__(self) -> None:
        self.processes: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        process = SpawnProcess(*args, **kwargs)
        self.processes.append(process)
        return process

    def end_all(self) -> None:
        """Kill all processes, whatever they are doing, and wait until they have ended."""
        started = [process for process in self.processes if process.pid is not None]
        for process in started:
            process.kill()
        # Not by joining them: the executor's thread does that, and only one of the two threads would see the exit code.
        alive = {process.sentinel for process in started}
        while alive:
            alive.difference_update(wait_for_handles(alive))


class Runner:
    """
    Runs solvers; instances of :class:`OneByOneSolver` in parallel processes if there is more than one. A context manager.

    :param n_jobs: Number of processes
    :raises ValueError: If it is less than 1
    """

    def __init__(self, n_jobs: int = 1) -> None:
        if n_jobs < 1:
            raise ValueError(f"The number of jobs is {n_jobs}; give at least 1.")
        self.n_jobs = n_jobs
        self._pool: ProcessPoolExecutor | None = None
        self._context = _RecordingContext()

    @property
    def processes(self) -> list[SpawnProcess]:
        """The processes of the pool that is in use."""
        return [] if self._pool is None else self._context.processes

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self._end_pool()

    def run(
        self, solver: Solver, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult | Failure]]:
        """
        :param solver: The solver
        :param instances: ``batch`` instances on the CPU
        :param rows: Indices of those to solve
        :param time_limit: Seconds per instance
        :param seed: Seed of the solver
        :return: Index and result of each, as they become known; in any order with several processes
        """
        if not isinstance(solver, OneByOneSolver):
            yield from self._run_batched(solver, instances, rows, time_limit, seed)
        elif self.n_jobs == 1:
            for row in rows:
                yield row, _solve_row(solver, instances[row], row, time_limit, seed)
        else:
            yield from self._run_in_processes([_Task.of(solver, instances, row, time_limit, seed) for row in rows])

    def _run_batched(
        self, solver: Solver, instances: Instances, rows: Sequence[int], time_limit: float | None, seed: int
    ) -> Iterator[tuple[int, SolverResult | Failure]]:
        missing = dict.fromkeys(rows)
        failure = Failure("the solver returned nothing")
        try:
            for row, result in solver.solve_rows(instances, rows, time_limit, seed):
                del missing[row]
                yield row, result
        except Exception as error:
            failure = Failure.of(error)
        yield from ((row, failure) for row in missing)

    def _run_in_processes(self, tasks: Sequence[_Task]) -> Iterator[tuple[int, SolverResult | Failure]]:
        waiting, suspects = deque(tasks), deque[_Task]()
        suspected: set[int] = set()
        running: dict[Future[SolverResult | Failure], _Task] = {}
        while waiting or suspects or running:
            # After a process has died, each instance that may have been the cause runs alone.
            queue, room = (suspects, 1) if suspects else (waiting, self.n_jobs * _TASKS_PER_PROCESS)
            while queue and len(running) < room:
                task = queue.popleft()
                running[self._submit(task)] = task
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    yield task.row, future.result()
                except (BrokenProcessPool, CancelledError):
                    self._end_pool()
                    if task.row in suspected:
                        yield task.row, Failure("its process died; was it out of memory?")
                    else:
                        suspected.add(task.row)
                        suspects.append(task)
                except Exception as error:
                    # A solver or result that cannot be pickled.
                    yield task.row, Failure.of(error)

    def _submit(self, task: _Task) -> Future[SolverResult | Failure]:
        if self._pool is None:
            self._context = _RecordingContext()
            self._pool = ProcessPoolExecutor(self.n_jobs, self._context, _start_worker)
        try:
            return self._pool.submit(task.run)
        except BrokenProcessPool:
            self._end_pool()
            return self._submit(task)

    def _end_pool(self) -> None:
        """End all processes, whatever they are doing."""
        if self._pool is None:
            return
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._context.end_all()
        self._pool = None

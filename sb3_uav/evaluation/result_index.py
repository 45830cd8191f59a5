"""Where results are in their files, and the figures that summaries need, in some 50 bytes for each."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from sb3_uav.evaluation.results import FAILED, INFEASIBLE, OK, ResultKey, ResultRow

_NONE = -1
STATUSES = (OK, INFEASIBLE, FAILED)


class Place(NamedTuple):
    """
    Where the two lines of a result are.

    :param result: Offset of its line in ``results.csv``, in bytes
    :param schedule: Offset of its line in ``schedules.jsonl``; -1 without one
    :param folder: Number of the folder, where several are merged
    """

    result: int
    schedule: int
    folder: int = 0


class Figures:
    """
    The results of one solver with one time limit and one seed, by the index of the instance.

    :param n_instances: Number of instances in all sets
    """

    def __init__(self, n_instances: int) -> None:
        self.result_at = np.full(n_instances, _NONE, np.int64)
        self.schedule_at = np.full(n_instances, _NONE, np.int64)
        self.folder = np.zeros(n_instances, np.int16)
        self.status = np.full(n_instances, _NONE, np.int8)
        self.objective = np.full(n_instances, np.nan)
        self.bound = np.full(n_instances, np.nan)
        self.seconds = np.full(n_instances, np.nan)
        self.batch_size = np.zeros(n_instances, np.int32)
        self.unserved = np.zeros(n_instances, np.int32)
        # Of failed and infeasible results; mostly few different ones.
        self.messages: dict[int, str] = {}
        self._known: dict[str, str] = {}

    def set(self, row: ResultRow, place: Place) -> None:
        """
        :param row: A result
        :param place: Where it is
        """
        number = row.instance
        self.result_at[number], self.schedule_at[number], self.folder[number] = place
        self.status[number] = STATUSES.index(row.status)
        self.objective[number] = math.nan if row.objective is None else row.objective
        self.bound[number] = math.nan if row.bound is None else row.bound
        self.seconds[number] = math.nan if row.seconds is None else row.seconds
        self.batch_size[number] = row.batch_size or 0
        self.unserved[number] = row.unserved or 0
        self.messages.pop(number, None)
        if row.status != OK:
            self.messages[number] = self._known.setdefault(row.message, row.message)

    def add(self, other: Figures) -> None:
        """
        :param other: Results on further instances
        """
        rows = other.present
        for name, values in vars(other).items():
            if isinstance(values, np.ndarray):
                getattr(self, name)[rows] = values[rows]
        for number, message in other.messages.items():
            self.messages[number] = self._known.setdefault(message, message)

    def drop(self, number: int) -> None:
        """
        :param number: An instance, whose result is forgotten
        """
        self.result_at[number] = self.schedule_at[number] = self.status[number] = _NONE
        self.messages.pop(number, None)

    def place(self, number: int) -> Place:
        """
        :param number: An instance with a result
        :return: Where it is
        """
        return Place(int(self.result_at[number]), int(self.schedule_at[number]), int(self.folder[number]))

    def move(self, number: int, place: Place) -> None:
        """
        :param number: An instance with a result
        :param place: Where it is from now on
        """
        self.result_at[number], self.schedule_at[number], self.folder[number] = place

    def status_of(self, number: int) -> str | None:
        """
        :param number: An instance
        :return: The status of its result, if it has one
        """
        status = int(self.status[number])
        return None if status == _NONE else STATUSES[status]

    def has_status(self, status: str) -> np.ndarray:
        """
        :param status: One of :data:`STATUSES`
        :return: Which instances have a result with it, ``(n_instances,)`` bool
        """
        return np.asarray(self.status == STATUSES.index(status))

    @property
    def present(self) -> np.ndarray:
        """Which instances have a result, ``(n_instances,)`` bool."""
        return np.asarray(self.status != _NONE)

    def selected(self, rows: np.ndarray) -> Figures:
        """
        :param rows: ``(n,)`` instances with results
        :return: Their figures, numbered as given
        """
        part = Figures(0)
        for name, values in vars(self).items():
            if isinstance(values, np.ndarray):
                setattr(part, name, values[rows])
        if self.messages:
            part.messages = {new: self.messages[old] for new, old in enumerate(rows.tolist()) if old in self.messages}
        return part


class ResultIndex:
    """
    The results of a folder, by solver, time limit and seed.

    :param n_instances: Number of instances in all sets
    """

    def __init__(self, n_instances: int) -> None:
        self.n_instances = n_instances
        self.runs: dict[tuple[str, float | None, int], Figures] = {}

    def run(self, solver: str, time_limit: float | None, seed: int) -> Figures:
        """
        :param solver: Name of a solver
        :param time_limit: Seconds that it was given
        :param seed: Its seed
        :return: Its results, possibly none yet
        """
        key = (solver, time_limit, seed)
        if key not in self.runs:
            self.runs[key] = Figures(self.n_instances)
        return self.runs[key]

    def of(self, key: ResultKey) -> Figures:
        """
        :param key: Identifies a result
        :return: The results among which it is
        """
        return self.run(key.solver, key.time_limit, key.seed)

    def in_order(self, set_starts: Iterable[int], solvers: Iterable[str]) -> Iterator[tuple[Figures, int]]:
        """
        :param set_starts: Index of the first instance of every set, in order, and the number of all instances
        :param solvers: Names of the solvers, in order
        :return: The results set by set, and within a set in the order of solvers, seeds, time limits and instances
        """
        starts, order = list(set_starts), {name: position for position, name in enumerate(solvers)}

        def position(key: tuple[str, float | None, int]) -> tuple[float, ...]:
            solver, limit, seed = key
            return order[solver], seed, -math.inf if limit is None else limit

        runs = [self.runs[key] for key in sorted(self.runs, key=position)]
        for first, end in itertools.pairwise(starts):
            for run in runs:
                for number in np.nonzero(run.present[first:end])[0].tolist():
                    yield run, first + number

"""Reading, checking and copying the lines of ``results.csv`` and ``schedules.jsonl`` without holding them in memory."""

from __future__ import annotations

import csv
import io
from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from itertools import accumulate
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.checked_result import check_again
from sb3_uav.evaluation.result_index import Place, ResultIndex
from sb3_uav.evaluation.results import (
    FAILED,
    RESULT_COLUMNS,
    RESULTS_FILE,
    SCHEDULES_FILE,
    SETTINGS_FILE,
    Line,
    damaged,
    iterate_results,
    iterate_schedules,
    parse_result,
)


def read_index(
    folder: Path, sets: Sequence[Mapping[str, Any]], solvers: Collection[str], without_limit: Collection[str] = ()
) -> ResultIndex:
    """
    :param folder: Folder of an evaluation
    :param sets: Its sets of instances, as ``evaluation.json`` describes them
    :param solvers: Names of its solvers
    :param without_limit: Solvers whose failures at a time limit are left out
    :return: Its results; without those whose schedule is missing
    :raises ValueError: If a file is damaged, holds two results for one, or results of anything else
    """
    path = folder / RESULTS_FILE
    ends = list(accumulate(one["n_instances"] for one in sets))
    index = ResultIndex(ends[-1])
    for line, row in iterate_results(path):
        if row.solver not in solvers or row.source not in [one["name"] for one in sets]:
            raise ValueError(
                f"{path}, line {line.number}: holds results of {row.solver!r:.80} on {row.source!r:.80}, of which "
                f"{SETTINGS_FILE} holds no description; choose another folder, or start over with --overwrite."
            )
        number = bisect_right(ends, row.instance)
        if row.instance >= ends[-1] or sets[number]["name"] != row.source:
            raise damaged(path, line, f"instance is {row.instance}, which is not one of {row.source!r:.80}")
        if row.status == FAILED and row.time_limit is not None and row.solver in without_limit:
            continue
        run = index.of(row.key)
        # A failure stands beside the later result of the same instance until the file is rewritten.
        if run.status_of(row.instance) not in (None, FAILED):
            raise damaged(path, line, f"a second result of {row.solver!r} on instance {row.instance}")
        run.set(row, Place(line.offset, -1))
    _find_schedules(folder / SCHEDULES_FILE, index)
    for run in index.runs.values():
        for number in np.nonzero(run.present & ~run.has_status(FAILED) & (run.schedule_at < 0))[0].tolist():
            run.drop(number)
    return index


def _find_schedules(path: Path, index: ResultIndex) -> None:
    """
    :param path: A ``schedules.jsonl``
    :param index: The results; learns where their schedules are. Others belong to results that a crash cut short
    :raises ValueError: If the file is damaged
    """
    for line, key in iterate_schedules(path):
        run = index.runs.get((key.solver, key.time_limit, key.seed))
        is_known = run is not None and 0 <= key.instance < index.n_instances
        if run is None or not is_known or run.status_of(key.instance) in (None, FAILED):
            continue
        if run.schedule_at[key.instance] >= 0:
            raise damaged(path, line, f"a second schedule of {key.solver!r} on instance {key.instance}")
        run.schedule_at[key.instance] = line.offset


class ResultLines:
    """
    The lines of the files of a folder. A context manager.

    :param folder: Folder of an evaluation
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / RESULTS_FILE
        self._stack = ExitStack()
        self._results: IO[bytes] = self._stack.enter_context(self.path.open("rb"))
        schedules = folder / SCHEDULES_FILE
        self._schedules: IO[bytes] | None = self._stack.enter_context(schedules.open("rb")) if schedules.exists() else None
        header = self._results.readline().decode().rstrip("\n")
        self._columns = header.split(",")

    def __enter__(self) -> ResultLines:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._stack.close()

    def result(self, place: Place) -> bytes:
        """
        :param place: Where a result is
        :return: Its line of ``results.csv``
        """
        self._results.seek(place.result)
        line = self._results.readline()
        if self._columns == list(RESULT_COLUMNS):
            return line
        # Of an earlier version.
        text = io.StringIO()
        row = parse_result(self._columns, line.decode().rstrip("\n"))
        csv.writer(text, lineterminator="\n").writerow(row.cells)
        return text.getvalue().encode()

    def schedule(self, place: Place) -> bytes | None:
        """
        :param place: Where a result is
        :return: Its line of ``schedules.jsonl``, if it has one
        """
        if place.schedule < 0 or self._schedules is None:
            return None
        self._schedules.seek(place.schedule)
        return self._schedules.readline()

    def check_again(self, index: ResultIndex, batch: Instances, first: int) -> None:
        """
        :param index: The results
        :param batch: Some of the instances
        :param first: Index of the first of them
        :raises ValueError: If a result of theirs is not what the checker says of its routes
        """
        for run in index.runs.values():
            for row in np.nonzero(run.present[first : first + len(batch)])[0].tolist():
                place = run.place(first + row)
                text, schedule = self.result(place).decode().rstrip("\n"), self.schedule(place)
                kept = parse_result(RESULT_COLUMNS, text)
                try:
                    check_again(batch, row, kept, None if schedule is None else schedule.decode())
                except ValueError as error:
                    raise damaged(self.path, Line(self._number(place), 0, ""), error) from error

    def _number(self, place: Place) -> int:
        """:return: Number of the line of a result, from 1"""
        self._results.seek(0)
        return self._results.read(place.result).count(b"\n") + 1


def copy_in_order(
    index: ResultIndex, sets: Sequence[Mapping[str, Any]], solvers: Sequence[str], folders: Sequence[Path], out: Path
) -> None:
    """
    Write both files: set by set, and within a set in the order of solvers, seeds, time limits and instances.

    :param index: The results; afterwards, where they are in the new files
    :param sets: The sets of instances, as ``evaluation.json`` describes them
    :param solvers: Names of the solvers
    :param folders: Folders that hold the lines
    :param out: The folder to write to, which may be one of them
    """
    starts = list(accumulate((one["n_instances"] for one in sets), initial=0))
    with ExitStack() as stack:
        lines: list[ResultLines] = []
        if any(run.present.any() for run in index.runs.values()):
            lines = [stack.enter_context(ResultLines(folder)) for folder in folders]
        # The file that is opened last is complete first: a result without its schedule does not count.
        results = stack.enter_context(replaced_when_complete(out / RESULTS_FILE))
        schedules = stack.enter_context(replaced_when_complete(out / SCHEDULES_FILE))
        write_csv(results, RESULT_COLUMNS, ())
        places = [len(",".join(RESULT_COLUMNS)) + 1, 0]
        for run, number in index.in_order(starts, solvers):
            place = run.place(number)
            texts = lines[place.folder].result(place), lines[place.folder].schedule(place)
            run.move(number, Place(places[0], -1 if texts[1] is None else places[1]))
            for which, (file, text) in enumerate(zip((results, schedules), texts, strict=True)):
                if text is not None:
                    file.write(text.decode())
                    places[which] += len(text)

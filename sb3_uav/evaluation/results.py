"""The lines of ``results.csv`` and ``schedules.jsonl``: what they hold, and how they are read."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from sb3_uav.common.json_text import parse_json
from sb3_uav.common.regular_file import open_regular

RESULTS_FILE = "results.csv"
SCHEDULES_FILE = "schedules.jsonl"
SETTINGS_FILE = "evaluation.json"
OK, INFEASIBLE, FAILED = "ok", "infeasible", "failed"


class ResultKey(NamedTuple):
    """
    Identifies a result.

    :param solver: Name of the solver
    :param instance: Index of the instance, counted through all sets
    :param time_limit: Seconds that the solver was given; None if it had none, or ignores it
    :param seed: Seed of the solver
    """

    solver: str
    instance: int
    time_limit: float | None
    seed: int


@dataclass(frozen=True)
class ResultRow:
    """
    One line of ``results.csv``. Unknown values are None, and empty cells in the file.

    :param solver: Name of the solver
    :param instance: Index of the instance, counted through all sets
    :param n_uavs: Number of UAVs
    :param n_tasks: Number of tasks
    :param objective: Total value of the visited tasks; None without a feasible schedule
    :param length: Total length of the tours; None without a feasible schedule
    :param seconds: Wall time of the instance: that of its batch, divided by the size of the batch
    :param feasible: Whether the checker accepted the schedule
    :param source: Name of the set of instances
    :param time_limit: Seconds that the solver was given
    :param seed: Seed of the solver
    :param batch_size: How many instances were solved at once
    :param bound: A proven upper bound of the objective; possibly also of a solver that found no schedule
    :param status: ``ok``; ``infeasible`` if the checker refused the schedule; ``failed`` if the solver returned none
    :param message: What the checker or the solver said, in one line; with ``ok``, which tasks that must be served are not
    :param unserved: How many tasks that must be served are not; None without a feasible schedule
    """

    solver: str
    instance: int
    n_uavs: int
    n_tasks: int
    objective: float | None
    length: float | None
    seconds: float | None
    feasible: bool
    source: str
    time_limit: float | None
    seed: int
    batch_size: int | None
    bound: float | None
    status: str
    message: str
    unserved: int | None = None

    @property
    def key(self) -> ResultKey:
        return ResultKey(self.solver, self.instance, self.time_limit, self.seed)

    @property
    def cells(self) -> list[Any]:
        """The values in the order of the columns; without the deep copies of ``dataclasses.astuple``."""
        return [getattr(self, name) for name in RESULT_COLUMNS]


RESULT_COLUMNS = tuple(field.name for field in fields(ResultRow))
# Of earlier versions, whose results are read and resumed as well.
_EARLIER_COLUMNS = tuple(name for name in RESULT_COLUMNS if name != "unserved")
_WHOLE_NUMBERS = {"instance", "n_uavs", "n_tasks", "seed", "batch_size", "unserved"}
_NUMBERS = {"objective", "length", "seconds", "time_limit", "bound"}
_OPTIONAL = {"objective", "length", "seconds", "time_limit", "batch_size", "bound", "unserved"}


# Whole numbers but seeds are below, so that the arrays of summaries hold them.
_MAX_WHOLE_NUMBER = 2**31
# A schedule of a million tasks takes 8 MB.
_MAX_LINE = 16 * 2**20


def one_line(text: object) -> str:
    """
    :param text: Anything that can be printed
    :return: The text without line breaks
    """
    return " ".join(str(text).split())


class Line(NamedTuple):
    """
    A line of a file.

    :param number: From 1
    :param offset: Where it begins, in bytes
    :param text: Its text, without the line break
    """

    number: int
    offset: int
    text: str


def read_results(path: Path) -> list[ResultRow]:
    """
    :param path: A ``results.csv``; a last line that a crash cut short is left out
    :return: Its rows
    :raises ValueError: If another program, or a later version, wrote it, or it was damaged
    """
    return [row for _, row in iterate_results(path)]


def iterate_results(path: Path) -> Iterator[tuple[Line, ResultRow]]:
    """
    :param path: As of :func:`read_results`
    :return: Its rows, one after the other, with their lines
    :raises ValueError: As :func:`read_results`
    """
    lines = whole_lines(path)
    header = next(lines, Line(1, 0, "")).text
    columns = {",".join(names): names for names in (RESULT_COLUMNS, _EARLIER_COLUMNS)}.get(header)
    if columns is None:
        raise ValueError(
            f"{path}: its columns are not those that this version writes ({header!r:.120}); "
            "choose another folder, or start over with --overwrite."
        )
    for line in lines:
        try:
            row = parse_result(columns, line.text)
        except (ValueError, csv.Error, StopIteration) as error:
            raise damaged(path, line, error) from error
        yield line, row


def damaged(path: Path, line: Line, what: object) -> ValueError:
    """
    :param path: A file of results
    :param line: One of its lines
    :param what: What is wrong with it
    :return: The error to raise
    """
    return ValueError(
        f"{path}, line {line.number}: is damaged ({what!s:.300}); correct or delete that line, or start over with --overwrite."
    )


def whole_lines(path: Path) -> Iterator[Line]:
    """
    :param path: A text file that was written line by line
    :return: Its lines, except for a last one without a line break
    :raises ValueError: If it is not a text file
    """
    offset = number = 0
    with open_regular(path) as file:
        # In binary, where only line feeds end lines: other line breaks may be part of a name.
        while content := file.readline(_MAX_LINE + 1):
            number += 1
            if len(content) > _MAX_LINE:
                raise ValueError(
                    f"{path}: is damaged (line {number} has more than the {_MAX_LINE} bytes that are read); "
                    "start over with --overwrite."
                )
            if not content.endswith(b"\n"):
                return
            try:
                text = content[:-1].decode("utf-8")
            except UnicodeDecodeError as error:
                raise ValueError(f"{path}: is damaged (line {number}: {error}); start over with --overwrite.") from error
            yield Line(number, offset, text)
            offset += len(content)


def parse_result(columns: Sequence[str], text: str) -> ResultRow:
    """
    :param columns: Names of the columns
    :param text: One line of ``results.csv``
    :return: The row
    :raises ValueError: If a cell has a wrong value
    :raises csv.Error: If it is no line of a CSV
    :raises StopIteration: If it is empty
    """
    cells = next(csv.reader([text], strict=True))
    if len(cells) != len(columns):
        raise ValueError(f"{len(cells)} cells instead of {len(columns)}")
    values: dict[str, Any] = dict(zip(columns, cells, strict=True))
    if "unserved" not in values:
        # The message of a feasible schedule names them, one after the other.
        message = values["message"]
        values["unserved"] = (message.count(",") + 1 if message else 0) if values["status"] == OK else ""
    for name in _WHOLE_NUMBERS | _NUMBERS:
        if values[name] == "" and name in _OPTIONAL:
            values[name] = None
        else:
            values[name] = int(values[name]) if name in _WHOLE_NUMBERS else float(values[name])
            is_within = math.isfinite(values[name]) if name in _NUMBERS else 0 <= values[name] < _MAX_WHOLE_NUMBER
            if name != "seed" and not is_within:
                raise ValueError(f"{name} is {values[name]}{', below 0' if values[name] < 0 else ''}")
    if values["feasible"] not in ("True", "False") or values["status"] not in (OK, INFEASIBLE, FAILED):
        raise ValueError(f"feasible is {values['feasible']!r} and status is {values['status']!r}")
    values["feasible"] = values["feasible"] == "True"
    for name in ("instance", "seed", "seconds", "time_limit"):
        if values[name] is not None and values[name] < 0:
            raise ValueError(f"{name} is {values[name]}, below 0")
    return ResultRow(**values)


def read_schedules(path: Path) -> dict[ResultKey, str]:
    """
    :param path: A ``schedules.jsonl``, which may be missing
    :return: Its lines by result
    :raises ValueError: If it was damaged
    """
    return {key: line.text for line, key in iterate_schedules(path)}


def iterate_schedules(path: Path) -> Iterator[tuple[Line, ResultKey]]:
    """
    :param path: A ``schedules.jsonl``, which may be missing
    :return: Its lines, one after the other, with the results that they belong to
    :raises ValueError: If it was damaged
    """
    if not path.exists():
        return
    for line in whole_lines(path):
        try:
            record = parse_json(line.text)
            key = ResultKey(*(record[name] for name in ResultKey._fields))
            is_whole = type(key.instance) is int and type(key.seed) is int and type(key.solver) is str
            if not is_whole or type(key.time_limit) not in (int, float, type(None)):
                raise ValueError(f"it is of {tuple(key)}")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise damaged(path, line, repr(error)) from error
        yield line, key

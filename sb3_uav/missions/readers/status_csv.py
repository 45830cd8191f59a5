"""
Status files: what has happened since a mission was planned.

One CSV file with rows of five kinds, in any order::

    what,id,lat,lon,remaining_m,value,service_s,must
    uav,uav-1,47.3812,8.5412,5200,,,
    uav,uav-2,47.3790,8.5501,3100,,,
    lost,uav-3
    done,t17
    done,t4
    drop,t40
    task,new-1,47.3811,8.5523,,5,20,yes

- ``uav``: where a UAV is and how far it still flies: ``remaining_m`` (meters), ``remaining_percent`` (of its whole range) or
  ``remaining_min`` (minutes at cruise speed), down to an empty battery. The reserve is kept off it later. Without ``lat`` and
  ``lon`` it is where its route begins.
- ``done``: a task that is done, by whomever.
- ``lost``: a UAV that flies no more. Its tasks are free again.
- ``task``: a new task. ``value`` is 1, ``service_s`` 0 and ``must`` no where nothing stands.
- ``drop``: a task that nobody wants any more.

Plans in a plane have ``x`` and ``y`` in place of ``lat`` and ``lon``. Columns may stand in any order, and those that no row
needs may be missing; a column ``note`` is for people. Rows of ``done``, ``lost`` and ``drop`` need a name only. What no row
names is as planned: a UAV without a row is where its route begins.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from sb3_uav.common.regular_file import open_regular
from sb3_uav.missions.coordinates import System
from sb3_uav.missions.readers.table import DELIMITERS, decoded
from sb3_uav.missions.status import KINDS, NewTask, RemainingUnit, Status, UavReport

_MAX_BYTES = 10 * 2**20
_MAX_ROWS = 100_000
_MAX_NAME = 200
# Other names of columns.
_ALIASES = {
    "kind": "what",
    "event": "what",
    "name": "id",
    "latitude": "lat",
    "longitude": "lon",
    "lng": "lon",
    "long": "lon",
    "priority": "value",
    "comment": "note",
}
_REMAINING: dict[str, RemainingUnit] = {"remaining_m": "m", "remaining_percent": "percent", "remaining_min": "min"}
_OF_TASKS = ("value", "service_s", "must", "altitude_m")
_COLUMNS = ("what", "id", "lat", "lon", "x", "y", *_REMAINING, *_OF_TASKS, "note")
_YES, _NO = ("yes", "y", "true", "1"), ("no", "n", "false", "0", "")
# The greatest number that means anything in these files, in any unit.
_MAX_NUMBER = 1e9


class _Row:
    """
    One row of a status file.

    :param place: File and row, for errors
    :param cells: Cells by the name of their column, without blanks around them
    """

    def __init__(self, place: str, cells: Mapping[str, str]) -> None:
        self.place = place
        self._cells = cells

    def fail(self, problem: str) -> NoReturn:
        """:raises ValueError: Always"""
        raise ValueError(f"{self.place}: {problem}")

    def text(self, column: str) -> str:
        """:return: A cell, empty if the column is missing"""
        return self._cells.get(column, "")

    def number(self, column: str, low: float, high: float, default: float | None = None) -> float | None:
        """
        :param column: Name of the column
        :param low: The least number allowed
        :param high: The greatest
        :param default: What an empty cell stands for
        :return: The number
        :raises ValueError: If the cell holds no such number
        """
        text = self.text(column)
        if not text:
            return default
        try:
            # Python reads 1_0 as 10.
            number = float("nan" if "_" in text else text)
        except ValueError:
            advice = "write decimals with a point" if "," in text else "write digits only, the unit is in the column's name"
            self.fail(f"{column} is {text[:40]!r}, which is no number; {advice}.")
        if not low <= number <= high:
            self.fail(f"{column} is {text[:40]}; give a number from {low:g} to {high:g}.")
        return number

    def yes(self, column: str) -> bool:
        """:return: Whether the cell says yes; False if it is empty"""
        text = self.text(column).lower()
        if text not in (*_YES, *_NO):
            self.fail(f"{column} is {text[:40]!r}; write yes or no.")
        return text in _YES

    def point(self, names: tuple[str, str]) -> tuple[float, float] | None:
        """
        :param names: Columns of the coordinates
        :return: The point; None if both cells are empty
        :raises ValueError: If one is empty, or out of range
        """
        filled = [name for name in names if self.text(name)]
        if not filled:
            return None
        if len(filled) == 1:
            missing = names[1 - names.index(filled[0])]
            self.fail(f"{filled[0]} is {self.text(filled[0])[:40]}, but {missing} is empty; give both or none.")
        wide = [self.number(name, -_MAX_NUMBER, _MAX_NUMBER) or 0.0 for name in names]
        if names == ("lat", "lon"):
            if abs(wide[0]) > 90 >= abs(wide[1]) and abs(wide[0]) <= 180:
                self.fail(f"lat is {wide[0]:g}, which is out of range, and lon {wide[1]:g}; the two look swapped.")
            for name, limit in (("lat", 90.0), ("lon", 180.0)):
                self.number(name, -limit, limit)
        return wide[0], wide[1]


def read_status(path: Path) -> Status:
    """
    :param path: A status file, see the head of this module
    :return: What it says; whether the plan has these UAVs and tasks is not checked here
    :raises OSError: If the file cannot be read
    :raises ValueError: If something in it is wrong; the message names the row
    """
    with open_regular(path) as file:
        return read_status_from_bytes(file.read(_MAX_BYTES + 1), str(path))


def read_status_from_bytes(data: bytes, source: str) -> Status:
    """
    :param data: The content of a status file
    :param source: Its name, for errors
    :return: As of :func:`read_status`
    :raises ValueError: If something in it is wrong; the message names the row
    """
    rows, columns = _rows(data, source)
    plane = {"x", "y"} & columns
    names: tuple[str, str] = ("x", "y") if plane else ("lat", "lon")
    uavs, tasks = [], []
    places: dict[tuple[str, str], str] = {}
    named: dict[str, list[str]] = {kind: [] for kind in KINDS}
    for number, row in rows:
        kind, name = row.text("what").lower(), row.text("id")
        if kind not in KINDS:
            near = difflib.get_close_matches(kind, KINDS, 1, 0.5)
            advice = f"did you mean {near[0]}? It is" if near else "write"
            row.fail(f"what is {row.text('what')[:40]!r}; {advice} one of {', '.join(KINDS)}.")
        if not name:
            row.fail(f"id is empty; name the {'UAV' if kind in ('uav', 'lost') else 'task'}.")
        if len(name) > _MAX_NAME:
            row.fail(f"id has {len(name)} characters; {_MAX_NAME} are the most.")
        if (kind, name) in places:
            row.fail(f"{kind} {name} stands in {places[kind, name]} already; leave one of the two.")
        places[kind, name] = f"row {number}"
        named[kind].append(name)
        if kind == "uav":
            uavs.append(_report(row, name, names))
        elif kind == "task":
            tasks.append(_new_task(row, name, names))
    for one, other, what in (("uav", "lost", "UAV"), ("done", "drop", "task")):
        both = [name for name in named[one] if name in set(named[other])]
        if both:
            raise ValueError(
                f"{source}: {what} {both[0]} stands in {places[one, both[0]]} ({one}) and in {places[other, both[0]]} "
                f"({other}); leave one of the two."
            )
    system: System | None = "plane" if plane else "wgs84" if {"lat", "lon"} & columns else None
    return Status(
        tuple(uavs),
        tuple(named["done"]),
        tuple(named["lost"]),
        tuple(tasks),
        tuple(named["drop"]),
        system,
        places,
        source,
    )


def _report(row: _Row, name: str, names: tuple[str, str]) -> UavReport:
    """:return: What a row about a UAV says"""
    for column in _OF_TASKS:
        if row.text(column):
            row.fail(f"{column} is {row.text(column)[:40]}, but this is a UAV, not a task; clear the cell.")
    position = row.point(names)
    given = [column for column in _REMAINING if row.text(column)]
    if len(given) > 1:
        row.fail(f"{' and '.join(given)} both say how far UAV {name} still flies; clear one of them.")
    if not given:
        known = "where UAV {} is, but not" if position is not None else "neither where UAV {} is nor"
        row.fail(f"this says {known.format(name)} how far it still flies; give {', '.join(_REMAINING)}, one of them.")
    unit = _REMAINING[given[0]]
    remaining = row.number(given[0], 0.0, 100.0 if unit == "percent" else _MAX_NUMBER)
    return UavReport(name, position, remaining, unit)


def _new_task(row: _Row, name: str, names: tuple[str, str]) -> NewTask:
    """:return: What a row about a new task says"""
    for column in _REMAINING:
        if row.text(column):
            row.fail(f"{column} is {row.text(column)[:40]}, but this is a task, not a UAV; clear the cell.")
    point = row.point(names)
    if point is None:
        row.fail(f"{' and '.join(names)} are empty; say where task {name} is.")
    value, service = row.number("value", 0.0, _MAX_NUMBER, 1.0), row.number("service_s", 0.0, _MAX_NUMBER, 0.0)
    altitude = row.number("altitude_m", -10_000.0, 10_000.0, math.nan)
    assert value is not None and service is not None and altitude is not None
    return NewTask(name, point, value, service, row.yes("must"), altitude)


def _rows(data: bytes, source: str) -> tuple[list[tuple[int, _Row]], set[str]]:
    """
    :param data: The content of a file
    :param source: Its name
    :return: Its rows that are not empty, with their numbers, the header being 1; and the names of its columns
    :raises ValueError: If it is no table, or the header is wrong
    """
    if len(data) > _MAX_BYTES:
        raise ValueError(f"{source}: the file has more than {_MAX_BYTES // 2**20} MB; a status file is far smaller.")
    text = decoded(data, source)
    head = text.lstrip().partition("\n")[0]
    delimiter = max(DELIMITERS, key=head.count)
    try:
        table = list(csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise ValueError(f"{source}: this is no CSV file ({error}); look for a quote that is not closed.") from error
    numbered = [
        (number, [cell.strip() for cell in cells]) for number, cells in enumerate(table, 1) if any(map(str.strip, cells))
    ]
    if not numbered:
        raise ValueError(f"{source}: the file is empty; its first row names the columns, such as what,id,lat,lon,remaining_m.")
    (first, header), *others = numbered
    if len(others) > _MAX_ROWS:
        raise ValueError(f"{source}: there are {len(others)} rows; {_MAX_ROWS} are the most.")
    columns = _column_names(header, f"{source}: row {first}")
    rows = []
    for number, cells in others:
        place = f"{source}: row {number}"
        if any(cells[len(columns) :]):
            raise ValueError(f"{place}: there are {len(cells)} cells, but the first row names {len(columns)} columns.")
        rows.append((number, _Row(place, dict(zip(columns, cells, strict=False)))))
    return rows, set(columns)


def _column_names(header: Sequence[str], place: str) -> list[str]:
    """
    :param header: Cells of the first row
    :param place: File and row, for errors
    :return: Names of the columns
    :raises ValueError: If one is not known, missing or there twice, or coordinates are mixed
    """
    columns = [_ALIASES.get(name.lower(), name.lower()) for name in header]
    # Spreadsheets write empty columns at the right.
    while columns and not columns[-1]:
        columns.pop()
    for column, name in zip(columns, header, strict=False):
        if column not in _COLUMNS:
            near = difflib.get_close_matches(column, _COLUMNS, 1, 0.6)
            guess = f"did you mean {near[0]}?" if near else "rename or remove it."
            raise ValueError(f"{place}: column {name[:40]!r} is not known; {guess} Columns are {', '.join(_COLUMNS)}.")
        if columns.count(column) > 1:
            raise ValueError(f"{place}: there are several columns for {column}; leave one of them.")
    for column in ("what", "id"):
        if column not in columns:
            raise ValueError(f"{place}: there is no column {column}; the first row is such as what,id,lat,lon,remaining_m.")
    given = [column for column in ("lat", "lon", "x", "y") if column in columns]
    if given not in ([], ["lat", "lon"], ["x", "y"]):
        raise ValueError(f"{place}: coordinates are {' and '.join(given)}; give lat and lon, or x and y.")
    return columns

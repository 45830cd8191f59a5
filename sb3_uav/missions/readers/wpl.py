"""
Tasks in ``QGC WPL 110``, the plain text of waypoints that QGroundControl, Mission Planner and MAVProxy write.

Format: https://mavlink.io/en/file_formats/. What the items mean for tasks is said in
:mod:`sb3_uav.missions.readers.waypoints`.
"""

from __future__ import annotations

import math
import re

from sb3_uav.missions.readers.json_file import decode_utf8, shown
from sb3_uav.missions.readers.waypoints import ReadItem, tasks_of_items
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.wpl import HEADER

_N_FIELDS = 12
_FIELDS = (
    "index", "current", "frame", "command", "param 1", "param 2", "param 3", "param 4", "latitude", "longitude", "altitude",
    "autocontinue",
)  # fmt: skip
# Much longer than 12 numbers need.
_LONGEST_LINE = 1000
_MOST_LINES = 1_000_000


def read_wpl(data: bytes, source: str) -> TaskList:
    """
    Read waypoints as tasks, called ``wp-3`` after their index, and row 0 as the depot (none if it is at (0, 0)). Fields are
    separated by tabs or spaces; empty lines and lines that begin with ``#`` do not count. The format has neither values nor
    ids, so that every task is worth 1.

    :param data: The file
    :param source: Its name, for errors
    :return: The tasks in the order of the file, coordinates not checked for their range
    :raises ValueError: If something is wrong or cannot be honored; the message names the line, counted from 1
    """
    text = decode_utf8(data, source)
    if text.count("\n") + text.count("\r") > _MOST_LINES:
        raise ValueError(f"{source}: the file has more than {_MOST_LINES} lines; divide it.")
    lines = re.split("\r\n|\n|\r", text)
    if lines[0].split() != HEADER.split():
        raise ValueError(f"{source}: line 1 is {shown(lines[0])}; files of waypoints begin with {HEADER!r}.")
    items = [
        _read_line(line, f"line {number}", f"{source}: line {number}")
        for number, line in enumerate(lines[1:], 2)
        if line.strip() and not line.startswith("#")
    ]
    if not items:
        raise ValueError(f"{source}: there are no waypoints; row 0 is home, and tasks follow.")
    home, *rest = items
    if home.number != 0:
        raise ValueError(f"{source}: {home.place}: the index is {home.number}; the first row is home, with index 0.")
    return tasks_of_items(rest, home.params[4:6], source)


def _read_line(line: str, place: str, where: str) -> ReadItem:
    fields = line.split() if len(line) <= _LONGEST_LINE else []
    if len(fields) != _N_FIELDS:
        raise ValueError(f"{where} is {shown(line)}; write {_N_FIELDS} numbers, separated by tabs.")
    index, _, frame, command, *params, _ = (_number(text, name, where) for text, name in zip(fields, _FIELDS, strict=True))
    whole = [_whole(value, name, where) for value, name in ((index, "index"), (frame, "frame"), (command, "command"))]
    return ReadItem(place, whole[0], whole[2], whole[1], tuple(params))


def _number(text: str, name: str, where: str) -> float | None:
    """:return: A number; None for NaN, by which a parameter is left to the autopilot"""
    # float() takes "1_000" and digits of every script, which other programs do not.
    try:
        value = float(text) if text.isascii() and "_" not in text else math.inf
    except ValueError:
        value = math.inf
    if math.isnan(value) and name.startswith("param"):
        return None
    if not math.isfinite(value):
        raise ValueError(f"{where}: {name} is {shown(text)}; write a finite number, with a point and not a comma.")
    return value


def _whole(value: float | None, name: str, where: str) -> int:
    if value is None or value < 0 or not value.is_integer():
        raise ValueError(f"{where}: {name} is {shown(value)}; write a whole number.")
    return int(value)

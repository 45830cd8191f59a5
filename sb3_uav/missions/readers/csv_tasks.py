"""
Tasks in CSV: one row per task, under a header.

====================  ====================================================================================================
column                meaning
====================  ====================================================================================================
``id``                name of the task; tasks are numbered from 1 without it
``lat``, ``lon``      position on WGS84 in degrees
``x``, ``y``          position in a plane, in place of these: ``x_m``, ``x_km``, ``x_ft``, ... or in meters
``value``             0 or more, greater is better; 1 without it
``service_s``         time that a UAV stays there; also ``service_min``, ``service_h``; 0 without it
``must``              yes for a task that comes first
``alt_m``             meters above the depot at which it is served; also ``alt_ft``
``depot``             yes in the row that is the depot; or ``type`` with the word depot
====================  ====================================================================================================

Names of columns may be in capitals, and have the synonyms in :data:`FIELDS`. Cells for ``service_s``, ``must``, ``alt_m`` and
``depot`` may be empty. Columns with other names are ignored, unless they look like a misspelled one that is missing, or ask
for what is not modeled.
"""

from __future__ import annotations

import math

import numpy as np

from sb3_uav.missions.checks import MAX_TASKS, UNNAMED, check_not_degrees, check_tasks
from sb3_uav.missions.coordinates import System
from sb3_uav.missions.readers.columns import Cells, Column, Field, match_columns
from sb3_uav.missions.readers.table import Table, read_table
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.units import DURATIONS, LENGTHS, length_unit, number_of

_DEGREES = dict.fromkeys(("deg", "degrees", "°", "wgs84"), 1.0)
_METERS_OR_FEET = {name: LENGTHS[name] for name in ("m", "meters", "metres", "ft", "feet")}
#: What columns may mean.
FIELDS = (
    Field("id", ("id", "task_id", "task", "point_id", "point", "name", "label"), is_text=True, has_rank=True),
    Field("lat", ("lat", "latitude"), _DEGREES, is_degrees=True),
    Field("lon", ("lon", "lng", "long", "longitude"), _DEGREES, is_degrees=True),
    Field("x", ("x", "east", "easting"), LENGTHS),
    Field("y", ("y", "north", "northing"), LENGTHS),
    Field("value", ("value", "priority", "prize", "score", "profit", "reward")),
    Field(
        "service",
        ("service", "hold", "service_time", "hold_time", "hover", "hover_time", "duration"),
        DURATIONS,
        needs_unit=True,
    ),
    Field("must", ("must", "must_serve", "mandatory", "must_visit"), is_text=True),
    Field("alt", ("alt", "altitude"), _METERS_OR_FEET, needs_unit=True),
    Field("depot", ("depot", "is_depot"), is_text=True),
    Field("type", ("type",), is_text=True),
)
_WINDOWS = "time windows are"
_REFUSED = {
    **dict.fromkeys(
        ("tw_start", "tw_end", "ready_time", "due_time", "due_date", "earliest", "latest", "time_window"), _WINDOWS
    ),
    **dict.fromkeys(("demand", "payload", "payload_kg"), "payloads are"),
}
_HARMLESS = ("note", "notes", "comment", "comments", "description", "desc", "remark", "remarks", "date", "time", "color")
_DEPOT_TYPES = frozenset(("depot", "home", "base"))
_EXAMPLE = "id,lat,lon or id,x_m,y_m"


def read_csv_tasks(data: bytes, source: str, unit: str | None = None) -> TaskList:
    """
    :param data: Content of the file
    :param source: Its name, for errors
    :param unit: Unit of x and y, where their names do not have one
    :return: The tasks, which :func:`~sb3_uav.missions.checks.check_tasks` has still to see
    :raises ValueError: If it is no such table; the message names row, column and what was found
    """
    known = {synonym.split("_")[0] for field in FIELDS for synonym in field.synonyms}
    table = read_table(data, source, sorted(known), MAX_TASKS + 1, _EXAMPLE)
    columns = match_columns(table, FIELDS, _REFUSED, _HARMLESS)
    system = _system(table, columns)
    meters_per_unit, has_unit = _unit(columns, system, unit, source)
    cells = Cells(table, columns)
    depots = [row for row in range(len(table.rows)) if _is_depot(cells, row)]
    if len(depots) > 1:
        raise ValueError(f"{cells.where(depots[1])}: a second depot, after that in row {table.rows[depots[0]][0]}; keep one.")
    tasks = [row for row in range(len(table.rows)) if row not in depots]
    if not tasks:
        raise ValueError(f"{source}: there is no task below the header; give at least one row.")
    axes = ("lat", "lon") if system == "wgs84" else ("x", "y")
    depot = _depot(cells, depots, axes, system) if depots else None
    read = TaskList.of(
        [_name(cells, row, number) for number, row in enumerate(tasks, start=1)],
        [[cells.number(row, axis) for axis in axes] for row in tasks],
        system,
        [cells.number(row, "value", least=0) for row in tasks] if "value" in columns else None,
        _scaled(cells, tasks, "service", 0.0, least=0) if "service" in columns else None,
        [cells.flag(row, "must") for row in tasks],
        depot=depot,
        altitudes=_scaled(cells, tasks, "alt", math.nan) if "alt" in columns else np.full(len(tasks), np.nan),
        meters_per_unit=meters_per_unit,
        places=tuple(f"row {table.rows[row][0]}" for row in tasks),
        source=source,
        notes=() if "id" in columns else (UNNAMED,),
    )
    if system == "plane" and not has_unit:
        check_not_degrees(read)
    return read


def _scaled(cells: Cells, rows: list[int], name: str, empty: float, least: float = -math.inf) -> np.ndarray:
    """:return: ``(n_rows,)``, numbers in the unit that we use"""
    numbers: np.ndarray = np.array([cells.number(row, name, empty, least) for row in rows]) * cells.columns[name].factor
    return numbers


def _name(cells: Cells, row: int, number: int) -> str:
    if "id" not in cells.columns:
        return str(number)
    name = cells.text(row, "id")
    if not name:
        raise ValueError(f"{cells.where(row)}: {cells.columns['id'].title} is missing; fill the cell.")
    return name


def _depot(cells: Cells, rows: list[int], axes: tuple[str, str], system: System) -> list[float]:
    """
    :return: The depot
    :raises ValueError: If it is not where a task might be; the message names its row, which the tasks do not
    """
    point = [cells.number(rows[0], axis) for axis in axes]
    place = f"row {cells.table.rows[rows[0]][0]}"
    check_tasks(TaskList.of(["depot"], [point], system, places=(place,), source=cells.table.source))
    return point


def _is_depot(cells: Cells, row: int) -> bool:
    return cells.flag(row, "depot") or cells.text(row, "type").lower() in _DEPOT_TYPES


def _system(table: Table, columns: dict[str, Column]) -> System:
    """
    :return: Which coordinates the table has
    :raises ValueError: If it has none, half of them, or both kinds
    """
    found = {axis: axis in columns for axis in ("lat", "lon", "x", "y")}
    if (found["lat"] or found["lon"]) and (found["x"] or found["y"]):
        mixed = " and ".join(repr(columns[axis].title) for axis, is_there in found.items() if is_there)
        raise ValueError(f"{table.source}: columns {mixed:.200} mix two systems; keep lat and lon, or x and y.")
    if found["lat"] and found["lon"]:
        return "wgs84"
    if found["x"] and found["y"]:
        return "plane"
    if not columns and any(_is_number(cell) for cell in table.header):
        raise ValueError(
            f"{table.source}: the first row, {table.delimiter.join(table.header)!r:.60}, looks like data; put a row before it "
            f"that names the columns, such as {_EXAMPLE}."
        )
    missing = {"lat": "lon", "lon": "lat", "x": "y", "y": "x"}
    half = next((axis for axis, is_there in found.items() if is_there), None)
    what = f"there is no column {missing[half]} beside {columns[half].title!r:.60}" if half else "no columns give positions"
    names = ", ".join(table.header)
    raise ValueError(f"{table.source}: {what}; found {names!r:.100}; name them {_EXAMPLE}.")


def _is_number(text: str) -> bool:
    try:
        number_of(text)
    except ValueError:
        return False
    return True


def _unit(columns: dict[str, Column], system: System, unit: str | None, source: str) -> tuple[float, bool]:
    """
    :return: Meters per unit of x and y, and whether anything says it
    :raises ValueError: If units contradict each other
    """
    if system == "wgs84":
        if unit is not None:
            raise ValueError(f"{source}: the unit {unit!r:.40} is for x and y, but the file has lat and lon; leave it out.")
        return 1.0, True
    x, y = columns["x"], columns["y"]
    if (x.unit is None) != (y.unit is None) or x.factor != y.factor:
        raise ValueError(f"{source}: columns {x.title!r:.60} and {y.title!r:.60} differ in their unit; give both the same.")
    asked = None if unit is None else length_unit(unit)
    if asked is not None and x.unit is not None and asked != x.factor:
        raise ValueError(f"{source}: the unit {unit!r:.40} contradicts column {x.title!r:.60}; leave it out.")
    return x.factor if asked is None else asked, asked is not None or x.unit is not None

"""Tasks and fleets from files, whatever their format."""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, Literal

import numpy as np

from sb3_uav.missions.checks import MAX_BYTES, check_tasks
from sb3_uav.missions.fleet import Fleet
from sb3_uav.missions.readers.csv_tasks import read_csv_tasks
from sb3_uav.missions.readers.fleet_csv import read_fleet_csv
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.units import length_unit, parse_point

Format = Literal["csv", "geojson", "qgc-plan", "wpl", "chao", "oplib", "npz"]
_NAMES: dict[Format, str] = {
    "csv": "CSV",
    "geojson": "GeoJSON",
    "qgc-plan": "a plan of QGroundControl",
    "wpl": "QGC WPL",
    "chao": "a team orienteering file",
    "oplib": "an OPLib file",
    "npz": "an .npz file",
}
#: Formats that files of a suffix may have.
SUFFIXES: dict[str, tuple[Format, ...]] = {
    ".csv": ("csv",),
    ".tsv": ("csv",),
    ".txt": ("csv", "wpl", "chao", "oplib"),
    ".geojson": ("geojson",),
    ".json": ("geojson", "qgc-plan"),
    ".plan": ("qgc-plan",),
    ".waypoints": ("wpl",),
    ".wpl": ("wpl",),
    ".npz": ("npz",),
    ".oplib": ("oplib",),
}
_ADVICE = {
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "save the sheet as CSV (UTF-8)"),
    ".mission": "open it in QGroundControl and save it as .plan",
    **dict.fromkeys((".kml", ".kmz", ".gpx", ".shp", ".gpkg"), "convert it to GeoJSON or CSV"),
}
_IS_PLAN = re.compile(rb'"fileType"\s*:\s*"Plan"')
_BOM = b"\xef\xbb\xbf"


def read_tasks(
    path: str | os.PathLike[str],
    *,
    unit: str | None = None,
    depot: str | tuple[float, float] | None = None,
    allow_duplicates: bool = False,
    row: int | None = None,
) -> TaskList:
    """
    Read tasks from CSV, GeoJSON, a ``.plan`` of QGroundControl, ``QGC WPL``, a team orienteering file, OPLib or ``.npz``.

    :param path: The file
    :param unit: Unit of x and y, such as ``"km"``; what the file says, otherwise meters
    :param depot: Where the UAVs start and land: ``"LAT,LON"`` or ``"X,Y"``, or two numbers; what the file says when None. It
        replaces the home of a ground station and the depot of an instance, but not a point that is flagged as the depot
    :param allow_duplicates: Whether tasks may be at the same place
    :param row: Which instance of an ``.npz`` with several, from 0
    :return: The tasks, checked
    :raises OSError: If the file cannot be read
    :raises ValueError: If something in it is wrong; the message names the file, the row, the field, what was found and what to
        do
    :raises ImportError: If an optional package is missing that the format needs
    """
    data = _content(path)
    return read_tasks_from_bytes(os.fspath(path), data, unit=unit, depot=depot, allow_duplicates=allow_duplicates, row=row)


def read_tasks_from_bytes(
    name: str,
    data: bytes,
    *,
    unit: str | None = None,
    depot: str | tuple[float, float] | None = None,
    allow_duplicates: bool = False,
    row: int | None = None,
) -> TaskList:
    """
    The same for what was uploaded.

    :param name: Name of the file; its suffix counts
    :param data: Its content
    :param unit: As of :func:`read_tasks`
    :param depot: As of :func:`read_tasks`
    :param allow_duplicates: As of :func:`read_tasks`
    :param row: As of :func:`read_tasks`
    :return: As of :func:`read_tasks`
    :raises ValueError: As :func:`read_tasks`
    :raises ImportError: As :func:`read_tasks`
    """
    source = _printable(name)
    _check_size(len(data), source)
    form = _format_of(source, data)
    if row is not None and form != "npz":
        raise ValueError(f"{source}: row {row} is asked for, but only .npz files have rows of instances; leave it out.")
    tasks = _read(form, data, source, unit, row)
    if depot is not None:
        # Homes in the files of ground stations are where somebody planned, not where somebody flies.
        if form in ("csv", "geojson") and tasks.depot is not None:
            raise ValueError(f"{source}: one of the points is the depot already; leave out the depot beside the file.")
        point = parse_point(depot) if isinstance(depot, str) else depot
        tasks = tasks.with_depot(np.array(point, float))
    check_tasks(tasks, allow_duplicates)
    return replace(tasks, sha256=hashlib.sha256(data).hexdigest())


def read_fleet(path: str | os.PathLike[str]) -> Fleet:
    """
    :param path: A CSV, see :mod:`sb3_uav.missions.readers.fleet_csv`
    :return: The fleet, checked
    :raises OSError: If the file cannot be read
    :raises ValueError: If something in it is wrong; the message names the file, the row, the field and what was found
    """
    return read_fleet_from_bytes(os.fspath(path), _content(path))


def read_fleet_from_bytes(name: str, data: bytes) -> Fleet:
    """
    The same for what was uploaded.

    :param name: Name of the file
    :param data: Its content
    :return: The fleet, checked
    :raises ValueError: As :func:`read_fleet`
    """
    source = _printable(name)
    _check_size(len(data), source)
    if data[:4] == b"PK\x03\x04" or data.removeprefix(_BOM).lstrip()[:1] in (b"{", b"["):
        raise ValueError(f"{source}: this is no CSV; give the fleet as a CSV with the columns id and range_m.")
    return replace(read_fleet_csv(data, source), sha256=hashlib.sha256(data).hexdigest())


def _content(path: str | os.PathLike[str]) -> bytes:
    """
    :return: Content of a file
    :raises OSError: If it cannot be read
    :raises ValueError: If it is too large; no more of it is read
    """
    file_path = Path(path)
    if not file_path.exists():
        raise FileNotFoundError(f"{_printable(str(path))}: there is no such file.")
    if not file_path.is_file():
        raise OSError(f"{_printable(str(path))}: this is no regular file; give one with tasks or UAVs.")
    with file_path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
        _check_size(max(len(data), os.fstat(file.fileno()).st_size), _printable(str(path)))
    return data


def _check_size(n_bytes: int, source: str) -> None:
    if n_bytes > MAX_BYTES:
        raise ValueError(
            f"{source}: the file has {n_bytes / 2**20:.1f} MiB, but at most {MAX_BYTES // 2**20} MiB are read; divide it."
        )


def _printable(name: str) -> str:
    """:return: A name that can be in a message and in a file"""
    return "".join(char if char.isprintable() else "?" for char in name[-200:])


def _format_of(source: str, data: bytes) -> Format:
    """
    :param source: Name of the file
    :param data: Its content
    :return: Its format, by suffix and content
    :raises ValueError: If they contradict each other, or the suffix is not known
    """
    suffix = PurePath(source).suffix.lower()
    if suffix not in SUFFIXES:
        advice = _ADVICE.get(suffix, "rename it if it is one of them")
        raise ValueError(
            f"{source}: files that end in {suffix or 'nothing'!r:.20} are not read, but {' '.join(SUFFIXES)} are; {advice}."
        )
    allowed, found = SUFFIXES[suffix], _content_format(data)
    if found in allowed:
        return found
    if found == "csv":
        # Text of which nothing more can be said; the reader will say what is wrong with it.
        return allowed[0]
    raise ValueError(f"{source}: the name ends in {suffix}, but the content is {_NAMES[found]}; rename it.")


def _content_format(data: bytes) -> Format:
    """:return: What a content looks like; ``"csv"`` for any other text"""
    if data.startswith(b"PK\x03\x04"):
        return "npz"
    text = data.removeprefix(_BOM).lstrip()
    if text[:1] in (b"{", b"["):
        return "qgc-plan" if _IS_PLAN.search(text) else "geojson"
    if text.startswith(b"QGC WPL"):
        return "wpl"
    if re.search(rb"^[ \t]*(?:NODE_COORD|NODE_SCORE|EDGE_WEIGHT)_SECTION", data, re.MULTILINE):
        return "oplib"
    if re.match(rb"n[ \t]+\d+[ \t]*[\r\n]", text):
        return "chao"
    return "csv"


def _read(form: Format, data: bytes, source: str, unit: str | None, row: int | None) -> TaskList:
    """:return: The tasks, not checked"""
    if form == "csv":
        return read_csv_tasks(data, source, unit)
    if form in ("chao", "oplib", "npz"):
        from sb3_uav.missions.readers import instance_files

        meters = 1.0 if unit is None else length_unit(unit)
        if form == "npz":
            return instance_files.read_npz_tasks(data, source, meters, row)
        read: Any = instance_files.read_chao_tasks if form == "chao" else instance_files.read_oplib_tasks
        return read(data, source, meters)
    tasks = _read_map(form, data, source)
    if unit is None:
        return tasks
    if tasks.system != "plane":
        raise ValueError(f"{source}: the unit {unit!r:.40} is for x and y, but the file has lat and lon; leave it out.")
    if tasks.meters_per_unit != length_unit(unit):
        raise ValueError(
            f"{source}: the unit {unit!r:.40} contradicts the file, whose unit is {tasks.meters_per_unit:g} m; leave it out."
        )
    return tasks


def _read_map(form: Format, data: bytes, source: str) -> TaskList:
    """:return: The tasks of a file of maps or ground stations, not checked"""
    if form == "geojson":
        from sb3_uav.missions.readers.geojson import read_geojson

        return read_geojson(data, source)
    if form == "qgc-plan":
        from sb3_uav.missions.readers.qgc_plan import read_qgc_plan

        return read_qgc_plan(data, source)
    from sb3_uav.missions.readers.wpl import read_wpl

    return read_wpl(data, source)

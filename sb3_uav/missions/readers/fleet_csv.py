"""
Fleets in CSV: one row per UAV, under a header.

============================  ============================================================================================
column                        meaning
============================  ============================================================================================
``id``                        name of the UAV; ``uav-1``, ``uav-2``, ... without it
``range_m``                   how far it flies; also ``range_km``, ``range_mi``, ...
``endurance_min``             how long it flies, with ``speed_mps``; also ``endurance_s``, ``endurance_h``
``speed_mps``                 cruise speed; also ``speed_kmh``, ``speed_mph``, ``speed_kn``
``reserve_percent``           part of the range that no plan may use; 0 without it
``start``, ``end``            where it is and where it lands, as ``LAT LON``, ``LAT;LON``, ``X Y`` or ``X;Y``; at the depot
                              where the cell is empty; or in two columns: ``start_lat``, ``start_lon``, or ``start_x``,
                              ``start_y`` in the unit of the tasks
============================  ============================================================================================

A UAV with both a range and an endurance flies no farther than either allows: the smaller counts.
"""

from __future__ import annotations

from collections.abc import Mapping

from sb3_uav.missions.checks import MAX_FLEET, check_fleet, check_fleet_size
from sb3_uav.missions.coordinates import System
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.readers.columns import Cells, Column, Field, match_columns
from sb3_uav.missions.readers.table import read_table
from sb3_uav.missions.units import DURATIONS, LENGTHS, SPEEDS, parse_point

_LATITUDE, _LONGITUDE = ("lat", "latitude"), ("lon", "lng", "long", "longitude")
_AXES = {"lat": _LATITUDE, "lon": _LONGITUDE, "x": ("x", "east", "easting"), "y": ("y", "north", "northing")}
#: What columns may mean.
FIELDS = (
    Field("id", ("id", "uav_id", "uav", "drone", "vehicle", "name"), is_text=True, has_rank=True),
    Field("range", ("range", "max_range", "max_distance"), LENGTHS, needs_unit=True),
    Field("endurance", ("endurance", "flight_time", "max_flight_time"), DURATIONS, needs_unit=True),
    Field("speed", ("speed", "cruise_speed"), SPEEDS, needs_unit=True),
    Field("reserve", ("reserve_percent", "reserve_pct", "reserve_%")),
    *(
        Field(f"{place}_{axis}", tuple(f"{place}_{name}" for name in names), is_degrees=axis in ("lat", "lon"))
        for place in ("start", "end")
        for axis, names in _AXES.items()
    ),
    Field("start", ("start",), is_text=True),
    Field("end", ("end",), is_text=True),
)
_REFUSED = dict.fromkeys(("capacity", "payload", "payload_kg"), "payloads are")
_EXAMPLE = "id,range_m or id,endurance_min,speed_mps"


def read_fleet_csv(data: bytes, source: str) -> Fleet:
    """
    :param data: Content of the file
    :param source: Its name, for errors
    :return: The fleet
    :raises ValueError: If it is no such table, or a UAV is not as
        :func:`~sb3_uav.missions.checks.check_fleet` demands; the message names row, column and what was found
    """
    known = {synonym.split("_")[0] for field in FIELDS for synonym in field.synonyms}
    table = read_table(data, source, sorted(known), MAX_FLEET, _EXAMPLE)
    columns = match_columns(table, FIELDS, _REFUSED, ("note", "notes", "comment", "comments", "description", "model", "type"))
    if "range" not in columns and "endurance" not in columns:
        raise ValueError(
            f"{source}: no column says how far a UAV flies; found {', '.join(table.header)!r:.100}; name them {_EXAMPLE}."
        )
    if "endurance" in columns and "speed" not in columns:
        title = columns["endurance"].title
        raise ValueError(f"{source}: column {title!r:.60} needs a speed too; add a column speed_mps, or give range_m.")
    check_fleet_size(len(table.rows), source)
    systems = {place: _system(columns, place, source) for place in ("start", "end")}
    found: set[System] = {system for system in systems.values() if system is not None}
    if len(found) > 1:
        raise ValueError(f"{source}: starts and ends mix lat, lon and x, y; use one system.")
    cells = Cells(table, columns)
    uavs = tuple(_uav(cells, row, systems) for row in range(len(table.rows)))
    fleet = Fleet(uavs, source, next(iter(found), None))
    check_fleet(fleet, [f"row {line}" for line, _ in table.rows])
    return fleet


def _system(columns: Mapping[str, Column], place: str, source: str) -> System | None:
    """
    :return: Coordinates of the starts or ends; None if there are none, or nothing says which
    :raises ValueError: If only one coordinate is there, or a position is said twice
    """
    given = [axis for axis in _AXES if f"{place}_{axis}" in columns]
    if not given:
        return None
    if given not in (["lat", "lon"], ["x", "y"]) or place in columns:
        titles = ", ".join(column.title for column in columns.values() if column.field.name.split("_")[0] == place)
        raise ValueError(
            f"{source}: columns {titles!r:.100} do not fit together; give {place}_lat and {place}_lon, {place}_x and "
            f"{place}_y, or {place} alone."
        )
    return "wgs84" if given == ["lat", "lon"] else "plane"


def _uav(cells: Cells, row: int, systems: Mapping[str, System | None]) -> Uav:
    speed = _quantity(cells, row, "speed")
    ranges = [_quantity(cells, row, "range")]
    endurance = _quantity(cells, row, "endurance")
    if endurance is not None:
        if speed is None:
            title = cells.columns["speed"].title
            raise ValueError(f"{cells.where(row)}: {title} is missing, which the endurance needs; fill the cell.")
        ranges.append(endurance * speed)
    known = [length for length in ranges if length is not None]
    if not known:
        titles = " and ".join(cells.columns[name].title for name in ("range", "endurance") if name in cells.columns)
        raise ValueError(f"{cells.where(row)}: {titles} is missing; fill the cell.")
    name = cells.text(row, "id") if "id" in cells.columns else f"uav-{row + 1}"
    reserve = cells.number(row, "reserve", 0.0) if "reserve" in cells.columns else 0.0
    start, end = (_position(cells, row, place, systems[place]) for place in ("start", "end"))
    return Uav(name, min(known), speed, start, end, reserve)


def _quantity(cells: Cells, row: int, name: str) -> float | None:
    """:return: A number in the unit that we use; None if nobody said"""
    if not cells.text(row, name):
        return None
    number, column = cells.number(row, name), cells.columns[name]
    if number <= 0:
        raise ValueError(f"{cells.where(row)}: {column.title} is {cells.text(row, name)}; give a number above 0.")
    return number * column.factor


def _position(cells: Cells, row: int, place: str, system: System | None) -> tuple[float, float] | None:
    """:return: Start or end of a UAV; None for the depot"""
    if system is None:
        text = cells.text(row, place)
        try:
            return parse_point(text) if text else None
        except ValueError as error:
            raise ValueError(f"{cells.where(row)}: {cells.columns[place].title}: {error}") from None
    names = [f"{place}_{axis}" for axis in (("lat", "lon") if system == "wgs84" else ("x", "y"))]
    if not any(cells.text(row, name) for name in names):
        return None
    first, second = (cells.number(row, name) for name in names)
    if system == "wgs84":
        for name, number, most in zip(names, (first, second), (90, 180), strict=True):
            if abs(number) > most:
                title = cells.columns[name].title
                raise ValueError(f"{cells.where(row)}: {title} is {number:.12g}; give degrees within {most}; swapped?")
    return first, second

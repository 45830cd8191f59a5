"""
Tasks in ``.plan`` files of QGroundControl.

Format: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html. What the items mean for tasks:
:mod:`sb3_uav.missions.readers.waypoints`.
"""

from __future__ import annotations

from typing import Any

from sb3_uav.missions.readers.json_file import number_of, parse_json, shown, whole_of
from sb3_uav.missions.readers.waypoints import ReadItem, tasks_of_items
from sb3_uav.missions.tasks import TaskList

_VERSIONS = (1, 2)
_N_PARAMS = 7
_LANDING_PATTERNS = ("fwLandingPattern", "vtolLandingPattern")
_COMPLEX = {"survey": "a survey", "CorridorScan": "a corridor scan", "StructureScan": "a structure scan"}
_LANDING_NOTE = "The file has a landing pattern, which the missions will not have; add an approach that fits the site."


def read_qgc_plan(data: bytes, source: str) -> TaskList:
    """
    Read the waypoints of a plan as tasks, called ``wp-3`` after the numbers that QGroundControl shows, and the planned home as
    the depot (none if it is missing, null or (0, 0)).

    Surveys, corridor and structure scans, geofences and rally points are refused, because no plan made here would honor them.
    Landing patterns are no tasks, like other landings. Keys that are not known are not looked at.

    :param data: The file
    :param source: Its name, for errors
    :return: The tasks in the order of the file, coordinates not checked for their range
    :raises ValueError: If something is wrong, missing or cannot be honored; the message names the item, counted from 1
    """
    content = parse_json(data, source)
    if content.get("fileType") != "Plan":
        raise ValueError(f'{source}: fileType is {shown(content.get("fileType"))}; plans of QGroundControl have "Plan".')
    _check_version(content, "version", source)
    _check_fence(content.get("geoFence"), source)
    rally = content.get("rallyPoints")
    if isinstance(rally, dict) and rally.get("points"):
        raise ValueError(
            f"{source}: rallyPoints has {_count(rally['points'])}; delete them here, and load them in the ground station."
        )
    mission = content.get("mission")
    if not isinstance(mission, dict):
        raise ValueError(f"{source}: mission is {shown(mission)}; write an object with items.")
    _check_version(mission, "version of mission", source)
    items = mission.get("items")
    if not isinstance(items, list):
        raise ValueError(f"{source}: items of mission is {shown(items)}; write a list.")
    read: list[ReadItem] = []
    notes: tuple[str, ...] = ()
    for number, item in enumerate(items, 1):
        where = f"{source}: item {number}"
        if _is_landing_pattern(item, where):
            notes = (_LANDING_NOTE,)
        else:
            read.append(_read_item(item, f"item {number}", where))
    return tasks_of_items(read, _home_of(mission.get("plannedHomePosition"), source), source, notes)


def _check_version(holder: dict[str, Any], what: str, source: str) -> None:
    version = holder.get("version")
    if isinstance(version, bool) or version not in _VERSIONS:
        raise ValueError(f"{source}: {what} is {shown(version)}; save the plan with QGroundControl 3.2 or newer.")


def _check_fence(fence: Any, source: str) -> None:
    if not isinstance(fence, dict):
        if fence is not None:
            raise ValueError(f"{source}: geoFence is {shown(fence)}; write an object, or leave it out.")
        return
    # "polygon" and "breachReturn" are of version 1.
    found = [
        f"{_count(fence[name])} in {name}" for name in ("circles", "polygons", "polygon", "breachReturn") if fence.get(name)
    ]
    if found:
        raise ValueError(
            f"{source}: geoFence has {', '.join(found)}, but plans do not keep clear of fences; delete the geofence here, and "
            "check the routes against it by hand."
        )


def _count(value: Any) -> str:
    return str(len(value)) if isinstance(value, list) else shown(value)


def _is_landing_pattern(item: Any, where: str) -> bool:
    if not isinstance(item, dict):
        raise ValueError(f"{where} is {shown(item)}; write an object.")
    kind = item.get("type")
    if kind == "SimpleItem":
        return False
    if kind != "ComplexItem":
        raise ValueError(f'{where}: type is {shown(kind)}; write "SimpleItem".')
    name = item.get("complexItemType")
    if isinstance(name, str) and name in _LANDING_PATTERNS:
        return True
    what = _COMPLEX.get(name) if isinstance(name, str) else None
    raise ValueError(
        f"{where} is {what or f'a complex item ({shown(name)})'}, of which no tasks can be made; write a waypoint for every "
        "place, or give the places as CSV or GeoJSON."
    )


def _read_item(item: dict[str, Any], place: str, where: str) -> ReadItem:
    params = item.get("params")
    if not isinstance(params, list) or len(params) != _N_PARAMS:
        raise ValueError(f"{where}: params is {shown(params)}; write a list of {_N_PARAMS} numbers.")
    jump_id = item.get("doJumpId")
    return ReadItem(
        place,
        None if jump_id is None else whole_of(jump_id, "doJumpId", where),
        whole_of(item.get("command"), "command", where),
        whole_of(item.get("frame"), "frame", where),
        tuple(None if value is None else number_of(value, f"param {number}", where) for number, value in enumerate(params, 1)),
    )


def _home_of(home: Any, source: str) -> tuple[float | None, float | None]:
    if home is None:
        return None, None
    if not isinstance(home, list) or len(home) not in (2, 3):
        raise ValueError(f"{source}: plannedHomePosition is {shown(home)}; write [latitude, longitude, altitude].")
    if any(value is None for value in home[:2]):
        return None, None
    return number_of(home[0], "latitude of home", source), number_of(home[1], "longitude of home", source)

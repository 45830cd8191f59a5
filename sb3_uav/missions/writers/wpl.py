"""
Missions as ``QGC WPL 110``, the plain text of waypoints that QGroundControl, Mission Planner and MAVProxy read.

Format: https://mavlink.io/en/file_formats/. (Its example has latitude and longitude swapped; its description has not.)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_uav.common.files import write_atomically
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.mission_items import (
    WAYPOINT,
    Item,
    check_is_geographic,
    home_of,
    mission_items,
    task_items,
)
from sb3_uav.missions.writers.names import file_stems

HEADER = "QGC WPL 110"


def write_wpl_files(plan: Plan, folder: Path, flight: FlightOptions) -> list[Path]:
    """
    Write one ``.waypoints`` per UAV that flies, named after it; home has altitude 0, as in ``.plan``.

    :param plan: A plan in latitudes and longitudes
    :param folder: Where to write; created if missing
    :param flight: How it is flown
    :return: The files, in the order of the fleet
    :raises ValueError: If the plan is in a plane
    :raises OSError: If a file cannot be written
    """
    check_is_geographic(plan.tasks, "missions of autopilots")
    paths = []
    for uav, (route, stem) in enumerate(zip(plan.routes, file_stems(plan), strict=True)):
        if route.flies:
            path = folder / f"{stem}.waypoints"
            write_atomically(path, wpl_of_items(home_of(plan, uav), mission_items(plan, uav, flight), flight))
            paths.append(path)
    return paths


def write_tasks_wpl(tasks: TaskList, path: Path, flight: FlightOptions | None = None) -> None:
    """
    Write tasks as waypoints in the order of the list, with the depot as home. The format keeps points, service (as hold) and
    altitudes, but no ids, values or ``must``; altitude 0 stands for one that does not matter.

    :param tasks: Tasks with a depot
    :param path: The file to write
    :param flight: Firmware that the file is for
    :raises ValueError: As of :func:`~sb3_uav.missions.writers.mission_items.task_items`
    :raises OSError: If the file cannot be written
    """
    write_atomically(path, wpl_of_items(*task_items(tasks), flight or FlightOptions()))


def wpl_of_items(home: tuple[float, float], items: Sequence[Item], flight: FlightOptions) -> str:
    """
    :param home: Latitude and longitude
    :param items: The mission
    :param flight: Firmware; a parameter that is left to the autopilot is NaN for PX4, where 0 would turn the UAV north, and 0
        for ArduPilot, whose ground stations do not all read NaN
    :return: The text; row 0 is home in frame 0
    """
    default = "nan" if flight.firmware == "px4" else "0"
    rows = [["0", "1", "0", str(WAYPOINT), "0", "0", "0", "0", *map(_number, home), "0", "1"]]
    for index, item in enumerate(items, 1):
        params = [default if value is None else _number(value) for value in item.params]
        position = map(_number, item.position or (0.0, 0.0, 0.0))
        rows.append([str(index), "0", str(item.frame), str(item.command), *params, *position, "1"])
    return "\n".join([HEADER, *("\t".join(row) for row in rows)]) + "\n"


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))

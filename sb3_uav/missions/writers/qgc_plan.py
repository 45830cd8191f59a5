"""
Missions as ``.plan`` files of QGroundControl.

Format: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_uav.common.files import write_atomically
from sb3_uav.missions.flight import Firmware, FlightOptions, Vehicle
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.mission_items import Item, check_is_geographic, home_of, mission_items, task_items
from sb3_uav.missions.writers.names import file_stems

#: MAV_AUTOPILOT and MAV_TYPE of https://mavlink.io/en/messages/common.html
FIRMWARE_TYPES: dict[Firmware, int] = {"px4": 12, "ardupilot": 3}
VEHICLE_TYPES: dict[Vehicle, int] = {"multirotor": 2, "fixed-wing": 1}
# What QGroundControl proposes where nothing is said, in meters per second.
_CRUISE_SPEED, _HOVER_SPEED = 15.0, 5.0
_RELATIVE_ALTITUDES = 1


def write_plan_files(plan: Plan, folder: Path, flight: FlightOptions) -> list[Path]:
    """
    Write one ``.plan`` per UAV that flies, named after it. The altitude of home is written as 0, because nobody said how high
    it lies above the sea; all others are relative to it.

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
        if not route.flies:
            continue
        path = folder / f"{stem}.plan"
        content = plan_of_items(home_of(plan, uav), mission_items(plan, uav, flight), flight, route.uav.speed_mps)
        write_atomically(path, json.dumps(content, indent=4, allow_nan=False) + "\n")
        paths.append(path)
    return paths


def write_tasks_plan(tasks: TaskList, path: Path, flight: FlightOptions | None = None) -> None:
    """
    Write tasks as waypoints in the order of the list, with the depot as planned home. The format keeps points, service (as
    hold) and altitudes, but no ids, values or ``must``; altitude 0 stands for one that does not matter.

    :param tasks: Tasks with a depot
    :param path: The file to write
    :param flight: Firmware and vehicle type to name in the file
    :raises ValueError: As of :func:`~sb3_uav.missions.writers.mission_items.task_items`
    :raises OSError: If the file cannot be written
    """
    home, items = task_items(tasks)
    content = plan_of_items(home, items, flight or FlightOptions(), None)
    write_atomically(path, json.dumps(content, indent=4, allow_nan=False) + "\n")


def plan_of_items(
    home: tuple[float, float], items: Sequence[Item], flight: FlightOptions, speed: float | None
) -> dict[str, Any]:
    """
    :param home: Latitude and longitude
    :param items: The mission
    :param flight: Firmware and vehicle type
    :param speed: Meters per second, if known
    :return: The plan as plain data
    """
    is_fixed_wing = flight.vehicle == "fixed-wing"
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": speed if is_fixed_wing and speed is not None else _CRUISE_SPEED,
            "firmwareType": FIRMWARE_TYPES[flight.firmware],
            "globalPlanAltitudeMode": _RELATIVE_ALTITUDES,
            "hoverSpeed": _HOVER_SPEED if is_fixed_wing or speed is None else speed,
            "items": [_simple_item(item, number) for number, item in enumerate(items, 1)],
            "plannedHomePosition": [*home, 0],
            "vehicleType": VEHICLE_TYPES[flight.vehicle],
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }


def _simple_item(item: Item, number: int) -> dict[str, Any]:
    altitude = (
        {}
        if item.position is None
        else {"AMSLAltAboveTerrain": None, "Altitude": item.position[2], "AltitudeMode": _RELATIVE_ALTITUDES}
    )
    return {
        **altitude,
        "autoContinue": True,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": [*item.params, *(item.position or (0, 0, 0))],
        "type": "SimpleItem",
    }

"""
What an autopilot is told, the same for every file format of missions.

Commands and frames are those of MAVLink: https://mavlink.io/en/messages/common.html#mav_commands and #MAV_FRAME.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.tasks import TaskList

WAYPOINT, LOITER_TIME, RETURN_TO_LAUNCH, LAND, TAKEOFF, CHANGE_SPEED = 16, 19, 20, 21, 22, 178
#: Altitude above home, and no position at all
RELATIVE, NO_POSITION = 3, 2
# Degrees by which two places may differ and be the same for an autopilot, which counts in steps of 1e-7.
_SAME = 1e-7
# Degrees by which a fixed wing noses up at takeoff, as ground stations propose it.
_PITCH = 15.0


@dataclass(frozen=True)
class Item:
    """
    One item of a mission.

    :param command: MAV_CMD
    :param params: Its first four parameters; None leaves one to the autopilot (NaN in MAVLink)
    :param position: Latitude and longitude in degrees, meters above home; None if the command has none
    """

    command: int
    params: tuple[float | None, float | None, float | None, float | None]
    position: tuple[float, float, float] | None = None

    @property
    def frame(self) -> int:
        """MAV_FRAME."""
        return NO_POSITION if self.position is None else RELATIVE


def check_is_geographic(tasks: TaskList, what: str) -> None:
    """
    :param tasks: The tasks
    :param what: What cannot be written otherwise, for the message
    :raises ValueError: If they are in a plane
    """
    if tasks.system != "wgs84":
        raise ValueError(f"{tasks.source}: the tasks are in a plane of x and y, but {what} need latitudes and longitudes.")


def home_of(plan: Plan, uav: int) -> tuple[float, float]:
    """
    :param plan: A plan in latitudes and longitudes
    :param uav: Number of the UAV from 0
    :return: Latitude and longitude of where it was launched, as far as anybody can tell: the base of its own if its route
        starts and ends at one place, the depot otherwise (it may start in the air, after replanning)
    """
    points = plan.routes[uav].points
    base = points[0] if plan.tasks.depot is None or _is_same(points[0], points[-1]) else plan.tasks.depot
    return float(base[0]), float(base[1])


def altitudes_of(plan: Plan, uav: int, flight: FlightOptions) -> list[float]:
    """
    :param plan: A plan
    :param uav: Number of the UAV from 0
    :param flight: How it is flown
    :return: Meters above the depot at every stop; what a task says, or else the altitude of the UAV
    """
    own = flight.altitude_of(plan.fleet.level_of(uav))
    wanted = (float(plan.tasks.altitudes[task]) for task in plan.routes[uav].stops)
    return [own if np.isnan(altitude) else altitude for altitude in wanted]


def mission_items(plan: Plan, uav: int, flight: FlightOptions) -> list[Item]:
    """
    The mission of one UAV: takeoff, speed, stops, landing.

    Takeoff is always there. A UAV that starts elsewhere than at the depot may stand on the ground there, and would then never
    leave it. If it is in the air already, PX4 takes the item for a waypoint and ArduPilot climbs to its altitude (see
    https://docs.px4.io/main/en/flight_modes_mc/mission.html).

    It returns to launch only if it was launched where it has to land; from any other start "launch" may be another place than
    the end of the route, so that it is sent to land at the end by position. Fixed wings ignore the hold of a waypoint; they
    circle for that time instead. The heading of their takeoff and the approach of their landing depend on the site: a person
    has to add them.

    :param plan: A plan in latitudes and longitudes
    :param uav: Number of the UAV from 0
    :param flight: How it is flown
    :return: The items without home
    """
    route, is_fixed_wing = plan.routes[uav], flight.vehicle == "fixed-wing"
    speed = route.uav.speed_mps
    (start, *_), end = route.points.tolist(), route.points[-1].tolist()
    items = [
        Item(
            TAKEOFF,
            (_PITCH if is_fixed_wing else 0.0, 0.0, 0.0, None),
            (start[0], start[1], flight.altitude_of(plan.fleet.level_of(uav))),
        )
    ]
    if speed is not None:
        # The first parameter is 0 for airspeed, which is what fixed wings control, and 1 for speed over ground.
        items.append(Item(CHANGE_SPEED, (0.0 if is_fixed_wing else 1.0, float(speed), -1.0, 0.0)))
    for task, altitude in zip(route.stops, altitudes_of(plan, uav, flight), strict=True):
        latitude, longitude = plan.tasks.points[task].tolist()
        hold = float(plan.tasks.service_s[task])
        if is_fixed_wing and hold > 0:
            items.append(Item(LOITER_TIME, (hold, 0.0, 0.0, 0.0), (latitude, longitude, altitude)))
        else:
            items.append(Item(WAYPOINT, (hold, 0.0, 0.0, None), (latitude, longitude, altitude)))
    home = home_of(plan, uav)
    if flight.landing == "rtl" and _is_same(start, home) and _is_same(end, home):
        items.append(Item(RETURN_TO_LAUNCH, (0.0, 0.0, 0.0, 0.0)))
    else:
        items.append(Item(LAND, (0.0, 0.0, 0.0, None), (end[0], end[1], 0.0)))
    return items


def task_items(tasks: TaskList) -> tuple[tuple[float, float], list[Item]]:
    """
    Tasks as waypoints: hold for service, altitude 0 where it does not matter.

    :param tasks: Tasks with a depot
    :return: Home and the items
    :raises ValueError: If they are in a plane, have no depot, or a place is (0, 0), which stands for "no position"
    """
    check_is_geographic(tasks, "waypoints")
    if tasks.depot is None:
        raise ValueError(f"{tasks.source}: there is no depot to be the planned home; give one.")
    for name, point in (("the depot", tasks.depot), *zip(tasks.ids, tasks.points, strict=True)):
        if not point.any():
            raise ValueError(f"{tasks.source}: {name} is at (0, 0), which stands for no position in files of waypoints.")
    items = [
        Item(WAYPOINT, (float(service), 0.0, 0.0, None), (latitude, longitude, 0.0 if np.isnan(altitude) else float(altitude)))
        for (latitude, longitude), service, altitude in zip(
            tasks.points.tolist(), tasks.service_s, tasks.altitudes, strict=True
        )
    ]
    return (float(tasks.depot[0]), float(tasks.depot[1])), items


def _is_same(one: object, other: object) -> bool:
    return bool(np.allclose(np.asarray(one, float), np.asarray(other, float), rtol=0.0, atol=_SAME))

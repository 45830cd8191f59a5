"""
What the items of a mission say about tasks, the same for every file format of missions.

Commands and frames are those of MAVLink: https://mavlink.io/en/messages/common.html#mav_commands and #MAV_FRAME.

==================================================== ==================================================================
Item                                                 Meaning
==================================================== ==================================================================
waypoint (16), spline waypoint (82)                  a task; its hold is the service
loiter for a time (19)                               a task; the time is the service
loiter to altitude (31)                              a task
delay (93)                                           more service of the task before it
takeoff, return to launch, land (20 to 24, 84, 85)   no tasks; missions are written with their own
anything after the start of the landing (189)        no tasks
loiter for ever or for turns (17, 18)                refused: how long it takes is not known
payload drop (94, 30001), other navigation           refused: no mission that is written here can do it
jump (177)                                           refused: tasks are served once
fence (5000 to 5004) and rally points (5100)         refused: plans do not keep clear of fences
all other commands: speed, camera, servo, ...        no tasks; a note says that missions are written without them
==================================================== ==================================================================

An item at (0, 0) or without a position stands for "here" and is no task. Altitudes above home are kept, but for 0, which
stands for "any"; a note says so of altitudes above the sea or the terrain, which are not.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sb3_uav.missions.tasks import TaskList

_WAYPOINT, _LOITER_TIME, _LOITER_TO_ALT, _SPLINE, _DELAY, _LANDING = 16, 19, 31, 82, 93, 189
_TASKS = frozenset({_WAYPOINT, _LOITER_TIME, _LOITER_TO_ALT, _SPLINE})
_WITH_HOLD = _TASKS - {_LOITER_TO_ALT}
_TAKEOFF_AND_LANDING = frozenset({20, 21, 22, 23, 24, 84, 85})
_LAST_NAVIGATION = 95
_HOW_LONG = "write a loiter for a time (19) or a waypoint with a hold (16)"
_FENCE = "plans do not keep clear of fences: delete it, and check the routes against it by hand"
_REFUSED = {
    17: ("loiters for ever (MAV_CMD_NAV_LOITER_UNLIM)", _HOW_LONG),
    18: ("loiters for a number of turns (MAV_CMD_NAV_LOITER_TURNS)", _HOW_LONG),
    94: (
        "places a payload (MAV_CMD_NAV_PAYLOAD_PLACE)",
        "write a waypoint (16), and add the drop to the mission that comes out",
    ),
    177: ("jumps to another item (MAV_CMD_DO_JUMP)", "delete it: every task is served once"),
    30001: ("drops a payload (MAV_CMD_PAYLOAD_PREPARE_DEPLOY)", "write a waypoint (16), and add the drop to the mission"),
    **{number: ("is a part of a geofence (MAV_CMD_NAV_FENCE)", _FENCE) for number in range(5000, 5005)},
    5100: ("is a rally point (MAV_CMD_NAV_RALLY_POINT)", "delete it, and load rally points in the ground station"),
}
# Frames whose positions are degrees: global, mission, relative and terrain, each also with "INT".
_DEGREES = frozenset({0, 2, 3, 5, 6, 10, 11})
_ABOVE_HOME = frozenset({3, 6})
_MOST_IN_NOTE = 20


@dataclass(frozen=True)
class ReadItem:
    """
    One item of a mission file.

    :param place: Where it stands in the file, such as ``"item 3"``
    :param number: What ground stations call it; None if the file does not say
    :param command: MAV_CMD
    :param frame: MAV_FRAME
    :param params: Its seven parameters, finite; None where the file leaves one to the autopilot
    """

    place: str
    number: int | None
    command: int
    frame: int
    params: tuple[float | None, ...]


@dataclass
class _Found:
    """What has been found so far."""

    items: list[ReadItem] = field(default_factory=list)
    service: list[float] = field(default_factory=list)
    altitudes: list[float] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)


def tasks_of_items(
    items: Iterable[ReadItem], home: Sequence[float | None], source: str, notes: Sequence[str] = ()
) -> TaskList:
    """
    :param items: The items, without home
    :param home: Latitude and longitude; None or 0 where it is not known
    :param source: Name of the file, for errors
    :param notes: What else the file says and tasks do not
    :return: The tasks, called ``wp-3`` after the numbers that ground stations show, or after their places in the file if
        those are missing or not unique. Values are 1
    :raises ValueError: If an item is not known how to honor, has a wrong hold or position, or there are no tasks
    """
    found = _Found()
    in_landing, is_after_task = False, False
    for item in items:
        where = f"{source}: {item.place}"
        if item.command == _DELAY:
            seconds = _seconds(item, where)
            if is_after_task:
                found.service[-1] += seconds
        elif item.command in _REFUSED:
            what, advice = _REFUSED[item.command]
            raise ValueError(f"{where} {what}; {advice}.")
        elif item.command in _TASKS:
            is_after_task = not in_landing and _add_task(found, item, where)
            if in_landing:
                found.left_out["a waypoint of the landing"] += 1
        elif item.command in _TAKEOFF_AND_LANDING:
            is_after_task = False
        elif item.command <= _LAST_NAVIGATION:
            raise ValueError(
                f"{where} has the command {item.command}, which flies in a way that is not known here; write a waypoint (16)."
            )
        elif item.command == _LANDING:
            in_landing = True
        else:
            found.left_out[f"MAV_CMD {item.command}"] += 1
    if not found.items:
        raise ValueError(f"{source}: no item is a task; write a waypoint (16) for every task.")
    numbers = [item.number for item in found.items]
    is_numbered = None not in numbers and len(set(numbers)) == len(numbers)
    places = tuple(item.place for item in found.items)
    depot = None if home[0] is None or home[1] is None or not any(home[:2]) else np.array(home[:2], float)
    return TaskList.of(
        [f"wp-{number}" for number in numbers] if is_numbered else [f"wp-{place.split()[-1]}" for place in places],
        [item.params[4:6] for item in found.items],
        "wgs84",
        service_s=found.service,
        depot=depot,
        altitudes=np.array(found.altitudes, float),
        places=places,
        source=source,
        notes=(*notes, *_notes(found)),
    )


def _add_task(found: _Found, item: ReadItem, where: str) -> bool:
    """:return: Whether the item has a position and is a task"""
    latitude, longitude, altitude = item.params[4:7]
    if (latitude is None) != (longitude is None):
        raise ValueError(f"{where}: one of latitude and longitude is missing; write both.")
    if not (latitude or longitude):
        found.left_out["a waypoint without a position"] += 1
        return False
    if item.frame not in _DEGREES:
        raise ValueError(
            f"{where} has the frame {item.frame}, whose positions are not latitudes and longitudes; write frame 3."
        )
    hold = item.params[0] if item.command in _WITH_HOLD else None
    if hold is not None and hold < 0:
        raise ValueError(f"{where}: the hold is {hold:g} s; write 0 or more.")
    is_above_home = item.frame in _ABOVE_HOME
    if not is_above_home and altitude:
        found.left_out["an altitude that is not relative to home"] += 1
    found.items.append(item)
    found.service.append(hold or 0.0)
    found.altitudes.append(altitude if is_above_home and altitude else math.nan)
    return True


def _seconds(item: ReadItem, where: str) -> float:
    seconds = item.params[0]
    if seconds is None or seconds < 0:
        raise ValueError(f"{where} waits until a time of day (MAV_CMD_NAV_DELAY); write how many seconds it waits.")
    return seconds


def _notes(found: _Found) -> tuple[str, ...]:
    if not found.left_out:
        return ()
    counts = ", ".join(f"{what} ({count})" for what, count in sorted(found.left_out.items())[:_MOST_IN_NOTE])
    return (f"The file has what the missions will not have: {counts}.",)

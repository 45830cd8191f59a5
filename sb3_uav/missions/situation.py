"""Where a mission stands: a plan and what has happened since, as the tasks, the UAVs and the rest of every route."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.remarks import named
from sb3_uav.missions.status import Status, UavReport
from sb3_uav.missions.status_checks import check_status, full_range, remaining_range
from sb3_uav.missions.tasks import TaskList

# A straight flight to the end is granted so much beyond its length, for rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Situation:
    """
    :param tasks: Tasks of the plan that are neither done nor dropped, then the new ones
    :param fleet: UAVs that are not lost, each where it is, with the range that it has
    :param routes: What is left of the route of every UAV, whether its range admits that or not
    :param added: Names of new tasks
    :param gone: Names of tasks of the plan that are done or dropped
    :param lost: Names of UAVs of the plan that are lost
    :param is_news: Whether anything is not as planned
    :param remarks: What had to be assumed, and what a person should know
    """

    tasks: TaskList
    fleet: Fleet
    routes: tuple[tuple[int, ...], ...]
    added: tuple[str, ...]
    gone: tuple[str, ...]
    lost: tuple[str, ...]
    is_news: bool
    remarks: tuple[str, ...]


def situation_of(plan: Plan, status: Status) -> Situation:
    """
    :param plan: A plan
    :param status: What has happened since
    :return: Where the mission stands
    :raises ValueError: If the status does not fit the plan, or all UAVs are lost; the message names the row
    """
    check_status(plan, status)
    tasks, added = _open_tasks(plan, status)
    number = {name: task for task, name in enumerate(tasks.ids)}
    reports = {report.id: report for report in status.uavs}
    left = [route for route in plan.routes if route.uav.id not in status.lost]
    if not left:
        raise ValueError(f"{status.source}: all {len(plan.fleet)} UAVs are lost; nobody is left to fly.")
    uavs, remarks, silent = [], [], []
    for route in left:
        report = reports.get(route.uav.id)
        uav, words = (route.uav, []) if report is None else _now(plan, route, report)
        uavs.append(uav)
        remarks += words
        if report is None:
            silent.append(uav.id)
            behind = [name for name in _names(plan, route) if name in status.done]
            if behind:
                remarks.append(
                    f"UAV {uav.id} has not reported, though of its route are done: {named(behind)}. If it is in the air, "
                    f"give a row uav with its place and the range that it has."
                )
    if silent:
        remarks.append(
            f"Not in the status, and so taken to be where their routes begin, with the range planned there: {named(silent)}."
        )
    gone = tuple(name for name in plan.tasks.ids if name not in number)
    lost = tuple(uav.id for uav in plan.fleet if uav.id in status.lost)
    return Situation(
        tasks,
        replace(plan.fleet, uavs=_at_their_levels(plan, uavs)),
        tuple(tuple(number[name] for name in _names(plan, route) if name in number) for route in left),
        added,
        gone,
        lost,
        bool(added or gone or lost) or any(uav is not route.uav for uav, route in zip(uavs, left, strict=True)),
        tuple(remarks),
    )


def _at_their_levels(plan: Plan, uavs: Sequence[Uav]) -> tuple[Uav, ...]:
    """:return: The UAVs that are left, each at the altitude that it had: those in the air must not meet on a new one"""
    if len(uavs) == len(plan.fleet):
        return tuple(uavs)
    levels = {uav.id: plan.fleet.level_of(place) for place, uav in enumerate(plan.fleet)}
    return tuple(replace(uav, level=levels[uav.id]) for uav in uavs)


def _names(plan: Plan, route: Route) -> list[str]:
    return [plan.tasks.ids[task] for task in route.stops]


def _open_tasks(plan: Plan, status: Status) -> tuple[TaskList, tuple[str, ...]]:
    """:return: The tasks that are left, and the names of those among them that are new"""
    old, gone = plan.tasks, {*status.done, *status.dropped}
    new = [task for task in status.tasks if task.id not in gone and task.id not in set(old.ids)]
    kept = [task for task, name in enumerate(old.ids) if name not in gone]
    if not kept and not new:
        raise ValueError(f"{status.source}: no task is left, so there is nothing to plan; the UAVs fly to their ends.")
    tasks = replace(
        old,
        ids=(*(old.ids[task] for task in kept), *(task.id for task in new)),
        points=np.concatenate([old.points[kept], np.array([task.point for task in new], float).reshape(-1, 2)]),
        values=np.concatenate([old.values[kept], [task.value for task in new]]),
        service_s=np.concatenate([old.service_s[kept], [task.service_s for task in new]]),
        must=np.concatenate([old.must[kept], np.array([task.must for task in new], bool)]),
        altitudes=np.concatenate([old.altitudes[kept], [task.altitude_m for task in new]]),
        places=(*(old.places[task] for task in kept), *(status.place("task", task.id) for task in new)),
    )
    return tasks, tuple(task.id for task in new)


def _now(plan: Plan, route: Route, report: UavReport) -> tuple[Uav, list[str]]:
    """
    :param plan: The plan
    :param route: The planned route of a UAV
    :param report: What the UAV reports
    :return: The UAV where it is and with the range that it has, the same object if that is as planned; and remarks
    """
    uav, position, remarks = route.uav, report.position, []
    remaining = remaining_range(uav, report)
    remaining = uav.range_m if remaining is None else remaining
    if remaining > full_range(uav):
        remarks.append(
            f"UAV {uav.id} reports {remaining:.0f} m, more than its whole range; {full_range(uav):.0f} m are assumed."
        )
        remaining = full_range(uav)
    has_moved = position is not None and position != tuple(route.points[0])
    if not has_moved and remaining == uav.range_m:
        return uav, remarks
    # The reserve stays the same in meters.
    reserve = uav.range_m * uav.reserve_percent / 100.0
    uav = replace(
        uav,
        start=position if has_moved else uav.start,
        range_m=remaining,
        reserve_percent=min(100.0 * reserve / remaining, 100.0) if remaining > 0 else uav.reserve_percent,
        full_range_m=full_range(uav),
    )
    return _homeward(plan.tasks, uav, route.points[-1], remarks) if has_moved else (uav, remarks)


def _homeward(tasks: TaskList, uav: Uav, end: Sequence[float], remarks: list[str]) -> tuple[Uav, list[str]]:
    """
    :param tasks: The tasks, for their coordinates
    :param uav: A UAV in the air
    :param end: Where it has to land
    :param remarks: Remarks on it
    :return: The UAV, with so much less reserve that it comes home if only the reserve takes it there; and the remarks
    """
    start, home = tasks.coordinates().to_plane(np.array([uav.start, end], float))
    direct = math.hypot(*(home - start))
    if direct <= uav.usable_m:
        return uav, remarks
    if direct > uav.range_m:
        lacking = f"it lacks {direct - uav.range_m:.0f} m of range, so that its route is empty. Act at once."
        return uav, [*remarks, f"UAV {uav.id} cannot reach the place where it has to land: {lacking}"]
    spent = f"it needs {direct - uav.usable_m:.0f} m of its reserve for that"
    percent = max(100.0 * (1.0 - direct * (1.0 + _ROUNDING) / uav.range_m), 0.0)
    return replace(uav, reserve_percent=percent), [*remarks, f"UAV {uav.id} flies straight to its end; {spent}."]

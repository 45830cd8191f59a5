"""Whether a status fits its plan."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Iterable

import numpy as np

from sb3_uav.missions.checks import check_tasks
from sb3_uav.missions.fleet import Uav
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.status import NewTask, Status, UavReport
from sb3_uav.missions.tasks import TaskList

# Nobody is so many times farther from the depot than UAVs fly, and so many meters.
_FAR_RANGES, _FAR_M = 20.0, 100_000.0
# More than so many times the whole range is a slip, such as a wrong unit; less may be a tailwind.
_MAX_RANGES = 2.0


def full_range(uav: Uav) -> float:
    """:return: How far the UAV flies with a full battery, in meters"""
    return uav.range_m if uav.full_range_m is None else uav.full_range_m


def remaining_range(uav: Uav, report: UavReport) -> float | None:
    """
    :param uav: A UAV of the plan
    :param report: What it reports
    :return: How far it still flies, in meters; None if it does not say
    """
    if report.remaining is None:
        return None
    if report.unit == "percent":
        return report.remaining / 100.0 * full_range(uav)
    return report.remaining if report.unit == "m" else report.remaining * 60.0 * (uav.speed_mps or 0.0)


def check_status(plan: Plan, status: Status) -> None:
    """
    :param plan: A plan
    :param status: What has happened since
    :raises ValueError: If the status names what the plan does not have, or something in it cannot be; the message names the
        row
    """
    _Checks(plan, status).run()


class _Checks:
    """As of :func:`check_status`."""

    def __init__(self, plan: Plan, status: Status) -> None:
        self._plan = plan
        self._status = status
        self._uavs = {uav.id: uav for uav in plan.fleet}
        self._tasks = {name: task for task, name in enumerate(plan.tasks.ids)}
        self._coordinates = plan.tasks.coordinates()
        self._reach = max(_FAR_RANGES * max(map(full_range, plan.fleet)), _FAR_M)

    def run(self) -> None:
        """:raises ValueError: If something is wrong"""
        plan, status = self._plan, self._status
        points = [report.position for report in status.uavs] + [task.point for task in status.tasks]
        if status.system not in (None, plan.tasks.system) and any(point is not None for point in points):
            columns = {"wgs84": "lat and lon", "plane": "x and y"}
            raise ValueError(
                f"{status.source}: coordinates are {columns[status.system or 'plane']}, but those of the plan are "
                f"{columns[plan.tasks.system]}; give the same."
            )
        new = [task.id for task in status.tasks]
        tasks = {*self._tasks, *plan.past_tasks, *new}
        self._names("uav", "UAV", [report.id for report in status.uavs], self._uavs)
        self._names("lost", "UAV", status.lost, {*self._uavs, *plan.past_uavs})
        self._names("done", "task", status.done, tasks)
        self._names("drop", "task", status.dropped, tasks)
        self._names("task", "task", new, tasks)
        for report in status.uavs:
            self._report(report)
        for task in status.tasks:
            self._new_task(task)
        if status.tasks:
            check_tasks(self._new_tasks(), allow_duplicates=True)

    def _new_tasks(self) -> TaskList:
        """:return: The new tasks as a list of their own, to be checked as those of any other file"""
        old, status, new = self._plan.tasks, self._status, self._status.tasks
        return TaskList.of(
            [task.id for task in new],
            [task.point for task in new],
            old.system,
            [task.value for task in new],
            [task.service_s for task in new],
            [task.must for task in new],
            altitudes=np.array([task.altitude_m for task in new], float),
            meters_per_unit=old.meters_per_unit,
            places=tuple(status.places.get(("task", task.id), f"task {task.id}") for task in new),
            source=status.source,
        )

    def _names(self, kind: str, what: str, names: Iterable[str], known: Collection[str]) -> None:
        seen: set[str] = set()
        for name in names:
            place = self._status.place(kind, name)
            if name in seen:
                raise ValueError(f"{place}: {what} {name[:40]} is named twice; leave one of the two.")
            seen.add(name)
            if name in known:
                continue
            if name in self._plan.past_uavs and what == "UAV":
                raise ValueError(f"{place}: UAV {name[:40]} was lost before and is not in this plan; remove the row.")
            spelled = {other.lower(): other for other in known}
            near = difflib.get_close_matches(name.lower(), spelled, 1, 0.6)
            some = sorted(known)[:5]
            guess = (
                f"did you mean {spelled[near[0]]}?"
                if near
                else f"there are {', '.join(some)}{', ...' if len(known) > 5 else ''}."
            )
            raise ValueError(f"{place}: the plan has no {what} {name[:40]}; {guess}")

    def _report(self, report: UavReport) -> None:
        place, uav = self._status.place("uav", report.id), self._uavs[report.id]
        if report.id in self._status.lost:
            raise ValueError(f"{place}: UAV {report.id} is lost and yet reports; leave one of the two.")
        if report.position is not None:
            self._point(place, report.position)
            if report.remaining is None:
                raise ValueError(f"{place}: this says where UAV {report.id} is, but not how far it still flies.")
        if report.remaining is None:
            return
        if not 0 <= report.remaining < math.inf:
            raise ValueError(f"{place}: UAV {report.id} still flies {report.remaining:g}; give a finite number, 0 or more.")
        if report.unit == "min" and uav.speed_mps is None:
            raise ValueError(
                f"{place}: the plan does not say how fast UAV {uav.id} flies; give remaining_m or remaining_percent."
            )
        meters, whole = remaining_range(uav, report), full_range(uav)
        if meters is not None and meters > _MAX_RANGES * whole:
            raise ValueError(
                f"{place}: UAV {uav.id} still flies {meters:.0f} m, but its whole range is {whole:.0f} m; check the unit."
            )

    def _new_task(self, task: NewTask) -> None:
        plan, status, place = self._plan, self._status, self._status.place("task", task.id)
        self._point(place, task.point)
        if task.id in self._tasks:
            tasks, old = plan.tasks, self._tasks[task.id]
            was = (*tasks.points[old], tasks.values[old], tasks.service_s[old], tasks.must[old])
            # A status file that grows during a mission names tasks again that an earlier replan has put into the plan.
            if was != (*task.point, task.value, task.service_s, task.must):
                raise ValueError(f"{place}: the plan has another task {task.id} already; give the new one another name.")
        elif task.id in plan.past_tasks and task.id not in (*status.done, *status.dropped):
            raise ValueError(f"{place}: there was a task {task.id}, done or dropped; give the new one another name.")
        slow = [uav.id for uav in plan.fleet if uav.speed_mps is None and uav.id not in status.lost]
        if task.service_s > 0 and slow:
            raise ValueError(
                f"{place}: service_s is {task.service_s:g}, but the plan does not say how fast UAV {slow[0]} flies; "
                f"leave it empty."
            )

    def _point(self, place: str, point: tuple[float, float]) -> None:
        """:raises ValueError: If this is not in the area of the plan"""
        if not all(math.isfinite(x) for x in point):
            raise ValueError(f"{place}: coordinates are {point[0]:g}, {point[1]:g}; give finite numbers.")
        if not self._is_on_earth(point):
            raise ValueError(f"{place}: lat is {point[0]:g} and lon {point[1]:g}, which is out of range.")
        far, swapped = self._distance(point), (point[1], point[0])
        if far > self._reach:
            is_swapped = self._is_on_earth(swapped) and self._distance(swapped) <= self._reach
            names = " and ".join(self._coordinates.names)
            advice = f"{names} look swapped" if is_swapped else f"check {names}"
            raise ValueError(f"{place}: {point[0]:g}, {point[1]:g} is {far / 1000:.0f} km from the depot; {advice}.")

    def _is_on_earth(self, point: tuple[float, float]) -> bool:
        return self._plan.tasks.system == "plane" or (abs(point[0]) <= 90 and abs(point[1]) <= 180)

    def _distance(self, point: tuple[float, float]) -> float:
        """:return: Meters from the depot"""
        return float(self._coordinates.leg_lengths(np.array([self._plan.tasks.depot, point], float))[0])

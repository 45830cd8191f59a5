"""Schedules, and the independent checker that every solver's schedules must pass."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sb3_uav.envs.distances import DISTANCE_TOLERANCE
from sb3_uav.envs.instances import Instances


class InfeasibleScheduleError(ValueError):
    """A schedule violates a constraint of its instance."""


@dataclass(frozen=True, init=False)
class Schedule:
    """
    One route per UAV. Start and end of the UAV, usually the depot, are not listed.

    :param routes: Task indices from 0, in flying order
    """

    routes: tuple[tuple[int, ...], ...]

    def __init__(self, routes: Iterable[Iterable[int]]) -> None:
        object.__setattr__(self, "routes", tuple(tuple(int(task) for task in route) for route in routes))

    @property
    def n_visited(self) -> int:
        return sum(len(route) for route in self.routes)


@dataclass(frozen=True)
class ScheduleReport:
    """
    Result of checking a feasible schedule.

    :param objective: Total value of the visited tasks
    :param lengths: Length of every given route with its service costs, in the unit of the coordinates. A UAV without tasks
        flies straight from its start to its end, or stays where it is if it cannot
    :param unserved: Tasks that must be served and are not. Of two schedules the one with fewer of them is better, whatever
        their objectives
    """

    objective: float
    lengths: tuple[float, ...]
    unserved: tuple[int, ...] = ()

    @property
    def length(self) -> float:
        return math.fsum(self.lengths)


def check_schedule(instances: Instances, row: int, schedule: Schedule) -> ScheduleReport:
    """
    Check a schedule against its instance (paper, equations (1) to (6)), in plain Python floats.

    It shares no code with the dynamics, so that an error there is found here.

    :param instances: The instances
    :param row: Index of the instance
    :param schedule: The schedule; UAVs without a route stay at the depot
    :return: Objective and the lengths of the given routes
    :raises InfeasibleScheduleError: If a constraint is violated; the message says which, where and by how much
    :raises IndexError: If there is no such row
    """
    if not -len(instances) <= row < len(instances):
        raise IndexError(f"instance {row} of a batch of {len(instances)}")
    depot = [float(x) for x in instances.depot[row].tolist()]
    tasks = instances.tasks[row].tolist()
    values = instances.values[row].tolist()
    n_tasks = sum(instances.task_mask[row].tolist())
    given_service = None if instances.service is None else instances.service[row].tolist()
    must_serve = [] if instances.must_serve is None else instances.must_serve[row].tolist()
    if len(schedule.routes) > instances.n_uavs:
        raise InfeasibleScheduleError(f"{len(schedule.routes)} routes for a fleet of {instances.n_uavs} UAVs.")
    seen: dict[int, int] = {}
    lengths = []
    for uav, route in enumerate(schedule.routes):
        for task in route:
            if not 0 <= task < n_tasks:
                raise InfeasibleScheduleError(f"UAV {uav} visits task {task}, but tasks are numbered 0 to {n_tasks - 1}.")
            if task in seen:
                raise InfeasibleScheduleError(f"Task {task} is visited twice, by UAV {seen[task]} and UAV {uav}.")
            seen[task] = uav
        start = depot if instances.start is None else instances.start[row, uav].tolist()
        end = depot if instances.end is None else instances.end[row, uav].tolist()
        own = instances.max_distance[row] if instances.max_distance.dim() == 1 else instances.max_distance[row, uav]
        max_distance = float(own)
        stops = [start, *(tasks[task] for task in route), end]
        length = 0.0
        for a, b in itertools.pairwise(stops):
            length += math.hypot(a[0] - b[0], a[1] - b[1])
        if given_service is not None:
            length += math.fsum(given_service[task] for task in route)
        if not route and length > max_distance:
            length = 0.0
        if not length <= max_distance + DISTANCE_TOLERANCE * max_distance:
            raise InfeasibleScheduleError(
                f"UAV {uav} flies {length:.9f}, which is {length - max_distance:.3g} over its maximum of {max_distance:.9f}."
            )
        lengths.append(length)
    unserved = tuple(task for task in range(n_tasks) if must_serve and must_serve[task] and task not in seen)
    return ScheduleReport(math.fsum(values[task] for task in seen), tuple(lengths), unserved)


def schedule_to_json(solver: str, row: int, schedule: Schedule, report: ScheduleReport) -> dict[str, Any]:
    """
    :param solver: Name of the solver
    :param row: Index of the instance
    :param schedule: The schedule
    :param report: The result of :func:`check_schedule`
    :return: The fields of one line of a ``schedules.jsonl``; ``unserved`` only if a task that must be served is not
    """
    record = {
        "solver": solver,
        "instance": row,
        "routes": [list(route) for route in schedule.routes],
        "objective": report.objective,
        "lengths": list(report.lengths),
    }
    return {**record, "unserved": list(report.unserved)} if report.unserved else record


def _schedule_from_json(record: Any, source: str) -> tuple[str, int, Schedule]:
    """
    :param record: One parsed line of a ``schedules.jsonl``
    :param source: File and line, named in errors
    :return: Solver, index of the instance, schedule
    :raises ValueError: If a field is missing or of the wrong type
    """
    if not isinstance(record, dict) or not {"solver", "instance", "routes"} <= set(record):
        raise ValueError(f"{source}: a schedule needs the fields 'solver', 'instance' and 'routes', found {record!r:.80}.")
    routes = record["routes"]
    whole = isinstance(routes, list) and all(
        isinstance(route, list) and all(type(task) is int for task in route) for route in routes
    )
    if not whole or type(record["instance"]) is not int:
        raise ValueError(f"{source}: 'routes' must be lists of task indices and 'instance' an index, found {routes!r:.80}.")
    return str(record["solver"]), record["instance"], Schedule(routes)

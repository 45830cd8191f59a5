"""From tasks and a fleet to a checked plan."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule, check_schedule
from sb3_uav.missions.checks import check_fits, check_fleet, check_tasks
from sb3_uav.missions.fleet import Fleet
from sb3_uav.missions.leftovers import skipped_tasks
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.problem import make_instance, service_speed
from sb3_uav.missions.remarks import remarks_on
from sb3_uav.missions.tasks import TaskList

DEFAULT_SECONDS = 10.0
# Lengths measured twice, in the plane and on the ellipsoid, differ by rounding.
_TOLERANCE = 1e-9


def default_spec(instance: Instances, seconds: float) -> str:
    """
    :param instance: The instance to solve
    :param seconds: Time limit
    :return: The trained pair that fits the instance, with repair and polish, as of
        :func:`~sb3_uav.solvers.registry.make_solver`
    """
    is_known_to_all = instance.is_plain and bool((instance.values == instance.values[:, :1]).all())
    pair = "universal" if is_known_to_all else "world"
    return f"dl-drl:allocator={pair},decode=augment,repair=1,polish={seconds:g},time_limit={seconds:g}"


def solve(
    tasks: TaskList,
    fleet: Fleet | None = None,
    solver: str | None = None,
    time_limit: float = DEFAULT_SECONDS,
    seed: int = 0,
    on_plan: Callable[[Plan], None] | None = None,
    on_start: Callable[[], None] | None = None,
) -> Plan:
    """
    Plan the mission.

    :param tasks: The tasks, with a depot
    :param fleet: The UAVs; those of the file of the tasks when None
    :param solver: As of :func:`~sb3_uav.solvers.registry.make_solver`; the trained pair with repair and polish when None
    :param time_limit: Seconds
    :param seed: Seed of the solver
    :param on_plan: Called with every better plan as soon as it is known, possibly in another thread
    :param on_start: Called when the solver is loaded and its time begins
    :return: The best plan, accepted by the checker, with lengths measured anew in the coordinates of the user
    :raises ValueError: If the input is wrong; the message names the file and the row
    :raises InfeasibleScheduleError: If the solver is at fault
    """
    from sb3_uav.solvers import make_solver

    fleet = tasks.fleet if fleet is None else fleet
    if fleet is None:
        raise ValueError(f"{tasks.source}: nothing says which UAVs there are; give a fleet.")
    if not 0 < time_limit < math.inf:
        raise ValueError(f"time_limit is {time_limit:g}; give a number of seconds above 0.")
    # Neither need come from a file whose reader has seen to it. UAVs may be in the air.
    check_tasks(tasks, allow_duplicates=True)
    check_fleet(fleet, is_flying=True)
    check_fits(tasks, fleet)
    instance = make_instance(tasks, fleet)
    chosen = make_solver(solver or default_spec(instance, time_limit), device="cpu")
    chosen.check(instance)
    chosen.prepare()
    if on_start is not None:
        on_start()
    start = time.perf_counter()

    def plan_of(schedule: Schedule) -> Plan:
        plan = make_plan(tasks, fleet, schedule, chosen.name, seed, time.perf_counter() - start, instance=instance)
        return replace(plan, time_limit=time_limit)

    if on_plan is not None:
        best: list[tuple[int, float, float]] = []

        def report(_: int, schedule: Schedule) -> None:
            found = check_schedule(instance, 0, schedule)
            rank = (-len(found.unserved), found.objective, -found.length)
            if not best or rank > max(best):
                best.append(rank)
                on_plan(plan_of(schedule))

        chosen.on_incumbent = report
    result = chosen.solve(instance, time_limit, seed)[0]
    return replace(plan_of(result.schedule), bound=result.bound)


def make_plan(
    tasks: TaskList,
    fleet: Fleet,
    schedule: Schedule,
    solver: str,
    seed: int = 0,
    seconds: float = 0.0,
    instance: Instances | None = None,
) -> Plan:
    """
    Check a schedule and say what it means in the user's terms.

    :param tasks: The tasks
    :param fleet: The UAVs
    :param schedule: Who serves what
    :param solver: Name of the solver
    :param seed: Seed of the solver
    :param seconds: Wall time of the solver
    :param instance: The instance in meters, if it is known already
    :return: The plan
    :raises InfeasibleScheduleError: If the schedule breaks a constraint, in the plane or measured along geodesics
    """
    instance = make_instance(tasks, fleet) if instance is None else instance
    report = check_schedule(instance, 0, schedule)
    routes = measured_routes(tasks, fleet, [*schedule.routes, *[()] * (len(fleet) - len(schedule.routes))])
    for route in routes:
        if not route.used_m <= route.uav.usable_m * (1.0 + _TOLERANCE):
            raise InfeasibleScheduleError(
                f"UAV {route.uav.id} flies {route.used_m:.3f} m of the {route.uav.usable_m:.3f} m that it may."
            )
    plan = Plan(
        tasks,
        fleet,
        routes,
        skipped_tasks(instance, schedule),
        report.objective,
        report.unserved,
        solver,
        seed,
        seconds,
    )
    return replace(plan, remarks=remarks_on(plan))


def measured_routes(tasks: TaskList, fleet: Fleet, routes: Sequence[Sequence[int]]) -> tuple[Route, ...]:
    """
    :param tasks: The tasks
    :param fleet: ``V`` UAVs
    :param routes: Stops of every UAV
    :return: The routes with their lengths, which no solver has touched
    """
    coordinates, speed = tasks.coordinates(), service_speed(tasks, fleet)
    measured = []
    for uav, stops in zip(fleet, routes, strict=True):
        ends = [tasks.depot if point is None else np.array(point) for point in (uav.start, uav.end)]
        points = np.array([ends[0], *tasks.points[list(stops)], ends[1]], float)
        legs = coordinates.leg_lengths(points)
        if not stops and legs.sum() > uav.usable_m:
            legs = np.zeros(1)
        seconds = math.fsum(tasks.service_s[list(stops)])
        measured.append(Route(uav, tuple(stops), points, legs, seconds * speed, seconds))
    return tuple(measured)

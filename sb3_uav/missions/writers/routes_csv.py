"""Routes as a table, a row per stop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.problem import service_speed


def write_routes_csv(plan: Plan, path: Path) -> None:
    """
    A row per stop of every UAV that flies, and one for its end, whose ``task`` is empty: ``uav``, ``stop`` from 1, ``task``,
    the coordinates under their names (``lat``, ``lon`` or ``x``, ``y``), ``leg_m`` flown to get there, ``used_m`` of the range
    after serving it, ``value``, ``service_s``, ``arrival_s`` after the start, empty if nobody said how fast the UAV flies.

    :param plan: The plan
    :param path: The file to write
    :raises ValueError: If it cannot be written
    """
    names = plan.tasks.coordinates().names
    columns = ("uav", "stop", "task", *names, "leg_m", "used_m", "value", "service_s", "arrival_s")
    rows = (row for route in plan.routes if route.flies for row in _rows(plan, route))
    with replaced_when_complete(path) as file:
        write_csv(file, columns, rows)


def _rows(plan: Plan, route: Route) -> Iterator[tuple[Any, ...]]:
    tasks, speed, charge = plan.tasks, route.uav.speed_mps, service_speed(plan.tasks, plan.fleet)
    flown = served = 0.0
    for number, (leg, point) in enumerate(zip(route.legs_m, route.points[1:], strict=True), start=1):
        task = route.stops[number - 1] if number <= len(route.stops) else None
        flown += float(leg)
        arrival = None if speed is None else f"{flown / speed + served:.1f}"
        seconds = 0.0 if task is None else float(tasks.service_s[task])
        served += seconds
        yield (
            route.uav.id,
            number,
            "" if task is None else tasks.ids[task],
            *(float(x) for x in point),
            f"{leg:.2f}",
            f"{flown + served * charge:.2f}",
            None if task is None else f"{tasks.values[task]:.12g}",
            None if task is None else f"{seconds:g}",
            arrival,
        )

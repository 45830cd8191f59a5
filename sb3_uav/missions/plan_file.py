"""Plans in files, complete enough to draw, fly and replan them without the files that they were made from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from sb3_uav.common.files import write_atomically
from sb3_uav.common.json_text import read_json_file
from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule
from sb3_uav.missions.checks import check_fleet, check_tasks
from sb3_uav.missions.coordinates import System
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList

PLAN_FILE = "mission.json"
_VERSION = 1


def tasks_to_json(tasks: TaskList) -> dict[str, Any]:
    """
    :param tasks: Tasks, with or without a depot
    :return: Plain data, without their fleet
    """
    return {
        "system": tasks.system,
        "meters_per_unit": tasks.meters_per_unit,
        "depot": None if tasks.depot is None else tasks.depot.tolist(),
        "source": tasks.source,
        "tasks": [
            {
                "id": tasks.ids[task],
                "point": tasks.points[task].tolist(),
                "value": float(tasks.values[task]),
                "service_s": float(tasks.service_s[task]),
                "must": bool(tasks.must[task]),
                "altitude_m": None if np.isnan(tasks.altitudes[task]) else float(tasks.altitudes[task]),
            }
            for task in range(len(tasks))
        ],
    }


def plan_to_json(plan: Plan) -> dict[str, Any]:
    """
    :param plan: A plan
    :return: Plain data
    """
    return {
        "format": "sb3-uav mission",
        "version": _VERSION,
        **tasks_to_json(plan.tasks),
        "fleet": [
            {
                "id": uav.id,
                "range_m": uav.range_m,
                "speed_mps": uav.speed_mps,
                "start": None if uav.start is None else list(uav.start),
                "end": None if uav.end is None else list(uav.end),
                "reserve_percent": uav.reserve_percent,
                "full_range_m": uav.full_range_m,
                "level": uav.level,
            }
            for uav in plan.fleet
        ],
        "routes": [[plan.tasks.ids[task] for task in route.stops] for route in plan.routes],
        "solver": plan.solver,
        "seed": plan.seed,
        "seconds": plan.seconds,
        "bound": plan.bound,
        "past": {"tasks": list(plan.past_tasks), "uavs": list(plan.past_uavs)},
    }


def plan_from_json(data: Any, source: str) -> Plan:
    """
    :param data: What :func:`plan_to_json` returned, possibly changed by somebody else
    :param source: Name of the file, for errors
    :return: The plan, checked anew
    :raises ValueError: If something is missing, wrong or infeasible
    """
    if not isinstance(data, dict) or data.get("format") != "sb3-uav mission":
        raise ValueError(f'{source}: this is not a plan of sb3-uav solve, which has "format": "sb3-uav mission".')
    if data.get("version") != _VERSION:
        raise ValueError(f"{source}: version is {data.get('version')!r:.40}, but this release reads {_VERSION}; plan anew.")
    if data.get("system") not in get_args(System):
        raise ValueError(f"{source}: system is {data.get('system')!r:.40}; it is one of {', '.join(get_args(System))}.")
    try:
        tasks = TaskList.of(
            [task["id"] for task in data["tasks"]],
            [task["point"] for task in data["tasks"]],
            data["system"],
            [task["value"] for task in data["tasks"]],
            [task["service_s"] for task in data["tasks"]],
            [_flag(task["must"]) for task in data["tasks"]],
            depot=data["depot"],
            altitudes=np.array(
                [np.nan if task["altitude_m"] is None else task["altitude_m"] for task in data["tasks"]], float
            ),
            meters_per_unit=float(data["meters_per_unit"]),
            source=str(data["source"]),
        )
        uavs = [
            Uav(
                str(uav["id"]),
                float(uav["range_m"]),
                None if uav["speed_mps"] is None else float(uav["speed_mps"]),
                _point(uav["start"]),
                _point(uav["end"]),
                float(uav["reserve_percent"]),
                None if uav.get("full_range_m") is None else float(uav["full_range_m"]),
                None if uav.get("level") is None else int(uav["level"]),
            )
            for uav in data["fleet"]
        ]
        number = {name: task for task, name in enumerate(tasks.ids)}
        schedule = Schedule([[number[str(name)] for name in route] for route in data["routes"]])
        past = data.get("past") or {}
        past_tasks, past_uavs = (tuple(str(name) for name in past.get(kind) or ()) for kind in ("tasks", "uavs"))
        bound = None if data.get("bound") is None else float(data["bound"])
        solver, seed, seconds = str(data["solver"]), int(data["seed"]), float(data["seconds"])
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        found = f"{type(error).__name__} {error}"
        raise ValueError(f"{source}: {found:.300}; a part of the plan is missing or wrong.") from error
    if tasks.depot is None:
        raise ValueError(f"{source}: the plan has no depot; plan anew.")
    if tasks.system == "wgs84" and not (np.abs(tasks.depot) <= (90.0, 180.0)).all():
        raise ValueError(f"{source}: depot is {tasks.depot.tolist()}; give latitude and longitude in degrees.")
    for what, names in (("tasks", tasks.ids), ("UAVs", tuple(uav.id for uav in uavs))):
        if len(set(names)) < len(names):
            raise ValueError(f"{source}: two {what} have the same name; give each its own.")
    fleet = Fleet(tuple(uavs), source)
    check_tasks(replace(tasks, source=source), allow_duplicates=True)
    # Of a mission that was planned again: its UAVs may be in the air.
    check_fleet(fleet, is_flying=True)
    try:
        plan = make_plan(tasks, fleet, schedule, solver, seed, seconds)
    except InfeasibleScheduleError as error:
        raise InfeasibleScheduleError(f"{source}: {error}") from error
    except ValueError as error:
        # It names the file of the tasks, if it names one.
        raise ValueError(f"{source}: {error}") from error
    if bound is not None and not plan.objective <= bound < np.inf:
        raise ValueError(f"{source}: bound is {bound:g}, but it is finite and at least {plan.objective:g}, the objective.")
    return replace(plan, bound=bound, past_tasks=past_tasks, past_uavs=past_uavs)


def _point(given: Any) -> tuple[float, float] | None:
    return None if given is None else (float(given[0]), float(given[1]))


def _flag(given: Any) -> bool:
    if not isinstance(given, bool):
        raise TypeError(f"{given!r:.40} is neither true nor false")
    return given


def save_plan(plan: Plan, path: Path) -> None:
    """
    :param plan: A plan
    :param path: The file to write
    :raises OSError: If it cannot be written
    """
    write_atomically(path, json.dumps(plan_to_json(plan), indent=1) + "\n")


def load_plan(path: Path) -> Plan:
    """
    :param path: The file
    :return: The plan, checked anew
    :raises OSError: If it cannot be read
    :raises ValueError: If it is not an intact plan
    """
    try:
        data = read_json_file(path)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: this is not JSON ({error}).") from error
    return plan_from_json(data, str(path))

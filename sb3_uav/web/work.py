"""What worker processes do: read a file, solve a problem, write the files of a mission."""

from __future__ import annotations

import io
import json
import tempfile
import time
import zipfile
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.tasks import TaskList
from sb3_uav.web.workers import Message, Send

# Better plans follow each other within milliseconds at the beginning; a person sees a few a second.
_PAUSE = 0.2
# What sentences for the command line call the fields of the page and of the API.
_WORDS = {
    "give --depot LAT,LON": "give one",
    "give --depot": "give one",
    "give --allow-duplicates": "allow several tasks at one place (allow_duplicates)",
    "give --speed, or speed_mps in the file of the fleet": "give speed_mps",
    "--reserve PERCENT": "reserve_percent",
}


def in_own_words(sentence: str) -> str:
    """
    :param sentence: A sentence that may name options of ``sb3-uav solve``
    :return: The same for people who use the page or the API
    """
    for option, word in _WORDS.items():
        sentence = sentence.replace(option, word)
    return sentence


@cache
def warm() -> None:
    """Import the solvers, compile the local search and load the networks, by solving two tiny missions."""
    import torch as th

    # One worker is one core. Also, a process that has used more threads cannot be forked safely.
    th.set_num_threads(1)
    from sb3_uav.missions.search import solve

    points = np.random.default_rng(0).uniform(0.0, 1000.0, (12, 2))
    for values in (np.ones(12), np.arange(1.0, 13.0)):
        tasks = TaskList.of(range(12), points, "plane", values, depot=(500.0, 500.0))
        solve(tasks, Fleet.of_equal(2, 1500.0), time_limit=0.05)


def do(request: dict[str, Any], blocks: list[bytes], send: Send) -> Message:
    """
    :param request: ``{"kind": "read" | "solve" | "write", ...}``
    :param blocks: What goes with it
    :param send: Called with early results
    :return: The last result
    :raises ValueError: If the input is wrong
    """
    try:
        return {"read": _read, "solve": _solve, "write": _write}[request["kind"]](request, blocks, send)
    except ValueError as error:
        raise ValueError(in_own_words(str(error))) from error


def _read(request: dict[str, Any], blocks: list[bytes], send: Send) -> Message:
    """A file of tasks, or of a fleet, into plain data."""
    name, most = request["name"], request["max_tasks"]
    kind = "fleet" if request["what"] == "fleet" else "tasks"
    if kind == "fleet":
        from sb3_uav.missions.read import read_fleet_from_bytes

        fleet = read_fleet_from_bytes(name, blocks[0])
        if len(fleet) > request["max_uavs"]:
            raise ValueError(f"{name}: there are {len(fleet)} UAVs; this server admits {request['max_uavs']}.")
        return {"event": "done"}, [_packed({"system": fleet.system, "uavs": [_uav_to_json(uav) for uav in fleet]})]
    tasks = _read_tasks(name, blocks[0], request)
    if len(tasks) > most:
        raise ValueError(f"{name}: there are {len(tasks)} tasks; this server admits {most}. Split the file, or ask for more.")
    return {"event": "done"}, [_packed(_tasks_to_json(tasks))]


def _read_tasks(name: str, data: bytes, request: dict[str, Any]) -> TaskList:
    from sb3_uav.missions.read import read_tasks_from_bytes

    if name.lower().endswith(".json"):
        found = _tasks_of_mission(name, data)
        if found is not None:
            return found
    return read_tasks_from_bytes(name, data, unit=request["unit"], allow_duplicates=request["allow_duplicates"])


def _tasks_of_mission(name: str, data: bytes) -> TaskList | None:
    """Tasks and fleet of a mission that this program has written; None if it is something else."""
    from sb3_uav.web.schemas import TaskIn, TasksIn, UavIn, one_sentence

    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        # The other readers say it better.
        return None
    if not isinstance(document, dict) or document.get("format") != "sb3-uav mission":
        return None
    try:
        # Only what is known here: plans that were changed in flight have more.
        entries = [_known(task, TaskIn) for task in document.get("tasks") or ()]
        tasks = TasksIn.model_validate({**_known(document, TasksIn), "tasks": entries})
        uavs = [UavIn.model_validate(_known(uav, UavIn)).model_dump() for uav in document.get("fleet") or ()]
    except (ValidationError, TypeError) as error:
        text = one_sentence(error) if isinstance(error, ValidationError) else str(error)
        raise ValueError(f"{name}: this is no intact mission: {text}") from None
    found, fleet = problem_of({"tasks": tasks.model_dump(), "uavs": uavs})
    return replace(found, fleet=fleet if uavs else None)


def _known(data: Any, model: type[BaseModel]) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise TypeError(f"{str(data)[:50]!r} is no object.")
    return {key: data[key] for key in model.model_fields if key in data}


def _tasks_to_json(tasks: TaskList) -> dict[str, Any]:
    from sb3_uav.missions.plan_file import tasks_to_json

    uavs = None if tasks.fleet is None else [_uav_to_json(uav) for uav in tasks.fleet]
    return {**tasks_to_json(tasks), "notes": list(tasks.notes), "uavs": uavs}


def _uav_to_json(uav: Uav) -> dict[str, Any]:
    return {
        "id": uav.id,
        "range_m": uav.range_m,
        "speed_mps": uav.speed_mps,
        "start": None if uav.start is None else list(uav.start),
        "end": None if uav.end is None else list(uav.end),
        "reserve_percent": uav.reserve_percent,
    }


def problem_of(problem: dict[str, Any]) -> tuple[TaskList, Fleet]:
    """
    :param problem: As of :class:`~sb3_uav.web.schemas.Problem`
    :return: Tasks and fleet; tasks that are forbidden are left out
    """
    given = [task for task in problem["tasks"]["tasks"] if not task["forbidden"]]
    places = [f"task {number}" for number, task in enumerate(problem["tasks"]["tasks"], 1) if not task["forbidden"]]
    tasks = TaskList.of(
        [task["id"] for task in given],
        [task["point"] for task in given],
        problem["tasks"]["system"],
        [task["value"] for task in given],
        [task["service_s"] for task in given],
        [task["must"] for task in given],
        depot=problem["tasks"]["depot"],
        altitudes=np.array([np.nan if task["altitude_m"] is None else task["altitude_m"] for task in given], float),
        meters_per_unit=problem["tasks"]["meters_per_unit"],
        places=tuple(places),
        source=problem["tasks"]["source"],
    )
    uavs = (
        Uav(
            uav["id"],
            uav["range_m"],
            uav["speed_mps"],
            None if uav["start"] is None else (uav["start"][0], uav["start"][1]),
            None if uav["end"] is None else (uav["end"][0], uav["end"][1]),
            uav["reserve_percent"],
        )
        for uav in problem["uavs"]
    )
    return tasks, Fleet(tuple(uavs))


def _solve(request: dict[str, Any], blocks: list[bytes], send: Send) -> Message:
    from sb3_uav.missions.checks import check_tasks
    from sb3_uav.missions.search import solve
    from sb3_uav.web.plan_view import plan_parts

    problem = json.loads(blocks[0])
    tasks, fleet = problem_of(problem)
    check_tasks(tasks, problem["allow_duplicates"])
    forbidden = [task["id"] for task in problem["tasks"]["tasks"] if task["forbidden"]]
    last = [-_PAUSE]

    def on_plan(plan: Any) -> None:
        if time.monotonic() - last[0] >= _PAUSE:
            send({"event": "plan", "objective": plan.objective}, plan_parts(plan, forbidden))
            last[0] = time.monotonic()

    plan = solve(tasks, fleet, problem["solver"], problem["time_limit"], problem["seed"], on_plan)
    return {"event": "done", "objective": plan.objective}, plan_parts(plan, forbidden)


def _write(request: dict[str, Any], blocks: list[bytes], send: Send) -> Message:
    from sb3_uav.missions.plan_file import PLAN_FILE, plan_from_json
    from sb3_uav.missions.write import write_mission

    mission = json.loads(zlib.decompress(blocks[0]))
    plan = plan_from_json(mission, PLAN_FILE)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "mission"
        write_mission(plan, out, FlightOptions(**request["flight"]))
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(out.rglob("*")):
                if path.is_file():
                    archive.write(path, path.relative_to(folder).as_posix())
    return {"event": "done"}, [data.getvalue()]


def _packed(data: Any) -> bytes:
    return json.dumps(data, allow_nan=False).encode()

"""
From a list of tasks to missions that fly: files of operators in, checked plans and mission files out.

.. code-block:: python

    from sb3_uav.missions import Fleet, read_tasks, solve, write_mission

    tasks = read_tasks("tasks.csv")
    plan = solve(tasks, Fleet.of_equal(4, range_m=12_000, speed_mps=12), time_limit=10)
    write_mission(plan, "mission")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_uav.missions.fleet import Fleet, Uav
    from sb3_uav.missions.flight import FlightOptions
    from sb3_uav.missions.plan import Plan
    from sb3_uav.missions.plan_file import load_plan, save_plan
    from sb3_uav.missions.read import read_fleet, read_tasks
    from sb3_uav.missions.search import solve
    from sb3_uav.missions.tasks import TaskList
    from sb3_uav.missions.write import write_mission

__all__ = [
    "Fleet",
    "FlightOptions",
    "Plan",
    "TaskList",
    "Uav",
    "load_plan",
    "read_fleet",
    "read_tasks",
    "save_plan",
    "solve",
    "write_mission",
]

# Looked up when somebody asks for them, so that reading a file loads no networks.
_HOMES = {
    "Fleet": "fleet",
    "Uav": "fleet",
    "FlightOptions": "flight",
    "Plan": "plan",
    "TaskList": "tasks",
    "load_plan": "plan_file",
    "save_plan": "plan_file",
    "read_fleet": "read",
    "read_tasks": "read",
    "solve": "search",
    "write_mission": "write",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)

"""A plan in figures: objective, lengths, reasons, and where it comes from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.common.files import write_atomically
from sb3_uav.evaluation.provenance import describe_machine
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan, Route

SUMMARY_FILE = "summary.json"
FORMAT = "sb3-uav mission summary"


def summary_of(plan: Plan, flight: FlightOptions, files: Mapping[str, str] | None = None) -> dict[str, Any]:
    """
    :param plan: The plan, checked
    :param flight: How it is flown
    :param files: SHA-256 of every other file of the mission, by its name
    :return: Plain data. ``bound`` and ``gap`` are None until there is a proven bound
    """
    tasks = plan.tasks
    source = {"tasks": {"file": tasks.source, "sha256": tasks.sha256 or None}}
    return {
        "format": FORMAT,
        "objective": plan.objective,
        "possible": float(tasks.values.sum()),
        "bound": plan.bound,
        "gap": plan.gap,
        "n_tasks": len(tasks),
        "n_served": plan.n_served,
        "length_m": _meters(plan.length_m),
        "uavs": [_uav(route, flight.altitude_of(plan.fleet.level_of(number))) for number, route in enumerate(plan.routes)],
        "skipped": [
            {
                "task": tasks.ids[skipped.task],
                "reason": skipped.reason,
                "missing_m": None if skipped.missing_m is None else _meters(skipped.missing_m),
            }
            for skipped in plan.skipped
        ],
        "unserved_must": [tasks.ids[task] for task in plan.unserved],
        "checker": {
            "verdict": "feasible",
            "lengths": "geodesic, WGS84" if tasks.system == "wgs84" else "straight lines in the plane",
            "largest_share_of_usable_range": _largest_share(plan),
        },
        "remarks": list(plan.remarks),
        "solver": plan.solver,
        "seed": plan.seed,
        "time_limit": plan.time_limit,
        "seconds": round(plan.seconds, 3),
        "flight": asdict(flight),
        "source": {**source, "fleet": {"file": plan.fleet.source, "sha256": plan.fleet.sha256 or None}},
        **_machine(),
        "files": dict(files or {}),
    }


def write_summary(plan: Plan, path: Path, flight: FlightOptions, files: Mapping[str, str] | None = None) -> None:
    """
    :param plan: As of :func:`summary_of`
    :param path: The file to write
    :param flight: As of :func:`summary_of`
    :param files: As of :func:`summary_of`
    :raises OSError: If it cannot be written
    """
    text = json.dumps(summary_of(plan, flight, files), indent=1, ensure_ascii=False, allow_nan=False)
    write_atomically(path, text + "\n")


def _machine() -> dict[str, Any]:
    machine = describe_machine()
    # What lengths on the ellipsoid depend on.
    with suppress(metadata.PackageNotFoundError):
        machine["versions"]["pyproj"] = metadata.version("pyproj")
    return machine


def _uav(route: Route, altitude: float) -> dict[str, Any]:
    return {
        "uav": route.uav.id,
        "stops": len(route.stops),
        "length_m": _meters(route.length_m),
        "service_m": _meters(route.service_m),
        "used_m": _meters(route.used_m),
        "range_m": route.uav.range_m,
        "reserve_percent": route.uav.reserve_percent,
        "share_of_range": round(route.share_of_range, 6),
        "seconds": None if route.seconds is None else round(route.seconds, 1),
        "altitude_m": altitude,
    }


def _largest_share(plan: Plan) -> float:
    """The fullest UAV: what it uses of what the reserve leaves it."""
    shares = [route.used_m / route.uav.usable_m for route in plan.routes if route.uav.usable_m > 0]
    return round(float(np.max(shares, initial=0.0)), 6)


def _meters(length: float) -> float:
    return round(float(length), 3)

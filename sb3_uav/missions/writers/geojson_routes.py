"""
Routes as GeoJSON, for maps and GIS.

Format: https://www.rfc-editor.org/rfc/rfc7946 (longitude before latitude, lines cut at the antimeridian).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.common.files import write_atomically
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.lines import split_at_antimeridian

#: Foreign member (section 6.1 of the RFC) of files whose coordinates are not longitudes and latitudes
PLANE_MEMBER = "sb3_uav_plane"


def write_routes_geojson(plan: Plan, path: Path) -> None:
    """
    Write a collection of features, told apart by the property ``kind``:

    - ``"depot"``: a Point
    - ``"route"``: a LineString for every UAV that flies, a MultiLineString across the antimeridian, with ``uav``,
      ``length_m``, ``used_m`` (with service), ``share_of_range``, ``seconds`` (null if its speed is not known), ``stops``
      (their number) and ``tasks`` (their ids in flying order)
    - ``"stop"``: a Point with its number ``stop`` from 1 on, ``uav``, the task's ``id`` and what else is known of it
    - ``"skipped"``: a Point with the task's ``id``, ``reason`` and ``missing_m``, the meters of range that lack, or null

    GeoJSON has no planes. Coordinates of a plane are written as x and y all the same, and the collection says so by the
    foreign member ``sb3_uav_plane``.

    :param plan: A plan
    :param path: The file to write
    :raises OSError: If it cannot be written
    """
    tasks = plan.tasks
    features = [] if tasks.depot is None else [point_feature(tasks, tasks.depot, {"kind": "depot"})]
    features += [_route_feature(tasks, route) for route in plan.routes if route.flies]
    for route in plan.routes:
        for number, task in enumerate(route.stops, 1):
            properties = {"kind": "stop", "stop": number, "uav": route.uav.id, **task_properties(tasks, task)}
            features.append(point_feature(tasks, tasks.points[task], properties))
    for skipped in plan.skipped:
        missing = None if skipped.missing_m is None else round(skipped.missing_m, 3)
        properties = {
            "kind": "skipped",
            "reason": skipped.reason,
            "missing_m": missing,
            **task_properties(tasks, skipped.task),
        }
        features.append(point_feature(tasks, tasks.points[skipped.task], properties))
    write_collection(tasks, features, path)


def write_collection(tasks: TaskList, features: Sequence[Mapping[str, Any]], path: Path) -> None:
    """
    :param tasks: What the features show; says whether the coordinates are those of a plane
    :param features: The features
    :param path: The file to write
    :raises OSError: If it cannot be written
    """
    plane = {
        PLANE_MEMBER: {
            "meters_per_unit": tasks.meters_per_unit,
            "note": "Coordinates are x and y of a plane, not longitude and latitude.",
        }
    }
    content = {"type": "FeatureCollection", **(plane if tasks.system == "plane" else {}), "features": features}
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def point_feature(tasks: TaskList, point: np.ndarray, properties: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param tasks: Says in which coordinates the point is
    :param point: ``(2,)``
    :param properties: Of the feature
    :return: A Feature with a Point
    """
    geometry = {"type": "Point", "coordinates": _positions(tasks, point[None])[0]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _route_feature(tasks: TaskList, route: Route) -> dict[str, Any]:
    line = _positions(tasks, route.points)
    parts = split_at_antimeridian(line) if tasks.system == "wgs84" else [line]
    geometry = (
        {"type": "LineString", "coordinates": parts[0]}
        if len(parts) == 1
        else {"type": "MultiLineString", "coordinates": parts}
    )
    properties = {
        "kind": "route",
        "uav": route.uav.id,
        "length_m": round(route.length_m, 3),
        "used_m": round(route.used_m, 3),
        "share_of_range": round(route.share_of_range, 6),
        "seconds": None if route.seconds is None else round(route.seconds, 3),
        "stops": len(route.stops),
        "tasks": [tasks.ids[task] for task in route.stops],
    }
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _positions(tasks: TaskList, points: np.ndarray) -> list[list[float]]:
    """:return: Positions of GeoJSON: x before y, longitude before latitude."""
    positions: list[list[float]] = (points if tasks.system == "plane" else points[:, ::-1]).tolist()
    return positions


def task_properties(tasks: TaskList, task: int) -> dict[str, Any]:
    """:return: What is known of a task: ``id``, ``value``, ``service_s``, ``must`` and, where it matters, ``alt`` in meters"""
    altitude = float(tasks.altitudes[task])
    return {
        "id": tasks.ids[task],
        "value": float(tasks.values[task]),
        "service_s": float(tasks.service_s[task]),
        "must": bool(tasks.must[task]),
        **({} if np.isnan(altitude) else {"alt": altitude}),
    }

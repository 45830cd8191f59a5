"""A plan as plain data: what the page shows and what the API answers."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from typing import Any

from sb3_uav.missions.plan import Plan, Route, Skipped
from sb3_uav.missions.plan_file import plan_to_json
from sb3_uav.web.work import in_own_words


def plan_parts(plan: Plan, forbidden: Sequence[str] = ()) -> list[bytes]:
    """
    :param plan: A plan
    :param forbidden: Ids of tasks that the user has forbidden
    :return: The contents of mission.json, of :func:`report_of` and of :func:`geojson_of`, JSON compressed by zlib, in the
        order of :data:`~sb3_uav.web.jobs.PARTS`
    """
    whole = (plan_to_json(plan), report_of(plan, forbidden), geojson_of(plan))
    return [zlib.compress(json.dumps(part, allow_nan=False).encode(), 1) for part in whole]


def report_of(plan: Plan, forbidden: Sequence[str] = ()) -> dict[str, Any]:
    """
    :param plan: A plan
    :param forbidden: As of :func:`plan_parts`
    :return: Figures of the plan, of its routes and of the tasks that are left out
    """
    tasks = plan.tasks
    return {
        "objective": plan.objective,
        "total_value": float(tasks.values.sum()),
        "bound": plan.bound,
        "gap": plan.gap,
        "n_tasks": len(tasks),
        "n_served": plan.n_served,
        "length_m": plan.length_m,
        "unserved": [tasks.ids[task] for task in plan.unserved],
        "routes": [_route(plan, route) for route in plan.routes],
        "skipped": [
            *({"id": tasks.ids[skipped.task], **_skipped(skipped)} for skipped in plan.skipped),
            *({"id": name, "reason": "forbidden", "missing_m": None, "text": "forbidden by you"} for name in forbidden),
        ],
        "remarks": [in_own_words(remark) for remark in plan.remarks],
        "solver": plan.solver,
        "seed": plan.seed,
        "seconds": plan.seconds,
    }


def _route(plan: Plan, route: Route) -> dict[str, Any]:
    return {
        "uav": route.uav.id,
        "stops": [plan.tasks.ids[task] for task in route.stops],
        "points": route.points.tolist(),
        "legs_m": route.legs_m.tolist(),
        "length_m": route.length_m,
        "service_m": route.service_m,
        "used_m": route.used_m,
        "usable_m": route.uav.usable_m,
        "range_m": route.uav.range_m,
        "share_of_range": route.share_of_range,
        "seconds": route.seconds,
        "value": float(plan.tasks.values[list(route.stops)].sum()),
    }


def _skipped(skipped: Skipped) -> dict[str, Any]:
    text: str = skipped.reason
    if skipped.missing_m is not None:
        text += f": {skipped.missing_m:.0f} m of range are missing" if skipped.missing_m >= 1 else ": by less than 1 m"
    return {"reason": skipped.reason, "missing_m": skipped.missing_m, "text": text}


def geojson_of(plan: Plan) -> dict[str, Any]:
    """
    :param plan: A plan
    :return: Routes as LineStrings and tasks as Points, in the coordinates of the user; longitude comes first, as
        https://datatracker.ietf.org/doc/html/rfc7946#section-3.1.1 says
    """
    flipped = plan.tasks.system == "wgs84"
    features = []
    for route in plan.routes:
        if route.stops:
            points = route.points[:, ::-1] if flipped else route.points
            about = {"kind": "route", "uav": route.uav.id, "length_m": route.length_m, "share_of_range": route.share_of_range}
            features.append(_feature("LineString", points.tolist(), {**about, "n_stops": len(route.stops)}))
    stop_of = {task: (route.uav.id, number) for route in plan.routes for number, task in enumerate(route.stops, start=1)}
    reason_of = {skipped.task: skipped for skipped in plan.skipped}
    for task, name in enumerate(plan.tasks.ids):
        point = plan.tasks.points[task][::-1] if flipped else plan.tasks.points[task]
        about = {"kind": "task", "id": name, "value": float(plan.tasks.values[task])}
        if task in stop_of:
            about |= {"uav": stop_of[task][0], "stop": stop_of[task][1]}
        elif task in reason_of:
            about |= {"skipped": reason_of[task].reason, "missing_m": reason_of[task].missing_m}
        features.append(_feature("Point", point.tolist(), about))
    return {"type": "FeatureCollection", "features": features}


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}

"""A plan as an interactive plotly figure."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from sb3_uav.common.optional import require
from sb3_uav.missions.labels import (
    count,
    headline,
    ink_on,
    number,
    position,
    route_facts,
    shown,
    uav_color,
    uav_look,
    why_skipped,
)
from sb3_uav.missions.map_points import MapPoints, map_points
from sb3_uav.missions.plan import Plan, Reason, Route

if TYPE_CHECKING:
    import plotly.graph_objects as go

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
# Pixels: stops with and without a number in them, and how much of the distance between two stops one may fill.
LARGEST_STOP, SMALLEST_STOP, NUMBERED_STOP, STOP_SHARE = 20.0, 6.0, 12.0, 0.9
# Tasks that are left out must not outshine the stops.
LARGEST_SKIPPED = 9.0
_ARROW, _ARROW_AT = 13.0, 0.56
# What a figure is large that nobody has resized.
_WIDTH = 700.0
_LEGEND_CHARACTERS = 24
_GRAY, _RED = "#7d838a", "#B3261E"
_MUST_SYMBOL = "square"
_REASON_SYMBOLS: dict[Reason, str] = {
    "did not fit": "circle-open",
    "out of reach": "x-thin",
    "worth nothing": "circle-open-dot",
}
_SITES = {"start": "triangle-right", "end": "x", "start and end": "triangle-up"}


def plan_figure(plan: Plan) -> go.Figure:
    """
    Draw a plan to scale, in meters around the depot.

    Every UAV has one entry in the legend, which shows and hides its tour and its stops. Stops are numbered in flying order,
    squares must be served, and tasks that are left out are gray, or red if they must be served. Hovering tells the rest in the
    user's coordinates. Every trace says in its ``meta`` what it is: ``{"role": "tour" | "stops" | "entry", "uav":
    NUMBER}``, or ``{"role": "skipped" | "key" | "depot"}``.

    :param plan: A plan
    :return: A plotly figure
    :raises ImportError: If plotly is not installed
    """
    go = require("plotly.graph_objects", "The map", "missions")
    points = map_points(plan)
    size = stop_size(points.spacing * _WIDTH / points.extent)
    traces = [
        *(_tour(plan, uav, points, size) for uav in range(len(plan.routes))),
        *_skipped(plan, points, size),
        *(_stops(plan, uav, points, size) for uav in range(len(plan.routes))),
        *(_entry(plan, uav, points) for uav in range(len(plan.routes))),
        *_keys(plan),
        _depot(plan),
    ]
    return go.Figure([go.Scatter(trace) for trace in traces], _layout(plan, points))


def stop_size(spacing: float) -> float:
    """
    :param spacing: Pixels between stops
    :return: Diameter of a stop in pixels; below :data:`NUMBERED_STOP` there is no room for a number
    """
    # A single stop has no neighbor.
    return min(max(spacing * STOP_SHARE, SMALLEST_STOP), LARGEST_STOP) if spacing > 0 else LARGEST_STOP


def _text(name: str, limit: int = 60) -> str:
    """A name for plotly, which shows some tags and does not know all entities."""
    return html.escape(shown(name, limit), quote=False)


def _tour(plan: Plan, uav: int, points: MapPoints, size: float) -> dict[str, Any]:
    """The line of a UAV, with one more point on every leg for the arrow and for hovering."""
    route, corners = plan.routes[uav], points.routes[uav]
    # A bit beyond the middle, so that two arrows on the way out and back to the same stop do not meet.
    middles = corners[:-1] + _ARROW_AT * (corners[1:] - corners[:-1])
    path = np.empty((len(corners) + len(middles), 2))
    path[::2], path[1::2] = corners, middles
    hover: list[str] = [""] * len(path)
    hover[::2] = [_site(plan, route, "starts"), *_stop_texts(plan, route), _site(plan, route, "ends")]
    kinds = ["depot" if _at_depot(plan, route.points[row]) else kind for row, kind in ((0, "start"), (-1, "end"))]
    names = [kinds[0], *(plan.tasks.ids[stop] for stop in route.stops), kinds[1]]
    hover[1::2] = [
        f"<b>{_text(route.uav.id)}</b>, leg {leg + 1} of {len(middles)}<br>{_text(names[leg])} → {_text(names[leg + 1])}<br>"
        f"{route.legs_m[leg]:,.1f} m"
        for leg in range(len(middles))
    ]
    return {
        "mode": "lines+markers" if size >= NUMBERED_STOP else "lines",
        "x": _rounded(path[:, 0]) if route.flies else [],
        "y": _rounded(path[:, 1]) if route.flies else [],
        **_of_uav(plan, uav),
        "showlegend": False,
        "line": _line(uav),
        "marker": {
            "symbol": "arrow",
            "angleref": "previous",
            "size": [_ARROW * (point % 2) for point in range(len(path))] if route.flies else [],
            "color": uav_color(uav),
            "opacity": 1,
            "line": {"width": 0},
        },
        "text": hover if route.flies else [],
        "hoverinfo": "text",
        "meta": {"role": "tour", "uav": uav},
    }


def _of_uav(plan: Plan, uav: int) -> dict[str, Any]:
    """What makes the traces of a UAV one."""
    route = plan.routes[uav]
    return {"name": f"{_text(route.uav.id, _LEGEND_CHARACTERS)}: {route_facts(route)}", "legendgroup": f"uav {uav}"}


def _line(uav: int) -> dict[str, Any]:
    return {"color": uav_color(uav), "width": 2.5, "dash": uav_look(uav).dash}


def _stops(plan: Plan, uav: int, points: MapPoints, size: float) -> dict[str, Any]:
    """The stops of a UAV with their numbers."""
    route, look = plan.routes[uav], uav_look(uav)
    x, y = points.routes[uav][1 : len(route.stops) + 1].T
    must = plan.tasks.must[list(route.stops)]
    return {
        "mode": "markers+text" if size >= NUMBERED_STOP else "markers",
        "x": _rounded(x),
        "y": _rounded(y),
        **_of_uav(plan, uav),
        "showlegend": False,
        "marker": {
            "symbol": [_MUST_SYMBOL if first else "circle" for first in must],
            "size": size,
            "color": look.fill,
            "opacity": 1,
            "line": {
                "color": ["#000000" if first else look.edge for first in must],
                "width": [2.2 if first else look.edge_width for first in must],
            },
        },
        "text": [str(place) for place in range(1, len(route.stops) + 1)],
        "textfont": {"color": ink_on(look.fill), "size": 10},
        "hovertext": list(_stop_texts(plan, route)),
        "hoverlabel": {"bgcolor": uav_color(uav)},
        "hoverinfo": "text",
        "meta": {"role": "stops", "uav": uav},
    }


def _entry(plan: Plan, uav: int, points: MapPoints) -> dict[str, Any]:
    """The entry of a UAV in the legend, and where it starts and ends if that is not the depot."""
    sites, look = list(_own_sites(plan, uav)), uav_look(uav)
    # The first point, which is nowhere, stands for the UAV in the legend; the others keep lines from connecting the sites.
    nowhere = [math.nan, math.nan]
    places = [nowhere]
    for kind, _ in sites:
        places += [points.routes[uav][-1 if kind == "end" else 0].tolist(), nowhere]
    x, y = np.array(places).T
    return {
        "mode": "lines+markers",
        "x": _rounded(x),
        "y": _rounded(y),
        **_of_uav(plan, uav),
        "line": _line(uav),
        "marker": {
            "symbol": ["circle", *(symbol for kind, _ in sites for symbol in (_SITES[kind], "circle"))],
            "size": 14,
            "color": [look.fill, *[uav_color(uav)] * (len(places) - 1)],
            "line": {
                "color": [look.edge, *["#000000"] * (len(places) - 1)],
                "width": [look.edge_width, *[1.5] * (len(places) - 1)],
            },
        },
        "hovertext": ["", *(text for _, hover in sites for text in (hover, ""))],
        "hoverinfo": "text",
        "meta": {"role": "entry", "uav": uav},
    }


def _stop_texts(plan: Plan, route: Route) -> Iterator[str]:
    """What hovering over the stops of a route tells."""
    tasks = plan.tasks
    flown = itertools.accumulate(route.legs_m)
    for place, (stop, leg, length) in enumerate(zip(route.stops, route.legs_m, flown, strict=False), 1):
        yield "<br>".join(
            [
                f"<b>{_text(tasks.ids[stop])}</b>{', must be served' if tasks.must[stop] else ''}",
                f"stop {place} of {len(route.stops)} of {_text(route.uav.id)}",
                *_task_facts(plan, stop),
                f"leg {leg:,.1f} m, {length:,.1f} m from the start",
            ]
        )


def _task_facts(plan: Plan, task: int) -> list[str]:
    tasks = plan.tasks
    service = f", {tasks.service_s[task]:g} s of service" if tasks.service_s[task] > 0 else ""
    return [position(tasks.system, tasks.points[task]), f"value {number(float(tasks.values[task]))}{service}"]


def _site(plan: Plan, route: Route, does: str) -> str:
    """What hovering over the start or the end of a route tells."""
    used = f"<br>{route.length_m:,.1f} m flown" if does == "ends" else ""
    if does == "ends" and route.service_m > 0:
        used += f", {route.service_m:,.1f} m for service"
    point = route.points[0 if does == "starts" else -1]
    return f"<b>{_text(route.uav.id)}</b> {does} here<br>{position(plan.tasks.system, point)}{used}"


def _at_depot(plan: Plan, point: np.ndarray) -> bool:
    return plan.tasks.depot is not None and np.array_equal(point, plan.tasks.depot)


def _own_sites(plan: Plan, uav: int) -> Iterator[tuple[str, str]]:
    """Where a UAV starts and ends, as far as that is not the depot: what it is, and what hovering tells."""
    route = plan.routes[uav]
    start, end = (None if _at_depot(plan, point) else point for point in (route.points[0], route.points[-1]))
    if start is not None and end is not None and np.array_equal(start, end):
        yield "start and end", _site(plan, route, "starts")
        return
    if start is not None:
        yield "start", _site(plan, route, "starts")
    if end is not None and route.flies:
        yield "end", _site(plan, route, "ends")


def _skipped(plan: Plan, points: MapPoints, size: float) -> Iterator[dict[str, Any]]:
    """The tasks that no UAV serves, a trace per reason."""
    for reason in get_args(Reason):
        skipped = [one for one in plan.skipped if one.reason == reason]
        if not skipped:
            continue
        tasks = [one.task for one in skipped]
        must = plan.tasks.must[tasks]
        x, y = points.tasks[tasks].T
        symbol = _REASON_SYMBOLS[reason]
        yield {
            "mode": "markers",
            "x": _rounded(x),
            "y": _rounded(y),
            "name": f"{reason}: {count(len(skipped), 'task')}",
            "legendrank": 1001,
            "marker": {
                "symbol": [f"{_MUST_SYMBOL}-{'x-' if symbol == 'x-thin' else ''}open" if first else symbol for first in must],
                "size": min(size, LARGEST_SKIPPED),
                "color": [_RED if first else _GRAY for first in must],
                "line": {"width": 1.7, "color": [_RED if first else _GRAY for first in must]},
            },
            "hovertext": [
                "<br>".join(
                    [
                        f"<b>{_text(plan.tasks.ids[one.task])}</b>{', must be served' if plan.tasks.must[one.task] else ''}",
                        why_skipped(one),
                        *_task_facts(plan, one.task),
                    ]
                )
                for one in skipped
            ],
            "hoverinfo": "text",
            "meta": {"role": "skipped"},
        }


def _keys(plan: Plan) -> Iterator[dict[str, Any]]:
    """Entries of the legend that explain symbols."""
    n_must = int(plan.tasks.must.sum())
    if n_must:
        left = f", {len(plan.unserved):,} left out" if plan.unserved else ""
        yield _key(f"must be served: {count(n_must, 'task')}{left}", _MUST_SYMBOL)
    kinds = {kind for uav in range(len(plan.fleet)) for kind, _ in _own_sites(plan, uav)}
    for kind, symbol in _SITES.items():
        if kind in kinds:
            yield _key(f"{kind} of a UAV", symbol)


def _key(name: str, symbol: str) -> dict[str, Any]:
    return {
        "mode": "markers",
        "x": [None],
        "y": [None],
        "name": name,
        "marker": {"symbol": symbol, "size": 11, "color": "#bdbdbd", "line": {"color": "#000000", "width": 1.5}},
        "hoverinfo": "skip",
        "legendrank": 1002,
        "meta": {"role": "key"},
    }


def _depot(plan: Plan) -> dict[str, Any]:
    assert plan.tasks.depot is not None
    return {
        "mode": "markers",
        "x": [0],
        "y": [0],
        "name": "depot",
        "marker": {"symbol": "diamond", "size": 17, "color": "#000000", "line": {"color": "#ffffff", "width": 2}},
        "hovertext": [f"<b>depot</b><br>{position(plan.tasks.system, plan.tasks.depot)}"],
        "hoverinfo": "text",
        "legendrank": 1003,
        "meta": {"role": "depot"},
    }


def _layout(plan: Plan, points: MapPoints) -> dict[str, Any]:
    directions = ("east of", "north of") if plan.tasks.system == "wgs84" else ("in x from", "in y from")
    axis = {
        "showgrid": True,
        "gridcolor": "#e6e8eb",
        "zeroline": False,
        "linecolor": "#b8bcc2",
        "showline": True,
        "mirror": True,
        "tickformat": ",~r",
        "ticks": "outside",
        "tickcolor": "#b8bcc2",
        "exponentformat": "none",
    }
    ranges: list[dict[str, Any]] = [{}, {}]
    if points.is_focused:
        low, high = points.focus
        margin = 0.06 * max(float((high - low).max()), 1.0)
        ranges = [{"range": [float(low[row] - margin), float(high[row] + margin)]} for row in (0, 1)]
    return {
        "template": "none",
        "title": {
            "text": f"{_text(Path(plan.tasks.source).name)}<br><sup>{headline(plan)}</sup>",
            "x": 0.02,
            "xanchor": "left",
        },
        "font": {"family": FONT, "size": 13, "color": "#1d2125"},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#fafbfc",
        "xaxis": {**axis, **ranges[0], "title": {"text": f"meters {directions[0]} the depot", "standoff": 8}},
        "yaxis": {
            **axis,
            **ranges[1],
            "title": {"text": f"meters {directions[1]} the depot", "standoff": 8},
            "scaleanchor": "x",
            "scaleratio": 1,
        },
        "legend": {"groupclick": "togglegroup", "itemwidth": 40, "font": {"size": 12}, "tracegroupgap": 0},
        "hovermode": "closest",
        "hoverlabel": {"align": "left", "font": {"family": FONT, "size": 13}},
        "dragmode": "pan",
        "margin": {"l": 85, "r": 20, "t": 70, "b": 64},
    }


def _rounded(values: np.ndarray) -> list[float | None]:
    """Millimeters, so that files do not grow with digits that mean nothing; None where there is nothing."""
    return [None if np.isnan(value) else round(float(value), 3) for value in values]

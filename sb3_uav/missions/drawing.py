"""Tasks, fleets and plans as they show themselves in a notebook: light HTML, without scripts and without plotly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.labels import (
    count,
    escaped,
    headline,
    ink_on,
    meters,
    number,
    position,
    route_facts,
    uav_color,
    uav_look,
    why_skipped,
)
from sb3_uav.missions.map_points import from_depot, map_points
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.tasks import TaskList

_WIDTH, _HEIGHT, _BORDER = 640.0, 440.0, 18.0
# More would make notebooks heavy, and the picture no clearer.
_MAX_POINTS, _MAX_TITLES, _MAX_NUMBERS, _MAX_ROWS = 2_000, 500, 60, 20
_SENTENCE = 1_000
_GRAY, _RED = "#7d838a", "#B3261E"


def plan_html(plan: Plan) -> str:
    """
    :param plan: A plan
    :return: A map to scale and what the plan achieves, names escaped
    """
    points = map_points(plan)
    view = _View(points.focus if points.is_focused else points.whole)
    is_small, titled = plan.n_served <= _MAX_NUMBERS, len(plan.tasks) <= _MAX_TITLES
    radius = 7.0 if is_small else 4.0 if len(plan.tasks) <= _MAX_TITLES else 2.5
    marks, lines = [], []
    for one in plan.skipped[:_MAX_POINTS]:
        must = bool(plan.tasks.must[one.task])
        title = f"{plan.tasks.ids[one.task]}: {why_skipped(one)}" if titled else ""
        marks.append(view.mark(points.tasks[one.task], min(radius, 3.5), "none", _RED if must else _GRAY, 1.3, must, title))
    for uav, (route, corners) in enumerate(zip(plan.routes, points.routes, strict=True)):
        look = uav_look(uav)
        lines.append(view.line(corners, uav_color(uav), look.dash_array))
        for row, does in ((0, "starts"), (-1, "ends")):
            if np.any(corners[row]) and route.flies:
                marks.append(view.site(corners[row], uav_color(uav), f"{route.uav.id} {does} here"))
        for place, (stop, point) in enumerate(zip(route.stops, corners[1:-1], strict=False), 1):
            must = bool(plan.tasks.must[stop])
            title = f"{plan.tasks.ids[stop]}: stop {place} of {route.uav.id}" if titled else ""
            edge = "#000000" if must else look.edge
            marks.append(view.mark(point, radius, look.fill, edge, look.edge_width, must, title))
            if is_small:
                marks.append(view.number(point, place, ink_on(look.fill)))
    if points.n_outside:
        verb = "lies" if points.n_outside == 1 else "lie"
        outside = f"<div>{count(points.n_outside, 'task')} {verb} far away, outside of this picture</div>"
    else:
        outside = ""
    names = [
        f"<tr>{_cell(uav_sample(uav), 'left')}{_cell(escaped(route.uav.id), 'left')}{_cell(route_facts(route), 'left')}</tr>"
        for uav, route in enumerate(plan.routes[:_MAX_ROWS])
    ]
    if len(plan.routes) > _MAX_ROWS:
        names.append(f'<tr><td></td><td colspan="2">and {count(len(plan.routes) - _MAX_ROWS, "more UAV")}</td></tr>')
    remarks = "".join(f"<div>{escaped(remark, _SENTENCE)}</div>" for remark in plan.remarks[:_MAX_ROWS])
    return (
        f"<div><div><b>{escaped(Path(plan.tasks.source).name)}</b>: {escaped(headline(plan), _SENTENCE)}</div>"
        f"{view.svg([*lines, *marks, view.depot(np.zeros(2))])}{outside}"
        f'<table style="border-collapse:collapse;margin:4px 0">{"".join(names)}</table>{remarks}</div>'
    )


def tasks_html(tasks: TaskList) -> str:
    """
    :param tasks: Tasks, whose contents nobody may have checked
    :return: Where they are, and how many of what kind, names escaped
    """
    n_must, n_service = int(tasks.must.sum()), int((tasks.service_s > 0).sum())
    facts = [count(len(tasks), "task"), f"value {number(float(tasks.values.sum()))} in all"]
    facts += [f"{n_must:,} must be served"] * (n_must > 0) + [f"{n_service:,} take time"] * (n_service > 0)
    facts.append("no depot" if tasks.depot is None else f"depot at {position(tasks.system, tasks.depot)}")
    if tasks.fleet is not None:
        facts.append(count(len(tasks.fleet), "UAV"))
    return f"<div><div><b>{escaped(tasks.source)}</b>: {escaped(', '.join(facts), _SENTENCE)}</div>{_tasks_svg(tasks)}</div>"


def fleet_html(fleet: Fleet) -> str:
    """
    :param fleet: UAVs
    :return: A table of them, names escaped
    """
    columns = {
        "UAV": "left",
        "Range": "right",
        "Reserve": "right",
        "Usable": "right",
        "Speed": "right",
        "Start": "left",
        "End": "left",
    }
    rows = [f"<tr>{''.join(map(_cell, _facts(uav), columns.values()))}</tr>" for uav in fleet.uavs[:_MAX_POINTS]]
    more = f"<div>and {count(len(fleet) - _MAX_POINTS, 'more UAV')}</div>" if len(fleet) > _MAX_POINTS else ""
    titles = "".join(f'<th style="text-align:{align};padding:1px 10px 1px 0">{name}</th>' for name, align in columns.items())
    return (
        f"<div><div><b>{escaped(fleet.source)}</b>: {count(len(fleet), 'UAV')}</div>"
        f"<table><thead><tr>{titles}</tr></thead><tbody>{''.join(rows)}</tbody></table>{more}</div>"
    )


def uav_sample(uav: int) -> str:
    """
    :param uav: Number of a UAV, from 0
    :return: An SVG of how its tour and its stops look
    """
    look = uav_look(uav)
    return (
        '<svg class="sample" width="34" height="12" viewBox="0 0 34 12" aria-hidden="true">'
        f'<path d="M1 6H33" stroke="{uav_color(uav)}" stroke-width="2.5"{_dashed(look.dash_array)}/>'
        f'<circle cx="17" cy="6" r="4.5" fill="{look.fill}" stroke="{look.edge}" stroke-width="{look.edge_width:g}"/></svg>'
    )


def _facts(uav: Uav) -> tuple[str, ...]:
    sites = ("depot" if point is None else ", ".join(f"{value:.10g}" for value in point) for point in (uav.start, uav.end))
    speed = "" if uav.speed_mps is None else f"{uav.speed_mps:g} m/s"
    return (escaped(uav.id), meters(uav.range_m), f"{uav.reserve_percent:g} %", meters(uav.usable_m), speed, *sites)


def _cell(content: str, align: str) -> str:
    return f'<td style="text-align:{align};padding:1px 10px 1px 0">{content}</td>'


def _tasks_svg(tasks: TaskList) -> str:
    """A map of those positions that exist; nothing without one, or without pyproj for latitudes and longitudes."""
    places = tasks.points if tasks.depot is None else np.vstack([tasks.points, tasks.depot])
    limits = (90.0, 360.0) if tasks.system == "wgs84" else (1e12, 1e12)
    exist = (np.abs(places) <= limits).all(axis=1)
    if not exist.any():
        return ""
    has_depot = tasks.depot is not None and bool(exist[-1])
    center = tasks.depot if has_depot else places[exist][0]
    try:
        points = from_depot(replace(tasks, depot=center), places[exist])
    except ImportError:
        return ""
    view = _View(points)
    shown = np.flatnonzero(exist[: len(tasks)])
    step = max(1, -(-len(shown) // _MAX_POINTS))
    titled = len(shown) <= _MAX_TITLES
    marks = [
        view.mark(
            points[row],
            3.5,
            uav_color(0),
            "#000000" if tasks.must[task] else "#ffffff",
            1.5 if tasks.must[task] else 0.7,
            bool(tasks.must[task]),
            f"{tasks.ids[task]}: value {number(float(tasks.values[task]))}" if titled else "",
        )
        for row, task in list(enumerate(shown))[::step]
    ]
    left_out = f"<div>one of {step:,} tasks is drawn</div>" if step > 1 else ""
    return view.svg([*marks, *([view.depot(points[-1])] if has_depot else [])]) + left_out


class _View:
    """
    A piece of the plane on a drawing.

    :param points: ``(n, 2)`` meters, everything that has to be visible
    """

    def __init__(self, points: np.ndarray) -> None:
        self._low, high = points.min(axis=0), points.max(axis=0)
        sides = high - self._low
        # A single point has no extent; any scale will do.
        self._scale = float(
            min(
                ((size - 2 * _BORDER) / side for size, side in zip((_WIDTH, _HEIGHT), sides, strict=True) if side > 0),
                default=1.0,
            )
        )
        self._height = max(2 * _BORDER + float(sides[1]) * self._scale, 120.0)
        self._left = (_WIDTH - float(sides[0]) * self._scale) / 2
        self._bottom = (self._height - float(sides[1]) * self._scale) / 2

    def _at(self, point: np.ndarray) -> tuple[float, float]:
        right, up = (float(value) for value in (point - self._low) * self._scale)
        return self._left + right, self._height - self._bottom - up

    def line(self, corners: np.ndarray, color: str, dash_array: str) -> str:
        path = " ".join("{:.1f},{:.1f}".format(*self._at(corner)) for corner in corners)
        return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.8"{_dashed(dash_array)}/>'

    def mark(self, point: np.ndarray, radius: float, fill: str, edge: str, width: float, must: bool, title: str) -> str:
        x, y = self._at(point)
        style = f'fill="{fill}" stroke="{edge}" stroke-width="{width:g}"'
        inside = f"<title>{escaped(title, 150)}</title>" if title else ""
        if must:
            corner, side = (x - radius, y - radius), 2 * radius
            return f'<rect x="{corner[0]:.1f}" y="{corner[1]:.1f}" width="{side:g}" height="{side:g}" {style}>{inside}</rect>'
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" {style}>{inside}</circle>'

    def number(self, point: np.ndarray, number: int, ink: str) -> str:
        x, y = self._at(point)
        style = f'font-size="9" font-family="sans-serif" text-anchor="middle" fill="{ink}" pointer-events="none"'
        return f'<text x="{x:.1f}" y="{y + 3.2:.1f}" {style}>{number}</text>'

    def site(self, point: np.ndarray, color: str, title: str) -> str:
        x, y = self._at(point)
        triangle = f'<path d="M{x:.1f} {y - 7:.1f}l6.5 11h-13z" fill="{color}" stroke="#000000">'
        return f"{triangle}<title>{escaped(title, 150)}</title></path>"

    def depot(self, point: np.ndarray) -> str:
        x, y = self._at(point)
        diamond = f"M{x:.1f} {y - 8:.1f}l8 8-8 8-8-8z"
        return f'<path d="{diamond}" fill="#000000" stroke="#ffffff" stroke-width="1.5"><title>depot</title></path>'

    def svg(self, marks: Sequence[str]) -> str:
        style = "max-width:100%;height:auto;overflow:hidden;background:#fafbfc"
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {self._height:.0f}" width="{_WIDTH:g}" '
            f'style="{style}" role="img">{"".join(marks)}{self._ruler()}</svg>'
        )

    def _ruler(self) -> str:
        """A length in meters, as long as a round number allows."""
        most = 130.0 / self._scale
        power = 10.0 ** np.floor(np.log10(most))
        length = next(float(digit * power) for digit in (5, 2, 1) if digit * power <= most)
        width, y = length * self._scale, self._height - 8
        label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
        return (
            f'<path d="M8 {y - 5:.1f}v5h{width:.1f}v-5" fill="none" stroke="#1d2125" stroke-width="1.5"/>'
            f'<text x="{8 + width / 2:.1f}" y="{y - 4:.1f}" font-size="11" font-family="sans-serif" text-anchor="middle" '
            f'fill="#1d2125">{label}</text>'
        )


def _dashed(dash_array: str) -> str:
    return f' stroke-dasharray="{dash_array}"' if dash_array else ""

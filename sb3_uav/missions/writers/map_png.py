"""The plan as a picture: tours, numbered stops, skipped tasks, a scale in meters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.missions.labels import count, number, route_facts, shown, uav_color, uav_look
from sb3_uav.missions.plan import Plan, Reason, Route
from sb3_uav.plots.figure_files import checked_path, new_figure, save_figure

_WIDTH = 8.0
# Inches of the map: between a strip and a tower.
_LOWEST, _HIGHEST = 3.5, 9.0
_BORDER = 0.06
# Below the map, for the bar of the scale.
_SCALE_STRIP = 0.04
_SKIPPED: dict[Reason, dict[str, Any]] = {
    "did not fit": dict(marker="o", edgecolors="0.45"),
    "out of reach": dict(marker="^", edgecolors="#D55E00"),
    "worth nothing": dict(marker="s", edgecolors="0.7"),
}
# The legend of a larger fleet would be longer than the map.
_MAX_NAMED = 20
# Dashes as plotly names them.
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}
_COLUMNS = 2
# Points between two numbers, and from a stop to its number.
_LABEL_WIDTH, _LABEL_HEIGHT = 11.0, 7.5
_LABEL_OFFSET = 4.0


def write_map_png(plan: Plan, path: Path) -> None:
    """
    :param plan: The plan
    :param path: The ``.png`` (or ``.pdf``, ``.svg``) to write
    :raises ValueError: If the file has another suffix
    :raises ImportError: If matplotlib is not installed
    """
    save_figure(map_figure(plan), checked_path(path))


def map_figure(plan: Plan) -> Any:
    """
    :param plan: The plan
    :return: A matplotlib figure in meters, north up: the depot, tours in colors, numbered stops, skipped tasks hollow
    :raises ImportError: If matplotlib is not installed
    """
    to_plane = plan.tasks.coordinates().to_plane
    tasks = to_plane(plan.tasks.points)
    depot = None if plan.tasks.depot is None else to_plane(plan.tasks.depot[None])[0]
    paths = [to_plane(route.points) for route in plan.routes]
    low, high = _view(plan, tasks, depot, paths)
    width, height = high - low
    inches = float(np.clip(_WIDTH * height / width, _LOWEST, _HIGHEST))
    lines = math.ceil((min(len(plan.routes), _MAX_NAMED) + 6) / _COLUMNS)
    figure = new_figure(_WIDTH, inches + 0.2 * lines + 0.4)
    axes = figure.add_subplot()
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_color("0.8")
    points_per_meter = 72 * min(_WIDTH / width, inches / height)
    size = float(np.clip(18 * math.sqrt(80 / max(len(tasks), 1)), 5, 28))
    if depot is not None:
        axes.scatter(*depot, marker="s", s=65, color="black", zorder=6, label="depot")
    # No number over the depot.
    taken: list[np.ndarray] = [] if depot is None else [depot * points_per_meter]
    for uav, (route, path) in enumerate(zip(plan.routes, paths, strict=True)):
        _draw_route(axes, plan, uav, route, path, size)
    for route, path in zip(plan.routes, paths, strict=True):
        _number_stops(axes, path[1:-1] if route.stops else path[:0], points_per_meter, taken)
    if plan.tasks.must.any():
        axes.scatter([], [], marker="*", s=70, color="0.4", linewidths=0, label="stop that must be served")
    _draw_skipped(axes, plan, tasks, size, (low, high))
    _draw_scale(axes, low, high, "N" if plan.tasks.system == "wgs84" else "y")
    axes.set_title(
        f"{shown(Path(plan.tasks.source).name)}: {plan.n_served:,} of {count(len(plan.tasks), 'task')} served, "
        f"value {number(plan.objective)} of {number(float(plan.tasks.values.sum()))}",
        fontsize=10,
        loc="left",
        parse_math=False,
    )
    legend = axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=_COLUMNS, fontsize=8, frameon=False)
    for text in legend.get_texts():
        text.set_parse_math(False)
    return figure


def _view(plan: Plan, tasks: np.ndarray, depot: np.ndarray | None, paths: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what is shown: everything but tasks out of reach, which may be on another continent."""
    far = {skipped.task for skipped in plan.skipped if skipped.reason == "out of reach"}
    near = [task for task in range(len(tasks)) if task not in far]
    flown = [path for path, route in zip(paths, plan.routes, strict=True) if route.length_m > 0]
    shown = np.vstack([tasks[near], *flown, *([] if depot is None else [depot[None]])])
    low, high = shown.min(0), shown.max(0)
    if far:
        # Those that are not much farther away are shown too.
        middle, reach = (low + high) / 2, float((high - low).max() or 1.0)
        beside = tasks[[task for task in sorted(far) if (np.abs(tasks[task] - middle) < reach).all()]]
        low, high = np.vstack([low, beside]).min(0), np.vstack([high, beside]).max(0)
    extent = float((high - low).max() or 100.0)
    # A strip gets some height, so that its numbers have room.
    missing = np.maximum(0.4 * extent - (high - low), 0) / 2
    border = _BORDER * extent + missing
    return low - border - np.array([0, _SCALE_STRIP * extent]), high + border


def _draw_skipped(axes: Any, plan: Plan, tasks: np.ndarray, size: float, view: tuple[np.ndarray, np.ndarray]) -> None:
    must = set(np.flatnonzero(plan.tasks.must).tolist())
    for reason, style in _SKIPPED.items():
        chosen = [skipped.task for skipped in plan.skipped if skipped.reason == reason]
        if not chosen:
            continue
        points = tasks[chosen]
        outside = int(((points < view[0]) | (points > view[1])).any(axis=1).sum())
        label = f"{len(chosen)} skipped, {reason}" + (f" ({outside} outside the map)" if outside else "")
        axes.scatter(*points.T, s=size, facecolors="none", linewidths=0.9, zorder=2, label=label, **style)
    unserved = [skipped.task for skipped in plan.skipped if skipped.task in must]
    if unserved:
        star = dict(marker="*", s=4 * size, facecolors="none", edgecolors="red", linewidths=1.0, zorder=5)
        axes.scatter(*tasks[unserved].T, **star, label=f"{len(unserved)} not served that must be")


def _draw_route(axes: Any, plan: Plan, uav: int, route: Route, path: np.ndarray, size: float) -> None:
    color, look = uav_color(uav), uav_look(uav)
    line = dict(color=color, linestyle=_DASHES[look.dash], linewidth=1.2)
    is_hollow = look.fill != color
    stop = dict(facecolors=look.fill, edgecolors=color, linewidths=0.9 if is_hollow else 0.0, zorder=4)
    label = f"{shown(route.uav.id)}: {route_facts(route)}"
    if uav == _MAX_NAMED:
        axes.plot([], [], linestyle="", label=f"{len(plan.routes) - _MAX_NAMED} more UAVs")
    elif uav < _MAX_NAMED:
        axes.plot([], [], **line, marker="o", markersize=4, markerfacecolor=look.fill, label=label)
    axes.plot(*(path if route.flies else path[:0]).T, **line, zorder=3)
    must = plan.tasks.must[list(route.stops)]
    stops = path[1:-1]
    axes.scatter(*stops[~must].T, s=size, **stop)
    axes.scatter(*stops[must].T, s=4 * size, marker="*", **stop)
    for marker, own, point in ((">", route.uav.start, path[0]), ("X", route.uav.end, path[-1])):
        if own is not None:
            axes.scatter(*point, marker=marker, s=50, color=color, edgecolors="black", linewidths=0.8, zorder=6)


def _number_stops(axes: Any, stops: np.ndarray, points_per_meter: float, taken: list[np.ndarray]) -> None:
    """
    Write the numbers of the stops next to them, as many as fit: the first and the last come first, then round ones.

    :param axes: matplotlib axes
    :param stops: ``(n, 2)`` in meters
    :param points_per_meter: Scale of the map
    :param taken: Where numbers stand already, in points; grows
    """
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=1.6, foreground="white")]

    def rank(stop: int) -> tuple[int, int]:
        number = stop + 1
        return (0 if number in (1, len(stops)) else 1 if number % 10 == 0 else 2 if number % 5 == 0 else 3), number

    for stop in sorted(range(len(stops)), key=rank):
        place = stops[stop] * points_per_meter
        if taken and (np.abs(np.array(taken) - place) < (_LABEL_WIDTH, _LABEL_HEIGHT)).all(axis=1).any():
            continue
        taken.append(place)
        axes.annotate(
            str(stop + 1),
            stops[stop],
            (_LABEL_OFFSET, _LABEL_OFFSET / 2),
            textcoords="offset points",
            fontsize=6.5,
            zorder=7,
            path_effects=halo,
            annotation_clip=True,
        )


def _draw_scale(axes: Any, low: np.ndarray, high: np.ndarray, up: str) -> None:
    """A bar of a round length at the lower left, and an arrow that points up at the upper right."""
    width, height = high - low
    length = round_length(width / 4)
    x, y = low + 0.03 * np.array([width, height])
    axes.plot([x, x, x + length, x + length], [y + 0.012 * height, y, y, y + 0.012 * height], color="black", lw=1.4, zorder=8)
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    axes.text(x + length / 2, y + 0.014 * height, text, ha="center", va="bottom", fontsize=8, zorder=8)
    arrow = dict(arrowstyle="-|>", color="black", linewidth=1.2)
    axes.annotate("", (0.97, 0.955), (0.97, 0.9), "axes fraction", "axes fraction", arrow)
    axes.text(0.97, 0.957, up, transform=axes.transAxes, fontsize=9, ha="center", va="bottom")


def round_length(most: float) -> float:
    """:return: The largest of 1, 2 and 5 times a power of ten that is not above ``most``"""
    power = 10.0 ** math.floor(math.log10(most))
    return next(factor * power for factor in (5, 2, 1) if factor * power <= most * (1 + 1e-9))

"""Maps of schedules and of running episodes. matplotlib is imported when it is first used."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.optional import install_command
from sb3_uav.envs.distances import DISTANCE_TOLERANCE
from sb3_uav.envs.episodes import Episodes
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Stage

logger = logging.getLogger(__name__)

# Okabe and Ito's palette, readable with color-vision deficiencies.
UAV_COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C6D31", "#000000")

# Legend entries of the tasks that are on no route.
_REMAINING_TASKS = {Stage.ASSIGNING: "not yet assigned", Stage.FLYING: "not yet visited", Stage.FINISHED: "skipped"}
# Where UAVs start and end, if not at the depot.
_START, _END, _BOTH = "start", "end", "start and end"
_SITES: dict[str, dict[str, Any]] = {
    _START: dict(marker=">", s=60, edgecolors="black", linewidths=0.9),
    _END: dict(marker="X", s=60, edgecolors="black", linewidths=0.9),
    _BOTH: dict(marker="s", s=50, edgecolors="black", linewidths=0.9),
}
# A task that must be served.
_STAR: dict[str, Any] = dict(marker="*", s=90)
# The legend of a larger fleet would not fit below the map.
_MAX_UAVS_NAMED = 12
_LEGEND_COLUMNS = 2

# Sides of the map, in units of the points' extent.
_BORDER = 1.08
# Inches: a figure, the frame around the map, a line of the legend below it, and the title above it.
_FIGURE_WIDTH, FIGURE_HEIGHT, _MARGIN, LEGEND_LINE_HEIGHT = 5.0, 5.6, 0.15, 0.185
_TITLE_HEIGHT = 0.25


def require_matplotlib() -> Any:
    """
    :return: The module ``matplotlib``
    :raises ImportError: With the command that installs it
    """
    try:
        import matplotlib
        import matplotlib.figure
    except ImportError as error:
        raise ImportError(f"Drawing needs matplotlib; run: {install_command('plots')}") from error
    return matplotlib


def draw_map(
    axes: Any,
    instances: Instances,
    row: int,
    routes: Sequence[Sequence[int]],
    title: str = "",
    stage: Stage = Stage.FINISHED,
) -> None:
    """
    Draw a square map of the depot, the tasks of each UAV in its color, and the other tasks as hollow circles. Tasks that must
    be served are stars. Where UAVs start or end elsewhere than at the depot is marked in their colors.

    Tours are complete if the episode is finished, and end at the UAV's position while it flies. While tasks are being assigned
    there are no tours to draw.

    :param axes: matplotlib axes
    :param instances: The instances
    :param row: Index of the instance
    :param routes: Task indices from 0 per UAV
    :param title: Title of the axes
    :param stage: Stage of the episode
    """
    instance = instances[row]
    depot = instance.depot[0].numpy()
    tasks = instance.tasks[0][instance.task_mask[0]].numpy()
    must_serve = np.zeros(len(tasks), bool)
    if instance.must_serve is not None:
        must_serve = instance.must_serve[0, : len(tasks)].numpy()
    maximum = float(instance.unit[0])
    named = _named_uavs(routes)
    flights = [Flight.of(instance, uav, route) for uav, route in enumerate(routes)]
    for uav, (route, flight) in enumerate(zip(routes, flights, strict=True)):
        if len(route) == 0 and uav not in named:
            continue
        color = UAV_COLORS[uav % len(UAV_COLORS)]
        label = f"UAV {uav + 1}: {_counted(len(route))}, {flight.distances(stage)}" if uav in named else "_nolegend_"
        if stage is not Stage.ASSIGNING:
            path = flight.path(stage)
            axes.plot(*path.T, color=color, linewidth=1.4, zorder=3, label=label)
            label = "_nolegend_"
        is_star = must_serve[list(route)]
        axes.scatter(*flight.points[~is_star].T, s=22, color=color, zorder=4, label=label)
        if is_star.any():
            axes.scatter(*flight.points[is_star].T, **_STAR, color=color, zorder=4)
        if stage is Stage.FLYING:
            axes.scatter(*path[-1], marker="^", s=70, facecolors="none", edgecolors=color, linewidths=1.6, zorder=6)
        for kind, point in flight.own_sites(depot).items():
            axes.scatter(*point, **_SITES[kind], facecolors=color, zorder=5)
    if len(named) < len(routes):
        axes.scatter([], [], s=0, label=f"{len(routes) - len(named)} more UAVs")
    reach = _rounded(maximum, maximum)
    if instance.max_distance.dim() == 2:
        reach = f"{_rounded(float(instance.max_distance.min()), maximum)} to {reach}"
    axes.scatter(*depot, marker="s", s=70, color="black", zorder=5, label=f"depot (D = {reach})")
    for kind in _site_kinds(flights, depot):
        axes.scatter([], [], **_SITES[kind], facecolors="0.75", label=kind)
    visited = {task for route in routes for task in route}
    hollow = np.array([task not in visited for task in range(len(tasks))], bool)
    outline = dict(facecolors="none", linewidths=0.9, zorder=2)
    circles = hollow & ~must_serve
    axes.scatter(
        *tasks[circles].T, s=22, edgecolors="0.55", **outline, label=f"{_counted(int(hollow.sum()))} {_REMAINING_TASKS[stage]}"
    )
    if must_serve.any():
        unserved = hollow & must_serve
        label = f"{int(must_serve.sum())} must be served, {int(unserved.sum())} {_REMAINING_TASKS[stage]}"
        axes.scatter(*tasks[unserved].T, **_STAR, edgecolors="black", **outline, label=label)
    # The end of a UAV that cannot reach it may be anywhere.
    sites = [point for flight in flights for point in (flight.start, flight.start if flight.is_grounded else flight.end)]
    _set_limits(axes, np.vstack([depot, tasks, *sites]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=_LEGEND_COLUMNS, fontsize=8, frameon=False)
    if title:
        axes.set_title(title, fontsize=11)


def legend_lines(routes: Sequence[Sequence[int]], instance: Instances | None = None) -> int:
    """
    :param routes: Task indices per UAV
    :param instance: A batch of one; the paper's problem when None
    :return: Number of lines of the legend that :func:`draw_map` puts below the map
    """
    named = len(_named_uavs(routes))
    # Depot and hollow tasks have entries too.
    n_entries = named + (named < len(routes)) + 2
    if instance is not None:
        flights = [Flight.of(instance, uav, ()) for uav in range(len(routes))]
        n_entries += len(_site_kinds(flights, instance.depot[0].numpy()))
        n_entries += instance.must_serve is not None and bool((instance.must_serve & instance.task_mask).any())
    return math.ceil(n_entries / _LEGEND_COLUMNS)


class Flight(NamedTuple):
    """
    What is drawn of one UAV.

    :param start: ``(2,)``
    :param points: ``(n, 2)``, its tasks in flying order
    :param end: ``(2,)``
    :param maximum: How far it can fly
    :param service: What serving its tasks costs
    :param unit: How far the UAV can fly that flies farthest
    :param ranges_differ: Whether the others may fly less
    """

    start: np.ndarray
    points: np.ndarray
    end: np.ndarray
    maximum: float
    service: float
    unit: float
    ranges_differ: bool

    @classmethod
    def of(cls, instance: Instances, uav: int, route: Sequence[int]) -> Flight:
        """
        :param instance: A batch of one
        :param uav: Number of the UAV
        :param route: Its tasks
        :return: Its flight
        """
        # A faulty schedule, with more routes than UAVs, is drawn too.
        row = min(uav, instance.n_uavs - 1)
        start, end, maximum = (of_uav[0, row] for of_uav in (instance.uav_start, instance.uav_end, instance.uav_distance))
        tasks = list(route)
        service = 0.0 if instance.service is None else float(instance.service[0, tasks].sum())
        points = instance.tasks[0].numpy()[tasks]
        differ = instance.max_distance.dim() == 2
        return cls(start.numpy(), points, end.numpy(), float(maximum), service, float(instance.unit[0]), differ)

    def path(self, stage: Stage) -> np.ndarray:
        """``(n, 2)``, where it has flown; a UAV without tasks that cannot reach its end stays where it is."""
        stops = [self.start, self.points]
        return np.vstack(stops if stage is not Stage.FINISHED or self.is_grounded else [*stops, self.end])

    @property
    def is_grounded(self) -> bool:
        if len(self.points) > 0:
            return False
        return not np.linalg.norm(self.end - self.start) <= self.maximum * (1 + DISTANCE_TOLERANCE)

    def distances(self, stage: Stage) -> str:
        """Its distances, for the legend."""
        if self.is_grounded:
            return "cannot reach its end"
        length = 0.0
        if stage is not Stage.ASSIGNING:
            length = float(np.linalg.norm(np.diff(self.path(stage), axis=0), axis=1).sum()) + self.service
        if stage is Stage.FINISHED:
            own = f" of {_rounded(self.maximum, self.unit)}" if self.ranges_differ else ""
            return f"length {_rounded(length, self.unit)}{own}"
        # Rounding may leave less than nothing.
        return f"{_rounded(max(self.maximum - length, 0.0), self.unit)} left"

    def own_sites(self, depot: np.ndarray) -> dict[str, np.ndarray]:
        """
        :param depot: ``(2,)``
        :return: Where it starts and ends, by what it is called, as far as that is not the depot
        """
        if np.array_equal(self.start, self.end):
            sites = {_BOTH: self.start}
        else:
            sites = {_START: self.start, _END: self.end}
        return {kind: point for kind, point in sites.items() if not np.array_equal(point, depot)}


def _site_kinds(flights: Sequence[Flight], depot: np.ndarray) -> list[str]:
    """What the legend says of starts and ends, in the order of :data:`_SITES`."""
    found = {kind for flight in flights for kind in flight.own_sites(depot)}
    return [kind for kind in _SITES if kind in found]


def _named_uavs(routes: Sequence[Sequence[int]]) -> set[int]:
    """The UAVs to name in the legend: all of a small fleet, the first busy ones of a large one."""
    if len(routes) <= _MAX_UAVS_NAMED:
        return set(range(len(routes)))
    return set(itertools.islice((uav for uav, route in enumerate(routes) if len(route) > 0), _MAX_UAVS_NAMED))


def _rounded(distance: float, maximum: float) -> str:
    """Two decimals if the maximum flight distance is of ordinary magnitude, otherwise three significant digits."""
    return f"{distance:.2f}" if 0.1 <= maximum < 1e6 else f"{distance:.3g}"


def _set_limits(axes: Any, points: np.ndarray) -> None:
    """Show a square around the points, without ticks."""
    low, high = points.min(0), points.max(0)
    # Any size will do for a single point.
    half = _BORDER * float((high - low).max() or 1.0) / 2
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim), (low + high) / 2, strict=True):
        set_limits(middle - half, middle + half)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])


def _counted(n_tasks: int) -> str:
    return f"{n_tasks} task" if n_tasks == 1 else f"{n_tasks} tasks"


class MapFigure:
    """
    A figure that is redrawn at every step.

    :param interactive: Whether to open a window; without a display, nothing is shown and a warning is logged once
    """

    def __init__(self, interactive: bool = False) -> None:
        matplotlib = require_matplotlib()
        self.interactive = interactive
        if interactive:
            import matplotlib.pyplot as plt

            if matplotlib.get_backend().lower() in {"agg", "pdf", "svg", "ps", "cairo", "template"}:
                logger.warning("No display was found, so render_mode='human' shows nothing; use render_mode='rgb_array'.")
                self.interactive = False
        if self.interactive:
            self.figure = plt.figure(figsize=(_FIGURE_WIDTH, FIGURE_HEIGHT))
        else:
            self.figure = matplotlib.figure.Figure(figsize=(_FIGURE_WIDTH, FIGURE_HEIGHT), dpi=100)
        self.axes = self.figure.add_subplot()

    def draw(self, episodes: Episodes, row: int) -> None:
        """
        Replace what is drawn.

        :param episodes: Running episodes
        :param row: Index of the episode to draw
        """
        self.draw_routes(episodes.instances[row], episodes.routes(row), episodes.stage(row))

    def draw_routes(self, instance: Instances, routes: Sequence[Sequence[int]], stage: Stage, title: str = "") -> None:
        """
        Replace what is drawn.

        :param instance: A batch of one
        :param routes: Task indices from 0 per UAV
        :param stage: Stage of the episode
        :param title: Title of the map
        """
        self.axes.clear()
        draw_map(self.axes, instance, 0, routes, title, stage)
        # Not tight_layout, which starts from the last layout and cuts off long legends.
        legend = 2 * _MARGIN + LEGEND_LINE_HEIGHT * legend_lines(routes, instance)
        self.figure.subplots_adjust(
            left=_MARGIN / _FIGURE_WIDTH,
            right=1 - _MARGIN / _FIGURE_WIDTH,
            bottom=legend / FIGURE_HEIGHT,
            top=1 - (_MARGIN + (_TITLE_HEIGHT if title else 0.0)) / FIGURE_HEIGHT,
        )
        self.axes.set_anchor("N")

    def rgb_array(self) -> np.ndarray:
        """``(height, width, 3)`` uint8."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def show(self) -> None:
        """Update the window."""
        if self.interactive:
            import matplotlib.pyplot as plt

            plt.pause(0.001)

    def close(self) -> None:
        """Close the window."""
        if self.interactive:
            import matplotlib.pyplot as plt

            plt.close(self.figure)

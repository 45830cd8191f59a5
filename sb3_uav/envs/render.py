"""Maps of schedules and of running episodes. matplotlib is imported when it is first used."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_uav.common.optional import install_command
from sb3_uav.envs.episodes import Episodes
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Stage

logger = logging.getLogger(__name__)

# Okabe and Ito's palette, readable with color-vision deficiencies.
UAV_COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C6D31", "#000000")

# Legend entries of the tasks that are on no route.
_REMAINING_TASKS = {Stage.ASSIGNING: "not yet assigned", Stage.FLYING: "not yet visited", Stage.FINISHED: "skipped"}
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
    Draw a square map of the depot, the tasks of each UAV in its color, and the other tasks as hollow circles.

    Tours are closed if the episode is finished, and end at the UAV's position while it flies. While tasks are being assigned
    there are no tours to draw.

    :param axes: matplotlib axes
    :param instances: The instances
    :param row: Index of the instance
    :param routes: Task indices from 0 per UAV
    :param title: Title of the axes
    :param stage: Stage of the episode
    """
    depot = instances.depot[row].numpy()
    tasks = instances.tasks[row][instances.task_mask[row]].numpy()
    maximum = float(instances.max_distance[row])
    named = _named_uavs(routes)
    for uav, route in enumerate(routes):
        if len(route) == 0 and uav not in named:
            continue
        color = UAV_COLORS[uav % len(UAV_COLORS)]
        points = tasks[list(route)]
        label = f"UAV {uav + 1}: {_counted(len(points))}, {_distances(depot, points, maximum, stage)}"
        label = label if uav in named else "_nolegend_"
        if stage is not Stage.ASSIGNING:
            path = np.vstack([depot, points, depot] if stage is Stage.FINISHED else [depot, points])
            axes.plot(*path.T, color=color, linewidth=1.4, zorder=3, label=label)
            label = "_nolegend_"
        axes.scatter(*points.T, s=22, color=color, zorder=4, label=label)
        if stage is Stage.FLYING:
            axes.scatter(*path[-1], marker="^", s=70, facecolors="none", edgecolors=color, linewidths=1.6, zorder=6)
    if len(named) < len(routes):
        axes.scatter([], [], s=0, label=f"{len(routes) - len(named)} more UAVs")
    axes.scatter(*depot, marker="s", s=70, color="black", zorder=5, label=f"depot (D = {_rounded(maximum, maximum)})")
    visited = {task for route in routes for task in route}
    hollow = [task for task in range(len(tasks)) if task not in visited]
    circles = dict(s=22, facecolors="none", edgecolors="0.55", linewidths=0.9, zorder=2)
    axes.scatter(*tasks[hollow].T, **circles, label=f"{_counted(len(hollow))} {_REMAINING_TASKS[stage]}")
    _set_limits(axes, np.vstack([depot, tasks]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=_LEGEND_COLUMNS, fontsize=8, frameon=False)
    if title:
        axes.set_title(title, fontsize=11)


def legend_lines(routes: Sequence[Sequence[int]]) -> int:
    """
    :param routes: Task indices per UAV
    :return: Number of lines of the legend that :func:`draw_map` puts below the map
    """
    named = len(_named_uavs(routes))
    # Depot and hollow tasks have entries too.
    return math.ceil((named + (named < len(routes)) + 2) / _LEGEND_COLUMNS)


def _named_uavs(routes: Sequence[Sequence[int]]) -> set[int]:
    """The UAVs to name in the legend: all of a small fleet, the first busy ones of a large one."""
    if len(routes) <= _MAX_UAVS_NAMED:
        return set(range(len(routes)))
    return set(itertools.islice((uav for uav, route in enumerate(routes) if len(route) > 0), _MAX_UAVS_NAMED))


def _distances(depot: np.ndarray, points: np.ndarray, maximum: float, stage: Stage) -> str:
    """The distances of a UAV, for the legend."""
    path = np.vstack([depot, points, depot] if stage is Stage.FINISHED else [depot, points])
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) if stage is not Stage.ASSIGNING else 0.0
    if stage is Stage.FINISHED:
        return f"length {_rounded(length, maximum)}"
    # Rounding may leave less than nothing.
    return f"{_rounded(max(maximum - length, 0.0), maximum)} left"


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
        legend = 2 * _MARGIN + LEGEND_LINE_HEIGHT * legend_lines(routes)
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

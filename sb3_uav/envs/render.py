"""Drawing a schedule on a map; the only module of the environments that needs matplotlib, imported when first used."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_uav.common.optional import install_command
from sb3_uav.envs.instances import Instances

logger = logging.getLogger(__name__)

# Okabe and Ito's palette, readable with colour-vision deficiencies.
UAV_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C6D31", "#000000")

# Sides of the map, in units of the points' extent.
BORDER = 1.08
MARGINS = {"left": 0.1, "right": 0.9, "bottom": 0.1, "top": 0.9}


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


def draw_map(axes: Any, instances: Instances, row: int, routes: Sequence[Sequence[int]], title: str = "") -> None:
    """
    Draw depot, tours coloured by UAV, and skipped tasks as hollow circles, on a square of the plane that holds all points.

    :param axes: matplotlib axes
    :param instances: The instances
    :param row: Which of them
    :param routes: Task indices from 0 per UAV
    :param title: Title of the axes
    """
    depot = instances.depot[row].numpy()
    tasks = instances.tasks[row][instances.task_mask[row]].numpy()
    visited = {task for route in routes for task in route}
    skipped = [task for task in range(len(tasks)) if task not in visited]
    for uav, route in enumerate(routes):
        colour = UAV_COLOURS[uav % len(UAV_COLOURS)]
        path = np.vstack([depot, tasks[list(route)], depot])
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        label = f"UAV {uav + 1}: {_counted(len(route))}, length {length:.2f}"
        axes.plot(*path.T, color=colour, linewidth=1.4, zorder=3, label=label)
        axes.scatter(*path[1:-1].T, s=22, color=colour, zorder=4)
    axes.scatter(*depot, marker="s", s=70, color="black", zorder=5, label="depot")
    hollow = dict(s=22, facecolors="none", edgecolors="0.55", linewidths=0.9, zorder=2)
    axes.scatter(*tasks[skipped].T, **hollow, label=f"{_counted(len(skipped))} skipped")
    points = np.vstack([depot, tasks])
    low, high = points.min(0), points.max(0)
    # Of one point, any square will do.
    half = BORDER * float((high - low).max() or 1.0) / 2
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim), (low + high) / 2, strict=True):
        set_limits(middle - half, middle + half)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=2, fontsize=8, frameon=False)
    if title:
        axes.set_title(title, fontsize=11)


def _counted(n_tasks: int) -> str:
    return f"{n_tasks} task" if n_tasks == 1 else f"{n_tasks} tasks"


class MapFigure:
    """
    A figure that is drawn again at every step.

    :param interactive: Whether to open a window; without a display nothing is shown, and that is said once
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
            self.figure = plt.figure(figsize=(5, 5.6))
        else:
            self.figure = matplotlib.figure.Figure(figsize=(5, 5.6), dpi=100)
        self.axes = self.figure.add_subplot()

    def draw(self, instances: Instances, row: int, routes: Sequence[Sequence[int]]) -> None:
        """Replace what is drawn; see :func:`draw_map`."""
        self.axes.clear()
        draw_map(self.axes, instances, row, routes)
        # tight_layout starts from the last layout: without a fresh start the same map would look different the second time.
        self.figure.subplots_adjust(**MARGINS)
        self.figure.tight_layout()

    def rgb_array(self) -> np.ndarray:
        """``(height, width, 3)`` uint8."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def show(self) -> None:
        """Bring the window up to date."""
        if self.interactive:
            import matplotlib.pyplot as plt

            plt.pause(0.001)

    def close(self) -> None:
        """Close the window."""
        if self.interactive:
            import matplotlib.pyplot as plt

            plt.close(self.figure)

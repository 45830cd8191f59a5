"""Schedules drawn on a map, one or several side by side (paper, Fig. 3)."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.render import draw_map, legend_lines
from sb3_uav.envs.schedule import Schedule
from sb3_uav.plots.figure_files import checked_path, new_figure, save_figure

_PANEL_WIDTH, PANEL_HEIGHT = 4.8, 5.0
_LEGEND_LINE_HEIGHT = 0.2
_MAX_COLUMNS = 4


class MapPanel(NamedTuple):
    """
    One map of a figure.

    :param instances: The instances
    :param row: Index of the instance
    :param schedule: What to draw
    :param title: Title of the panel
    """

    instances: Instances
    row: int
    schedule: Schedule
    title: str = ""


def plot_schedule(instances: Instances, row: int, schedule: Schedule, path: str | os.PathLike[str], title: str = "") -> None:
    """
    Draw one schedule: the depot, tours colored by UAV, skipped tasks hollow, tasks that must be served as stars, counts and
    lengths in the legend.

    :param instances: The instances
    :param row: Index of the instance
    :param schedule: The schedule
    :param path: The ``.png``, ``.pdf`` or ``.svg`` to write
    :param title: Title of the figure
    :raises ValueError: If the file has another suffix
    :raises ImportError: If matplotlib is not installed
    """
    plot_schedules([MapPanel(instances, row, schedule, title)], path)


def plot_schedules(panels: Sequence[MapPanel], path: str | os.PathLike[str]) -> None:
    """
    Draw several schedules side by side, :data:`_MAX_COLUMNS` in a row.

    :param panels: What to draw
    :param path: The ``.png``, ``.pdf`` or ``.svg`` to write
    :raises ValueError: If there are no panels, or the file has another suffix
    :raises ImportError: If matplotlib is not installed
    """
    path = checked_path(path)
    save_figure(schedules_figure(panels), path)


def schedules_figure(panels: Sequence[MapPanel], n_columns: int = _MAX_COLUMNS) -> Any:
    """
    :param panels: What to draw
    :param n_columns: Number of panels in a row
    :return: A matplotlib figure
    :raises ValueError: If there are no panels
    :raises ImportError: If matplotlib is not installed
    """
    if not panels:
        raise ValueError("There is nothing to draw: give at least one panel.")
    n_columns = min(len(panels), n_columns)
    n_lines = math.ceil(len(panels) / n_columns)
    maps = [panel.instances[panel.row].to("cpu") for panel in panels]
    lines = max(legend_lines(panel.schedule.routes, instance) for panel, instance in zip(panels, maps, strict=True))
    height = PANEL_HEIGHT + _LEGEND_LINE_HEIGHT * lines
    figure = new_figure(_PANEL_WIDTH * n_columns, height * n_lines)
    grid = figure.subplots(n_lines, n_columns, squeeze=False).flatten()
    for axes, panel, instance in zip(grid, panels, maps, strict=False):
        draw_map(axes, instance, 0, panel.schedule.routes, panel.title)
        # Extra vertical space goes to the legend.
        axes.set_anchor("N")
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    return figure

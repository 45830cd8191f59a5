"""Figures 3 to 7, drawn from the tables in the CSV files beside them."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.render import require_matplotlib
from sb3_uav.envs.schedule import Schedule
from sb3_uav.evaluation.summary import gaps
from sb3_uav.plots.figure_files import new_figure
from sb3_uav.plots.schedule_map import MapPanel, schedules_figure
from sb3_uav.plots.style import MARKERS, MAX_MARKERS, ORANGE, PURPLE, SERIES_COLORS, VERMILION, style_axes
from sb3_uav.reproduce.paper import SIZES
from sb3_uav.reproduce.table_formats import MISSING, Table

_MAPS_PER_LINE = 3
DEPOT = "depot"
UPPER_LEVEL, LOWER_LEVEL = "Upper level", "Lower level"
SCHEDULE_COLUMNS = ("Situation", "Point", "x", "y", "Maximum distance", "UAV", "Stop")
CURVE_COLUMNS = ("Training", "Level", "Epoch", "Phase", "Cost", "Minutes")


def is_pair(name: str) -> bool:
    """
    :param name: A row of Figs. 6 and 7
    :return: Whether it is the label of a pair, not the name of a method
    """
    return re.fullmatch(r"universal|mixture|U\d+(-\d+)?", name) is not None


class _Curve(NamedTuple):
    """
    :param cost: ``(n_epochs,)``, minus the mean objective of the training episodes
    :param minutes: ``(n_epochs,)``, time since the beginning of the training
    :param n_pretraining: Number of epochs of pre-training
    :param epochs: ``(n_epochs,)``, their numbers
    """

    cost: np.ndarray
    minutes: np.ndarray
    n_pretraining: int
    epochs: np.ndarray


def _draw_schedules(table: Table) -> Any:
    """
    Fig. 3.

    :param table: A row for each depot and task; the UAVs' numbers and stops begin with 1, and skipped tasks have neither
    :return: A matplotlib figure
    """
    panels = []
    for situation in dict.fromkeys(row[0] for row in table.rows):
        rows = [row for row in table.rows if row[0] == situation]
        (depot,) = (row for row in rows if row[1] == DEPOT)
        tasks = [row for row in rows if row[1] != DEPOT]
        n_uavs = int(situation[1:].partition("-")[0])
        instances = Instances.from_arrays(
            depot=np.array([depot[2:4]], dtype=np.float64),
            tasks=np.array([[row[2:4] for row in tasks]], dtype=np.float64),
            max_distance=float(depot[4]),
            n_uavs=n_uavs,
        )
        routes = []
        for uav in range(1, n_uavs + 1):
            stops = {int(row[6]): task for task, row in enumerate(tasks) if row[5] == str(uav)}
            routes.append([stops[stop] for stop in sorted(stops)])
        title = f"{situation}: {sum(map(len, routes))} of {len(tasks)} tasks"
        panels.append(MapPanel(instances, 0, Schedule(routes), title))
    return schedules_figure(panels, _MAPS_PER_LINE)


def _read_curves(table: Table) -> dict[str, dict[str, _Curve]]:
    """
    :param table: A row for each epoch of each level
    :return: The curves by training and level
    """
    curves: dict[str, dict[str, _Curve]] = {}
    for training, level in dict.fromkeys((row[0], row[1]) for row in table.rows):
        rows = [row for row in table.rows if row[:2] == [training, level]]
        cost, minutes = (np.array([float(row[column]) for row in rows]) for column in (4, 5))
        n_pretraining = sum(row[3] == "pre-training" for row in rows)
        curves.setdefault(training, {})[level] = _Curve(cost, minutes, n_pretraining, np.array([int(row[2]) for row in rows]))
    return curves


def _draw_learning_curves(table: Table) -> Any:
    """
    Fig. 4.

    :param table: A row for each epoch of each level; the trainings are named after their scenarios
    :return: A matplotlib figure
    """
    curves = _read_curves(table)
    # One training may be for all situations, of which there are evaluations of both levels together.
    fleets = sorted({name.partition("-")[0] for name in curves})
    figure = new_figure(5.5 * max(len(fleets), 2), 7.0)
    colors = defaultdict(lambda: SERIES_COLORS[0], zip(map(str, SIZES), _shades(len(SIZES)), strict=True))
    grid = figure.subplots(2, len(fleets), squeeze=False)
    for line, level in zip(grid, (UPPER_LEVEL, LOWER_LEVEL), strict=True):
        for axes, fleet in zip(line, fleets, strict=True):
            mine = {name: levels[level] for name, levels in curves.items() if name.startswith(fleet) and level in levels}
            if not mine:
                axes.set_axis_off()
                continue
            style_axes(axes, f"{fleet}: {level.lower()}", "epoch", "cost")
            for name, curve in mine.items():
                look = {"color": colors[name.partition("-")[2]], "label": name}
                axes.plot(curve.epochs, curve.cost, linewidth=1.5, **look, **_markers(len(curve.epochs), 0))
            n_pretraining = max((curve.n_pretraining for curve in mine.values()), default=0)
            if n_pretraining > 0:
                axes.axvline(n_pretraining + 0.5, color="0.4", linestyle=":", linewidth=1.2)
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.legend(fontsize=8.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw_ablation(table: Table) -> Any:
    """
    Fig. 5.

    :param table: A row for each epoch of each level; the trainings are named after their strategies. Of several seeds, the
        mean is drawn, and the range
    :return: A matplotlib figure
    """
    figure = new_figure(11.0, 4.2)
    left, right = figure.subplots(1, 2, sharey=True)
    style_axes(left, "by epoch", "epoch of the upper level", "cost")
    style_axes(right, "by training time", "minutes", "")
    titles = [column.title for column in table.columns]
    # Earlier versions had one training of each strategy.
    seeds = [row[titles.index("Seed")] for row in table.rows] if "Seed" in titles else [""] * len(table.rows)
    for position, strategy in enumerate(dict.fromkeys(row[0] for row in table.rows)):
        runs = []
        for seed in dict.fromkeys(s for s, row in zip(seeds, table.rows, strict=True) if row[0] == strategy):
            rows = [row for s, row in zip(seeds, table.rows, strict=True) if (s, row[0]) == (seed, strategy)]
            runs.append(_read_curves(replace(table, rows=rows))[strategy][UPPER_LEVEL])
        look = {
            "color": SERIES_COLORS[position],
            "linewidth": 1.5,
            "label": f"{strategy} (ours)" if strategy == "ITS" else strategy,
        }
        n_epochs = min(len(run.cost) for run in runs)
        costs, minutes = (
            np.stack([values[:n_epochs] for values in v]) for v in ([r.cost for r in runs], [r.minutes for r in runs])
        )
        look |= _markers(n_epochs, position)
        epochs = np.arange(1, n_epochs + 1)
        for axes, x in ((left, epochs), (right, minutes.mean(0))):
            axes.plot(x, costs.mean(0), **look)
            if len(runs) > 1:
                axes.fill_between(x, costs.min(0), costs.max(0), color=look["color"], alpha=0.15, linewidth=0)
    left.xaxis.get_major_locator().set_params(integer=True)
    right.set_xlim(left=0)
    right.legend(fontsize=8.5, frameon=False, loc="upper right")
    return figure


def _draw_generalization(table: Table) -> Any:
    """
    Figs. 6 and 7.

    :param table: A row for each method, a column for each problem; pairs are named after their fleet
    :return: A matplotlib figure
    """
    figure = new_figure(11.5, 4.6)
    left, right = figure.subplots(1, 2)
    style_axes(left, "Objective", "problem", "tasks completed (mean)")
    style_axes(right, "Gap to the best of these methods", "problem", "gap (%)")
    problems = [column.title for column in table.columns[1:]]
    values = np.array([[np.nan if cell == MISSING else float(cell) for cell in row[1:]] for row in table.rows])
    shortfalls = np.array([gaps(column) for column in values.T.tolist()]).T
    trained = [row[0] for row in table.rows if is_pair(row[0])]
    shades = iter(_shades(len(trained)))
    others = cycle((VERMILION, PURPLE, ORANGE, "0.5"))
    for position, row in enumerate(table.rows):
        ours = row[0] in trained
        look = {"color": next(shades) if ours else next(others), "linestyle": "-" if ours else (0, (4, 2))}
        look |= {"marker": MARKERS[position % len(MARKERS)], "markersize": 5, "linewidth": 1.5, "label": row[0]}
        left.plot(range(len(problems)), values[position], **look)
        right.plot(range(len(problems)), shortfalls[position], **look)
    for axes in (left, right):
        axes.set_xticks(range(len(problems)), problems)
    right.legend(fontsize=8.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _shades(n: int) -> list[Any]:
    """``n`` colors of one scale, for ordered categories."""
    return [require_matplotlib().colormaps["viridis"](position) for position in np.linspace(0.0, 0.9, n)]


def _markers(n_points: int, position: int) -> dict[str, Any]:
    """Marker settings, empty where markers would hide the line."""
    return {"marker": MARKERS[position % len(MARKERS)], "markersize": 4} if n_points <= MAX_MARKERS else {}


# What each figure is drawn from (the stem of its CSV) and how.
DRAWINGS: Mapping[str, tuple[str, Callable[[Table], Any]]] = {
    "fig3": ("fig3_schedules", _draw_schedules),
    "fig4": ("fig4_curves", _draw_learning_curves),
    "fig5": ("fig5_curves", _draw_ablation),
    "fig6": ("fig6", _draw_generalization),
    "fig7": ("fig7", _draw_generalization),
}

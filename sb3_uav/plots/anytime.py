"""Objective against time, all solvers in one panel, from an evaluation at several time limits."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.statistics import confidence_halfwidth
from sb3_uav.envs.render import require_matplotlib
from sb3_uav.evaluation.results import OK, RESULTS_FILE, ResultRow, read_results
from sb3_uav.plots.figure_files import checked_path, new_figure, save_figure
from sb3_uav.plots.style import DASHED, MARKERS, SERIES_COLORS, style_axes

PANEL_WIDTH, PANEL_HEIGHT = 7.2, 4.4
_LEGEND_WIDTH = 34
_FOOTNOTE = "Bands and bars: 95 % confidence of the shortfall from the best objective found on the same instance"


class Curve(NamedTuple):
    """
    The results of one solver on one set of instances.

    :param solver: Name of the solver
    :param seconds: ``(n_points,)``, mean wall time per instance, in ascending order
    :param objective: ``(n_points,)``, mean objective, or another mean
    :param halfwidth: ``(n_points,)``, half of its confidence interval
    :param batch_size: How many instances were solved at once
    """

    solver: str
    seconds: np.ndarray
    objective: np.ndarray
    halfwidth: np.ndarray
    batch_size: int


class Panel(NamedTuple):
    """
    :param source: Name of the set of instances
    :param n_instances: Number of instances
    :param curves: One per solver
    :param left_out: Solvers, with their time limits, that did not solve all instances
    """

    source: str
    n_instances: int
    curves: list[Curve]
    left_out: list[str]


def plot_anytime(
    results: str | os.PathLike[str],
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    solvers: Sequence[str] | None = None,
) -> list[Path]:
    """
    Draw the mean objective of every solver against its mean wall time, a panel for each set of instances.

    A solver that ran with several time limits is a curve, with a separate run for each point, at the time that it actually
    took. A solver that ran with one or none is a point with a dashed line to its right. With several seeds, the mean is drawn.
    Bands and bars are 95 % confidence intervals, over the instances, of the shortfall from the best objective that any solver
    found on the same instance: differences between instances do not count.

    :param results: Folder that :func:`~sb3_uav.evaluation.run.evaluate` wrote
    :param paths: The ``.png``, ``.pdf`` or ``.svg`` to write, or several
    :param solvers: Names of the solvers to draw; all when None
    :return: The paths
    :raises FileNotFoundError: If there is no ``results.csv`` in the folder
    :raises ValueError: If it holds nothing to draw or is damaged, a suffix is not allowed, or a solver is unknown
    :raises ImportError: If matplotlib is not installed
    """
    checked = [checked_path(path) for path in ([paths] if isinstance(paths, str | os.PathLike) else paths)]
    file = Path(results) / RESULTS_FILE
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; give the folder that `sb3-uav evaluate` wrote.")
    rows = read_results(file)
    known = _unique(row.solver for row in rows)
    for solver in solvers or ():
        if solver not in known:
            raise ValueError(f"{file}: has no results of {solver!r}; choose some of {known}.")
    panels = _anytime_panels([row for row in rows if solvers is None or row.solver in solvers])
    if not any(panel.curves for panel in panels):
        raise ValueError(f"{file}: no solver has solved all instances of a set; there is nothing to draw.")
    numbers = {solver: number for number, solver in enumerate(known)}
    figure = new_figure(PANEL_WIDTH, PANEL_HEIGHT * len(panels))
    for axes, panel in zip(figure.subplots(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        draw_panel(axes, panel, numbers)
    figure.supxlabel(_FOOTNOTE, fontsize=7.5, color="0.4")
    for path in checked:
        save_figure(figure, path)
    return checked


def _anytime_panels(rows: Sequence[ResultRow]) -> list[Panel]:
    """
    :param rows: Results of an evaluation
    :return: What to draw, in the order of the results
    """
    return [_panel([row for row in rows if row.source == source]) for source in _unique(row.source for row in rows)]


def _panel(rows: Sequence[ResultRow]) -> Panel:
    """
    :param rows: Results of one set of instances
    :return: Its panel
    """
    instances = sorted({row.instance for row in rows})
    runs: dict[tuple[str, float | None], list[ResultRow]] = {}
    for row in rows:
        runs.setdefault((row.solver, row.time_limit), []).append(row)
    objectives: dict[tuple[str, float | None], np.ndarray] = {}
    limits: dict[str, list[str]] = {}
    for (solver, time_limit), found in runs.items():
        if {row.instance for row in found if row.status == OK} == set(instances):
            objectives[solver, time_limit] = _per_instance(found, instances)
        else:
            limits.setdefault(solver, []).extend([] if time_limit is None else [f"{time_limit:g} s"])
    left_out = [f"{solver} ({', '.join(given)})" if given else solver for solver, given in limits.items()]
    best = np.max(list(objectives.values()), axis=0) if objectives else np.zeros(len(instances))
    curves = []
    for solver in _unique(solver for solver, _ in objectives):
        keys = [key for key in objectives if key[0] == solver]
        points = sorted(
            (_mean_seconds(runs[key]), float(objectives[key].mean()), confidence_halfwidth(best - objectives[key]))
            for key in keys
        )
        seconds, objective, halfwidth = np.array(points).T
        batch_size = max(row.batch_size or 1 for key in keys for row in runs[key])
        curves.append(Curve(solver, seconds, objective, halfwidth, batch_size))
    return Panel(rows[0].source, len(instances), curves, left_out)


def _per_instance(rows: Sequence[ResultRow], instances: Sequence[int]) -> np.ndarray:
    """Objective of every instance, ``(n_instances,)``; the mean over the seeds."""
    found: dict[int, list[float]] = {instance: [] for instance in instances}
    for row in rows:
        if row.objective is not None:
            found[row.instance].append(row.objective)
    return np.array([math.fsum(values) / len(values) for values in found.values()])


def _mean_seconds(rows: Sequence[ResultRow]) -> float:
    seconds = [row.seconds for row in rows if row.status == OK and row.seconds is not None]
    return math.fsum(seconds) / len(seconds)


def _unique(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _solver_style(number: int) -> dict[str, str]:
    """
    :param number: Number of a solver
    :return: Its color and marker; solvers after the eighth reuse the colors with other markers
    """
    n_colors = len(SERIES_COLORS)
    return {"color": SERIES_COLORS[number % n_colors], "marker": MARKERS[(number + number // n_colors) % len(MARKERS)]}


def draw_panel(
    axes: Any, panel: Panel, numbers: dict[str, int], label: str = "objective (mean)", less_is_better: bool = False
) -> None:
    """
    :param axes: matplotlib axes
    :param panel: What to draw
    :param numbers: Number of every solver, which determines its color and marker
    :param label: What the curves show
    :param less_is_better: Whether the lowest curve is the best
    """
    ticker = require_matplotlib().ticker
    title = f"{panel.source}: {panel.n_instances} instances"
    style_axes(axes, title, "seconds per instance (mean)", label, "both")
    axes.set_xscale("log")
    times = np.concatenate([curve.seconds for curve in panel.curves]) if panel.curves else np.ones(1)
    # Leave room on both sides of a single point, and for the dashed lines.
    axes.set_xlim(times.min() / 2, times.max() * 2)
    # With few decades, label steps between them too.
    few = times.max() < 100 * times.min()
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axes.xaxis.set_minor_formatter(ticker.NullFormatter())
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda seconds, _: f"{seconds:g}"))
    # The legend lists the best solver first, as in the panel.
    sign = 1 if less_is_better else -1
    for curve in sorted(panel.curves, key=lambda curve: float((sign * curve.objective).min())):
        look = _solver_style(numbers[curve.solver])
        name = textwrap.fill(curve.solver.replace(",", ", "), _LEGEND_WIDTH, break_on_hyphens=False)
        entry = name if curve.batch_size == 1 else f"{name}\n(batches of {curve.batch_size})"
        low, high = curve.objective - curve.halfwidth, curve.objective + curve.halfwidth
        if len(curve.seconds) > 1:
            axes.plot(curve.seconds, curve.objective, **look, linewidth=1.6, markersize=5, label=entry)
            axes.fill_between(curve.seconds, low, high, color=look["color"], alpha=0.15, linewidth=0)
        else:
            until = axes.get_xlim()[1]
            axes.plot(curve.seconds, curve.objective, **look, linestyle="none", markersize=6, label=entry)
            axes.hlines(curve.objective, curve.seconds, until, color=look["color"], linestyle=DASHED, linewidth=1.2)
            axes.vlines(curve.seconds, low, high, color=look["color"], linewidth=1.2)
    if panel.curves:
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8.5, frameon=False, borderaxespad=0.0)
    if panel.left_out:
        text = textwrap.fill(f"Did not solve all instances: {'; '.join(panel.left_out)}", 100)
        axes.text(0.0, -0.16, text, transform=axes.transAxes, fontsize=7.5, color="0.4", va="top")

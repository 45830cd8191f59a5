"""Gap to best-known values against time, all solvers in one panel, from a benchmark run at several time limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_uav.common.statistics import confidence_halfwidth
from sb3_uav.evaluation.benchmarks.gaps import GapRow
from sb3_uav.plots.anytime import PANEL_HEIGHT, PANEL_WIDTH, Curve, Panel, draw_panel
from sb3_uav.plots.figure_files import checked_path, new_figure, save_figure

_FOOTNOTE = "Bands and bars: 95 % confidence of the mean over the instances"


def plot_gaps(rows: Sequence[GapRow], path: Path, title: str = "Benchmark") -> Path:
    """
    Draw the mean gap of every solver against its mean wall time, over the instances that have a best-known value.

    A solver that has no objective for one of them is left out at that time limit, and named below the panel.

    :param rows: Gaps of all solvers and time limits
    :param path: The ``.png``, ``.pdf`` or ``.svg`` to write
    :param title: Name of the benchmark
    :return: The path
    :raises ValueError: If there is nothing to draw, or the suffix is not allowed
    :raises ImportError: If matplotlib is not installed
    """
    path = checked_path(path)
    known = [row for row in rows if row.best_known is not None]
    panel = _gap_panel(known, title)
    if not panel.curves:
        raise ValueError(f"{path}: no solver has solved all instances; there is nothing to draw.")
    numbers = {solver: number for number, solver in enumerate(dict.fromkeys(row.solver for row in known))}
    figure = new_figure(PANEL_WIDTH, PANEL_HEIGHT)
    draw_panel(figure.subplots(), panel, numbers, "gap to best known, % (mean)", less_is_better=True)
    figure.supxlabel(_FOOTNOTE, fontsize=7.5, color="0.4")
    save_figure(figure, path)
    return path


def _gap_panel(rows: Sequence[GapRow], title: str) -> Panel:
    """
    :param rows: Gaps on instances with a best-known value
    :param title: Name of the benchmark
    :return: What to draw
    """
    instances = list(dict.fromkeys(row.instance for row in rows))
    runs: dict[str, dict[float | None, list[GapRow]]] = {}
    for row in rows:
        runs.setdefault(row.solver, {}).setdefault(row.time_limit, []).append(row)
    curves, left_out = [], []
    for solver, by_limit in runs.items():
        points, missing = [], []
        for time_limit, found in by_limit.items():
            gaps = [[row.gap for row in found if row.instance == name and row.gap is not None] for name in instances]
            if not all(gaps):
                missing += [] if time_limit is None else [f"{time_limit:g} s"]
                continue
            per_instance = np.array([math.fsum(values) / len(values) for values in gaps])
            mean_seconds = np.mean([row.seconds for row in found if row.seconds is not None])
            points.append((float(mean_seconds), float(per_instance.mean()), float(confidence_halfwidth(per_instance))))
        if len(points) < len(by_limit):
            left_out.append(f"{solver} ({', '.join(missing)})" if missing else solver)
        if points:
            seconds, means, halfwidths = np.array(sorted(points)).T
            batch_size = max(row.batch_size or 1 for found in by_limit.values() for row in found)
            curves.append(Curve(solver, seconds, means, halfwidths, batch_size))
    return Panel(title, len(instances), curves, left_out)

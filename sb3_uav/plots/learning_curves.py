"""Learning curves of both levels from the log of the interactive training strategy (paper, Fig. 4)."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from sb3_uav.plots.figure_files import checked_path, new_figure, save_figure
from sb3_uav.plots.style import GREEN, MAX_MARKERS, ORANGE, SKY_BLUE, style_axes

_LOG_FILE = "its_log.csv"
_LEVELS = ("allocator", "router")
_COLUMNS = {"epoch", "level", "phase", "objective"}
_PHASE_COLORS = {"pre-training": SKY_BLUE, "intensive": ORANGE, "alternate": GREEN}
_SPELLINGS = {"pretraining": "pre-training"}
_LINE_COLOR = "#222222"


class _LoggedEpoch(NamedTuple):
    """
    :param epoch: Number of the epoch of its level, from 1
    :param phase: Phase of the strategy
    :param objective: Mean objective of the training episodes
    """

    epoch: int
    phase: str
    objective: float


def plot_learning_curves(its_log: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """
    Draw the mean objective of every epoch, the allocator above and the router below, phases of the strategy shaded.

    :param its_log: The ``its_log.csv`` of a run, or the folder of the run
    :param path: The ``.png``, ``.pdf`` or ``.svg`` to write
    :raises FileNotFoundError: If there is no such log
    :raises ValueError: If the log has no epochs, misses a column or holds something other than numbers, or the suffix of the
        figure is not allowed
    :raises ImportError: If matplotlib is not installed
    """
    path = checked_path(path)
    epochs = _read_its_log(its_log)
    figure = new_figure(8.0, 6.4)
    titles = ("Upper level (allocator), all UAVs", "Lower level (router), per UAV")
    for axes, level, title in zip(figure.subplots(2, 1), _LEVELS, titles, strict=True):
        _draw_level(axes, title, epochs[level])
    save_figure(figure, path)


def _read_its_log(its_log: str | os.PathLike[str]) -> dict[str, list[_LoggedEpoch]]:
    """
    :param its_log: The ``its_log.csv`` of a run, or the folder of the run
    :return: The epochs of each level, in order; a level may have none
    :raises FileNotFoundError: If there is no such log
    :raises ValueError: If the log has no epochs, misses a column or holds something other than numbers
    """
    its_log = Path(its_log)
    if its_log.is_dir():
        its_log /= _LOG_FILE
    if not its_log.is_file():
        raise FileNotFoundError(f"{its_log}: no such log; give the its_log.csv of a run of the interactive training strategy.")
    epochs: dict[str, list[_LoggedEpoch]] = {level: [] for level in _LEVELS}
    try:
        text = its_log.read_text(encoding="utf-8")
        # Read here, because what is no CSV may stand in any line.
        list(csv.reader(io.StringIO(text, newline="")))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{its_log}: is no CSV in UTF-8 ({error}); copy it again from its run.") from error
    with io.StringIO(text, newline="") as file:
        reader = csv.DictReader(file)
        missing = _COLUMNS - set(reader.fieldnames or ())
        if missing:
            raise ValueError(f"{its_log}: columns {sorted(missing)} are missing; found {reader.fieldnames!s:.200}.")
        for row in reader:
            where = f"{its_log}, line {reader.line_num}"
            if row["level"] not in epochs:
                raise ValueError(f"{where}: level is {row['level']!r:.80}, expected one of {_LEVELS}.")
            phase = _SPELLINGS.get(row["phase"], row["phase"])
            try:
                epochs[row["level"]].append(_LoggedEpoch(int(row["epoch"]), phase, float(row["objective"])))
            except (TypeError, ValueError) as error:
                found = f"{row['epoch']!r:.80} and {row['objective']!r:.80}"
                raise ValueError(f"{where}: epoch and objective must be numbers, found {found}.") from error
    if not any(epochs.values()):
        raise ValueError(f"{its_log}: holds no epochs yet; wait until the first one has finished.")
    return {level: sorted(rows) for level, rows in epochs.items()}


def _draw_level(axes: Any, title: str, epochs: Sequence[_LoggedEpoch]) -> None:
    """
    :param axes: matplotlib axes
    :param title: Title of the panel
    :param epochs: Epochs of one level, in order
    """
    style_axes(axes, title, "epoch", "tasks completed (mean)")
    if not epochs:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no epochs", transform=axes.transAxes, ha="center", va="center", color="0.5")
        return
    labeled: set[str] = set()
    for phase, run in groupby(epochs, key=lambda epoch: epoch.phase):
        numbers = [epoch.epoch for epoch in run]
        if phase not in _PHASE_COLORS:
            continue
        label = None if phase in labeled else phase
        labeled.add(phase)
        axes.axvspan(numbers[0] - 0.5, numbers[-1] + 0.5, color=_PHASE_COLORS[phase], alpha=0.2, linewidth=0, label=label)
    marker = "o" if len(epochs) <= MAX_MARKERS else None
    numbers, objectives = [epoch.epoch for epoch in epochs], [epoch.objective for epoch in epochs]
    axes.plot(numbers, objectives, color=_LINE_COLOR, linewidth=1.5, marker=marker, markersize=4)
    axes.set_xlim(numbers[0] - 0.5, numbers[-1] + 0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if labeled:
        # Above the panel, where the colors are on white as in the panel.
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), fontsize=9, frameon=False, ncols=len(labeled))

"""Learning curves of several algorithms side by side, with confidence bands."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_uav.plots.figure_files import checked_path, new_figure, save_figure
from sb3_uav.plots.style import LINE_STYLES, SERIES_COLORS, style_axes

_PANEL_WIDTH, PANEL_HEIGHT = 5.2, 3.6


class Band(NamedTuple):
    """
    A curve with its uncertainty.

    :param x: ``(n,)``
    :param mean: ``(n,)``
    :param half_width: ``(n,)``, half of the confidence interval; NaN where there is none
    """

    x: np.ndarray
    mean: np.ndarray
    half_width: np.ndarray


class BandPanel(NamedTuple):
    """
    :param x_label: Label of the horizontal axis
    :param y_label: Label of the vertical axis
    :param bands: The curves by name
    """

    x_label: str
    y_label: str
    bands: Mapping[str, Band]


def plot_bands(lines: Sequence[Sequence[BandPanel]], path: str | os.PathLike[str]) -> None:
    """
    Draw curves with bands, with one legend for all panels.

    :param lines: Panels, row by row
    :param path: The ``.png``, ``.pdf`` or ``.svg`` to write
    :raises ValueError: If there is nothing to draw, or the file has another suffix
    :raises ImportError: If matplotlib is not installed
    """
    path = checked_path(path)
    from matplotlib.ticker import EngFormatter

    names = list(dict.fromkeys(name for line in lines for panel in line for name in panel.bands))
    if not names:
        raise ValueError("There is nothing to draw: give at least one curve.")
    figure = new_figure(_PANEL_WIDTH * max(len(line) for line in lines), PANEL_HEIGHT * len(lines) + 0.4)
    grid = figure.subplots(len(lines), max(len(line) for line in lines), squeeze=False)
    for line, row in zip(lines, grid, strict=True):
        for panel, axes in zip(line, row, strict=False):
            for number, name in enumerate(names):
                if name not in panel.bands:
                    continue
                band, color = panel.bands[name], SERIES_COLORS[number % len(SERIES_COLORS)]
                # Dashed as well as colored, because one curve may cover another.
                style = LINE_STYLES[number % len(LINE_STYLES)]
                axes.plot(band.x, band.mean, color=color, linestyle=style, linewidth=1.6, label=name)
                low, high = band.mean - band.half_width, band.mean + band.half_width
                axes.fill_between(band.x, low, high, color=color, alpha=0.2, linewidth=0)
            axes.set_ylim(_visible_range(panel.bands.values()))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            style_axes(axes, "", panel.x_label, panel.y_label, "both")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(names), 4), frameon=False, fontsize=9)
    save_figure(figure, path)


def _visible_range(bands: Collection[Band]) -> tuple[float, float]:
    """
    Visible range of the vertical axis: all bands, but at most three times the range of the curves, because intervals of two or
    three seeds can be so wide that the curves look flat.

    :param bands: The curves of a panel
    :return: Lower and upper end
    """
    lowest, highest = (float(limit([limit(band.mean) for band in bands])) for limit in (np.min, np.max))
    margin = (highest - lowest) or 1.0
    low = min(float(np.nanmin([lowest, *(band.mean - band.half_width)])) for band in bands)
    high = max(float(np.nanmax([highest, *(band.mean + band.half_width)])) for band in bands)
    return max(low, lowest - margin) - 0.05 * margin, min(high, highest + margin) + 0.05 * margin

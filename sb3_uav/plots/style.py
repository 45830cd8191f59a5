"""Colors, markers and axes that all figures share."""

from __future__ import annotations

from typing import Any

from sb3_uav.envs.render import UAV_COLORS

# Okabe and Ito's palette, readable with color-vision deficiencies; the same as on maps.
SERIES_COLORS = UAV_COLORS
_BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY_BLUE = SERIES_COLORS[:6]
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINE_STYLES = ("-", "--", ":", "-.")
DASHED = (0, (4, 3))
# With more points than this, markers hide the line.
MAX_MARKERS = 40


def style_axes(axes: Any, title: str, x_label: str, y_label: str, grid: str = "y") -> None:
    """
    :param axes: matplotlib axes
    :param title: Title, at the left
    :param x_label: Label of the horizontal axis
    :param y_label: Label of the vertical axis
    :param grid: Which grid lines to draw, ``"x"``, ``"y"`` or ``"both"``
    """
    axes.set_title(title, fontsize=11, loc="left")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(axis=grid, color="0.88", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)

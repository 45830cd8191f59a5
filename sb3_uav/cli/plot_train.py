"""``sb3-uav plot-train``."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments, those of ``rl_zoo3.plots.plot_train`` and ``--figure``
    :return: Exit code 0
    :raises ValueError: If an argument is wrong, or there is nothing to draw
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that plots need is not installed
    """
    from sb3_uav.zoo.plots import plot

    plot("plot-train", argv)
    return 0

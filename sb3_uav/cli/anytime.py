"""``sb3-uav anytime``: objective against time, from an evaluation at several time limits."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_uav.common.optional import require
from sb3_uav.plots.anytime import plot_anytime


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code 0
    :raises ValueError: If there is nothing to draw, or an argument is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If matplotlib is not installed
    """
    parser = argparse.ArgumentParser(
        prog="sb3-uav anytime",
        description="Draw the mean objective of all solvers against their time per instance, one panel for every set of "
        "instances, from the results.csv of `sb3-uav evaluate --time-limit 0.1 1 10 ...`. Solvers that use no time limit are "
        "points.",
    )
    parser.add_argument("results", type=Path, metavar="DIR", help="folder that `sb3-uav evaluate` wrote")
    parser.add_argument(
        "--out",
        type=Path,
        nargs="+",
        metavar="FILE",
        help=".png, .pdf or .svg, one or several (default: DIR/anytime.png and DIR/anytime.pdf)",
    )
    parser.add_argument("--solvers", nargs="+", metavar="NAME", help="names of the solvers to draw (default: all)")
    args = parser.parse_args(argv)
    require("matplotlib.figure", "Drawing", "plots")
    figures = args.out or [args.results / "anytime.png", args.results / "anytime.pdf"]
    for path in plot_anytime(args.results, figures, args.solvers):
        print(path)
    return 0

"""
``sb3-uav all-plots``, ``plot-train`` and ``plot-from-file``, or ``python -m sb3_uav.zoo.plots NAME``: rl_zoo3's plots.

They read ``evaluations.npz`` and the monitor files of run folders, which ours have too. ``--figure`` writes what they show.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sb3_uav.common.errors import run_command
from sb3_uav.common.files import temporary_name
from sb3_uav.common.optional import require
from sb3_uav.zoo.dependencies import require_zoo

PLOTS = ("all-plots", "plot-train", "plot-from-file")
_HELP = "Plot with rl_zoo3. Its flags are below; without --figure it shows the figures in windows."
_FIGURE_FLAG = ("--figure FILE", "picture to write, in the format of its suffix, in place of a window")
# Without these, rl_zoo3 fails somewhere.
_REQUIRED = {"all-plots": ("--algos", "--env", "--exp-folders"), "plot-train": (), "plot-from-file": ("--input",)}


def plot(name: str, arguments: Sequence[str]) -> None:
    """
    Draw with rl_zoo3; every flag of its command works.

    :param name: One of ``PLOTS``
    :param arguments: Command line arguments; ``--figure FILE`` names the picture to write, in the format of its suffix. Of
        several, the second and later ones have their number in the name
    :raises ValueError: If an argument is wrong, or there is nothing to draw
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that plots need is not installed
    """
    require_zoo("Plotting a log folder")
    for package in ("matplotlib", "scipy.spatial", "seaborn"):
        require(package, "Plotting a log folder", "zoo-plots")
    from sb3_uav.zoo.rl_zoo3_compat import command_line, help_text, plot_command, shown_figures

    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-a", "--algos", nargs="+")
    parser.add_argument("-e", "--env", nargs="+")
    parser.add_argument("-f", "--exp-folders", nargs="+")
    parser.add_argument("-i", "--input")
    chosen, _ = parser.parse_known_args(arguments)
    module, function = plot_command(name.replace("-", "_"))
    if chosen.help:
        with command_line(f"sb3-uav {name}", ["--help"]), help_text(module, _HELP, _FIGURE_FLAG):
            function()
    for flag in _REQUIRED[name]:
        if getattr(chosen, flag[2:].replace("-", "_")) is None:
            raise ValueError(f"{flag} is missing; see sb3-uav {name} --help.")
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    own.add_argument("--figure")
    _, others = own.parse_known_args(arguments)
    with command_line(f"sb3-uav {name}", others), shown_figures(chosen.figure is None) as figures:
        function()
    if chosen.figure is None:
        return
    if not any(axes.has_data() for figure in figures for axes in figure.axes):
        raise ValueError("there is nothing to draw: no run of these folders, algorithms and environments has enough data.")
    for number, figure in enumerate(figures, start=1):
        path = chosen.figure if number == 1 else chosen.figure.with_stem(f"{chosen.figure.stem}-{number}")
        with temporary_name(path) as temporary:
            figure.savefig(temporary, bbox_inches="tight")
        print(path)


all_plots, plot_train, plot_from_file = (partial(plot, name) for name in ("all-plots", "plot-train", "plot-from-file"))


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Name of a plot and its arguments; those of the process when None
    :return: Exit code
    """
    name, *arguments = list(sys.argv[1:] if argv is None else argv) or [""]
    name = name.replace("_", "-")
    if name not in PLOTS:
        parser = argparse.ArgumentParser(prog="python -m sb3_uav.zoo.plots", description=_HELP)
        parser.add_argument("name", choices=PLOTS)
        parser.parse_args([name] if name else [])
    return run_command(f"sb3-uav {name}", lambda: plot(name, arguments))


if __name__ == "__main__":
    sys.exit(main())

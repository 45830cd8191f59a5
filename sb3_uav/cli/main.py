"""The command ``sb3-uav``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module

import sb3_uav
from sb3_uav.common.errors import run_command

# Each command has its own parser: its arguments go to this function, whose result is the exit code; None stands for 0.
_FORWARDED = {
    "train": ("sb3_uav.zoo.train:train", "train from a zoo YAML (all flags of rl_zoo3's train)"),
    "enjoy": ("sb3_uav.zoo.enjoy:enjoy", "replay a trained agent (all flags of rl_zoo3's enjoy)"),
    "record-video": ("sb3_uav.zoo.record_video:record_video", "record a video of a trained agent (all flags of rl_zoo3's)"),
    "benchmark": ("sb3_uav.zoo.benchmark:benchmark", "table of all agents of a log folder (all flags of rl_zoo3's benchmark)"),
    "all-plots": ("sb3_uav.zoo.plots:all_plots", "curves and table of evaluations (all flags of rl_zoo3's all_plots)"),
    "plot-train": ("sb3_uav.zoo.plots:plot_train", "curves of training episodes (all flags of rl_zoo3's plot_train)"),
    "plot-from-file": ("sb3_uav.zoo.plots:plot_from_file", "figures from a file of all-plots (all flags of rl_zoo3's)"),
    "push-to-hub": ("sb3_uav.zoo.push_to_hub:push_to_hub", "a trained agent and its router to the Hugging Face Hub"),
    "load-from-hub": ("sb3_uav.zoo.load_from_hub:load_from_hub", "an agent of the Hugging Face Hub into a log folder"),
    "solve": ("sb3_uav.cli.solve:main", "plan missions over a list of tasks: CSV, GeoJSON, .plan, ... to missions that fly"),
    "replan": ("sb3_uav.cli.replan:main", "plan a mission again while its UAVs are in the air"),
    "evaluate": ("sb3_uav.cli.evaluate:main", "evaluate zips and solvers on the same instances"),
    "bound": ("sb3_uav.cli.bound:main", "prove an upper bound on the value of any schedule"),
    "bench": ("sb3_uav.cli.bench:main", "compare solvers with the best-known values of public benchmarks"),
    "merge": ("sb3_uav.cli.merge:main", "join the results of the shards of an evaluation or benchmark"),
    "anytime": ("sb3_uav.cli.anytime:main", "draw objective against time from an evaluation"),
    "reproduce": ("sb3_uav.cli.reproduce:main", "make the tables and figures of the paper"),
    "compare": ("sb3_uav.cli.compare:main", "train algorithms at an equal budget and compare them"),
    "serve": ("sb3_uav.cli.serve:main", "plan missions in a browser, and by a JSON API"),
    "demo": ("sb3_uav.cli.demo:main", "train and evaluate a small scenario in a few minutes"),
}


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sb3-uav", description="Multi-UAV task scheduling with DL-DRL.")
    parser.add_argument("--version", action="version", version=f"sb3-uav {sb3_uav.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (_, text) in _FORWARDED.items():
        commands.add_parser(name, help=text, add_help=False)
    return parser


def _run(argv: Sequence[str]) -> int | None:
    """
    :param argv: Name of a command and its arguments
    :return: Exit code; None stands for 0
    """
    if not argv or argv[0] not in _FORWARDED:
        # Prints the help, the version or an error, and exits.
        _make_parser().parse_args(argv[:1])
    # Not by argparse.REMAINDER, which swallows options of this parser that come first.
    module, _, function = _FORWARDED[argv[0]][0].partition(":")
    code: int | None = getattr(import_module(module), function)(list(argv[1:]))
    return code


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code, see :func:`~sb3_uav.common.errors.run_command`
    """
    argv = sys.argv[1:] if argv is None else argv
    prog = f"sb3-uav {argv[0]}" if argv and argv[0] in _FORWARDED else "sb3-uav"
    return run_command(prog, partial(_run, argv))


if __name__ == "__main__":
    sys.exit(main())

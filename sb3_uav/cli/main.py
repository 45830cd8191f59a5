"""The command ``sb3-uav``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

import sb3_uav

OK, USER_ERROR, INTERRUPTED = 0, 2, 130
# Every command has a parser of its own: what follows it goes to the main function of that module.
FORWARDED = {
    "train": ("sb3_uav.zoo.train", "train from a zoo YAML (all flags of rl_zoo3's train)"),
    "enjoy": ("sb3_uav.zoo.enjoy", "replay a trained agent (all flags of rl_zoo3's enjoy)"),
    "evaluate": ("sb3_uav.cli.evaluate", "evaluate zips and solvers on the same instances"),
    "anytime": ("sb3_uav.cli.anytime", "draw what an evaluation found against the time it took"),
    "reproduce": ("sb3_uav.studies.reproduce.command", "make the tables and figures of the paper anew"),
    "compare": ("sb3_uav.studies.compare.study", "train algorithms at an equal budget and compare them"),
    "demo": ("sb3_uav.cli.demo", "train and evaluate a small scenario in a few minutes"),
}


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sb3-uav", description="Multi-UAV task scheduling with DL-DRL.")
    parser.add_argument("--version", action="version", version=f"sb3-uav {sb3_uav.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (_, text) in FORWARDED.items():
        commands.add_parser(name, help=text, add_help=False)
    return parser


def run(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments of the command
    :return: Exit code
    """
    if not argv or argv[0] not in FORWARDED:
        # Prints the help or the version, or says what is wrong, and exits.
        make_parser().parse_args(argv[:1])
    # Not by argparse.REMAINDER, which swallows options of this parser that come first.
    return import_module(FORWARDED[argv[0]][0]).main(list(argv[1:])) or OK


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code: that of the command (0 if all is well), 2 if the input was wrong, 130 after Ctrl-C
    """
    try:
        return run(sys.argv[1:] if argv is None else argv)
    except (ValueError, OSError, ImportError) as error:
        print(f"sb3-uav: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("sb3-uav: interrupted", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())

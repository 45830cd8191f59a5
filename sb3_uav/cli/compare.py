"""``sb3-uav compare``: algorithms at an equal budget, compared at equal steps and at equal time."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_uav.common.interruption import continued_by
from sb3_uav.common.optional import require
from sb3_uav.zoo.dependencies import require_zoo


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav compare",
        description="Train PPO, MaskablePPO and REINFORCE from their YAMLs at an equal budget of environment steps, evaluate "
        "all on one validation set along the way, and write evaluations.csv, comparison.png, comparison.pdf and report.md. "
        "Rerun with the same --out to resume: finished runs are kept, interrupted ones restart.",
    )
    parser.add_argument("--env", required=True, help="id of an environment of sb3_uav")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder")
    parser.add_argument(
        "-n", "--n-timesteps", type=int, default=1_000_000, help="environment steps of each run, default: %(default)s"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    parser.add_argument(
        "--variants",
        type=Path,
        metavar="YML",
        help="variants to compare: a mapping from names to {algo: NAME, KEY: VALUE, ...}, whose keys replace those of the "
        "environment's entry in zoo_configs/NAME.yml (or in conf_file: PATH); null removes one",
    )
    parser.add_argument(
        "--router",
        type=Path,
        metavar="ZIP",
        help="TaskAllocation only: the router that determines all rewards; trained if not given",
    )
    parser.add_argument(
        "--router-subsets",
        type=int,
        default=100_000,
        help="number of training subsets of that router, default: %(default)s",
    )
    parser.add_argument(
        "--its", action="store_true", help="keep ITSCallback in the YAML entries: every run trains its own router"
    )
    parser.add_argument("--instances", type=Path, metavar="NPZ", help="validation set; drawn once if not given")
    parser.add_argument("--n-instances", type=int, default=256, help="size of a drawn validation set, default: %(default)s")
    parser.add_argument("--samples", type=int, default=16, help="samples per instance, 0 for none, default: %(default)s")
    parser.add_argument("--eval-freq", type=int, help="environment steps between evaluations, default: a 20th of the budget")
    parser.add_argument("--jobs", type=int, default=1, help="trainings side by side, default: %(default)s")
    parser.add_argument("--num-threads", type=int, default=1, help="threads of each training, default: %(default)s")
    parser.add_argument("--device", default="cpu", help="default: %(default)s")
    parser.add_argument("--report-only", action="store_true", help="train nothing; report on the runs that are finished")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train and compare.

    :param argv: Command line arguments; those of the process when None
    :return: Exit code 0
    :raises ValueError: If an argument or a file is wrong, or a training fails
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that comparisons need is not installed
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    settings = vars(_make_parser().parse_args(arguments))
    # Report missing packages before the long run.
    require_zoo("A comparison")
    require("matplotlib.figure", "A comparison", "plots")
    from sb3_uav.studies.compare.study import Settings, run_study

    report_only = settings.pop("report_only")
    with continued_by(["sb3-uav", "compare", *arguments]):
        for path in run_study(Settings(**settings), arguments, report_only):
            print(path)
    return 0

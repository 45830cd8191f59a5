"""``sb3-uav reproduce``: the tables and figures of the paper."""

from __future__ import annotations

import argparse
import logging
import shlex
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_uav.common.interruption import continued_by
from sb3_uav.common.optional import require
from sb3_uav.reproduce.scales import SCALES
from sb3_uav.reproduce.targets import DEFAULT_SOLVERS, TARGETS, check_solvers, target_functions
from sb3_uav.zoo.dependencies import require_zoo

if TYPE_CHECKING:
    from sb3_uav.reproduce.session import Session

_EPILOG = """\
what is written:
  DIR/table1.md, .tex, .csv       the table, the paper's figures beside ours; the same for the data of figures
  DIR/fig3.png, .pdf              the figure, drawn from fig3_schedules.csv, fig4_curves.csv, fig5_curves.csv or its own table
  DIR/claims.md, .tex, .csv       the paper's claims, and what our intervals say of each; claims_comparisons and claims_ratios
  DIR/models/U4-N80/ITS/          allocator.zip, router.zip, its_log.csv, training.json of each pair that was trained
                                  (mixture/ITS/ of a pair for all situations)
  DIR/ablation/, DIR/timing/      the same of the pairs of Fig. 5, and of the runs that Table I times
  DIR/training/                   the zoo's own folders of the trainings
  DIR/evaluations/                results.csv and schedules.jsonl of every situation
  Every file states the command, scale, seed and versions that it was made with, and what was left out.
  Rerun an interrupted call to resume it; tables and figures share trainings and evaluations.

--models DIR:
  DIR/U4-N80/ITS/allocator.zip and router.zip; its_log.csv of the training for table1, fig4 and fig5. In place of
  U4-N80/ITS: U4/ITS for all sizes of a fleet, ITS for everything; in place of ITS: independent (DL-DRL-I), and for fig5
  ITS-without-pre-training, ITS-without-intensive, ITS-without-both. The pair that comes with the package is not used then.
"""


def _indented(name: str, text: str) -> str:
    """
    :param name: Name of a scale
    :param text: Its description
    :return: Both in the layout of argparse
    """
    return textwrap.fill(f"  {name:<22}{text}", 100, subsequent_indent=" " * 24)


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav reproduce",
        description="Reproduce tables and figures of the DL-DRL paper: train missing pairs, evaluate them beside "
        "the paper's baselines, and write our figures beside the paper's.",
        epilog="\n".join(["scales:", *(_indented(scale.name, scale.text) for scale in SCALES.values()), "", _EPILOG]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "targets", nargs="+", choices=(*TARGETS, "all"), metavar="TARGET", help=f"{', '.join(TARGETS)}, or all"
    )
    parser.add_argument("--scale", choices=tuple(SCALES), default="smoke", help="size of the study (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of all files (default: reproduction/SCALE)")
    parser.add_argument("--models", type=Path, metavar="DIR", help="use the trained pairs in DIR (see below)")
    parser.add_argument(
        "--train-pair",
        action="store_true",
        help="at scales whose DL-DRL is the pair that comes with the package: use the pair that is trained here instead",
    )
    parser.add_argument("--no-training", action="store_true", help="leave out results that need further training")
    parser.add_argument(
        "--solvers",
        nargs="*",
        default=list(DEFAULT_SOLVERS),
        metavar="NAME",
        help="solvers that are not trained here; solvers that the paper does not have become further columns, e.g. pyvrp "
        f"(default: {' '.join(DEFAULT_SOLVERS)})",
    )
    parser.add_argument(
        "--exact-backend",
        choices=("highs", "gurobi"),
        help="backend that stands for the paper's Gurobi (default: the scale's; gurobi at scale paper)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of trainings and solvers (default: %(default)s)")
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="trainings, and instances of solvers, at once (default: %(default)s)"
    )
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:0, ... (default: %(default)s)")
    parser.add_argument(
        "--num-threads",
        type=int,
        metavar="N",
        help="torch threads of each training (default: chosen by torch; 1 with several jobs)",
    )
    parser.add_argument(
        "--redraw",
        action="store_true",
        help="train and evaluate nothing: write the tables and figures in --out again from the CSV files in it",
    )
    parser.add_argument("--overwrite", action="store_true", help="discard existing evaluations; trained pairs are kept")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code 0
    :raises ValueError: If an argument or a file is wrong, or a training fails
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that this needs is not installed
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    args = _make_parser().parse_args(arguments)
    for name, value, least in (("--seed", args.seed, 0), ("--jobs", args.jobs, 1), ("--num-threads", args.num_threads, 1)):
        if value is not None and value < least:
            raise ValueError(f"{name} is {value}; it must be at least {least}.")
    check_solvers(args.solvers)
    # Report missing packages before the long run.
    require("matplotlib.figure", "Reproducing the paper's figures", "plots")
    names = [name for name in TARGETS if name in args.targets or "all" in args.targets]
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    out = args.out or Path("reproduction") / args.scale
    if args.redraw:
        from sb3_uav.reproduce.output_files import redraw

        for path in redraw(out, names):
            print(path)
        return 0
    require_zoo("Reproducing the paper's tables")
    from sb3_uav.cli.evaluate import ProgressLines

    with ProgressLines() as progress, continued_by(["sb3-uav", "reproduce", *arguments]):
        session = _make_session(args, out, shlex.join(["sb3-uav", "reproduce", *arguments]), progress)
        for position, name in enumerate(names):
            print(f"{name} ({position + 1} of {len(names)}), scale {args.scale}", file=sys.stderr, flush=True)
            for path in target_functions()[name](session):
                print(path, flush=True)
    return 0


def _make_session(
    args: argparse.Namespace, out: Path, command: str, progress: Callable[[str, int, int], None] | None
) -> Session:
    """
    :param args: Arguments of ``sb3-uav reproduce``
    :param out: Folder of all results
    :param command: The command line
    :param progress: Called before each solver starts and after each of its instances
    :return: The session
    :raises FileNotFoundError: If the folder of models is missing
    """
    import torch as th

    from sb3_uav.reproduce.evaluator import Evaluator
    from sb3_uav.reproduce.origin import Origin
    from sb3_uav.reproduce.pairs import Models
    from sb3_uav.reproduce.session import Session

    if args.num_threads is not None:
        th.set_num_threads(args.num_threads)
    scale = SCALES[args.scale]
    if args.exact_backend is not None:
        scale = replace(scale, exact_backend=args.exact_backend)
    threads, training = args.num_threads, not args.no_training
    models = Models(scale, out, args.models, args.seed, args.device, threads, args.jobs, training, args.train_pair)
    evaluator = Evaluator(scale, out, args.seed, args.device, args.jobs, args.overwrite, progress)
    return Session(scale, models, evaluator, args.solvers, Origin.of(command, scale, args.seed), out)

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

from sb3_uav.studies.reproduce.scales import SCALES
from sb3_uav.studies.reproduce.targets import DEFAULT_SOLVERS, TARGETS, check_solvers, target_functions

if TYPE_CHECKING:
    from sb3_uav.studies.reproduce.session import Session

EPILOG = """\
what is written:
  DIR/table1.md, .tex, .csv       the table, the paper's figures beside ours; the same for the data of figures
  DIR/fig3.png, .pdf              the figure; fig4_curves.csv and fig5_curves.csv hold every epoch
  DIR/models/U4-N80/ITS/          allocator.zip, router.zip, its_log.csv, training.json of each pair that was trained
  DIR/training/, DIR/timing/      the zoo's own folders of the trainings; the runs that Table I times
  DIR/evaluations/                results.csv and schedules.jsonl of every situation
  Every file says by which command, scale, seed and versions it was made, and what was left out.
  Trainings and evaluations go on where an interrupted call stopped, and share what they have in common.

--models DIR:
  DIR/U4-N80/ITS/allocator.zip and router.zip; its_log.csv of the training for table1, fig4 and fig5. In place of
  U4-N80/ITS: U4/ITS for all sizes of a fleet, ITS for everything; in place of ITS: independent (DL-DRL-I), and for fig5
  ITS-without-pre-training, ITS-without-intensive, ITS-without-both.
"""


def indented(name: str, text: str) -> str:
    """
    :param name: What is explained
    :param text: The explanation
    :return: Both as argparse prints options
    """
    return textwrap.fill(f"  {name:<22}{text}", 100, subsequent_indent=" " * 24)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav reproduce",
        description="Make tables and figures of the DL-DRL paper anew: train the pairs that are missing, evaluate them beside "
        "the paper's baselines, and write our figures beside the paper's.",
        epilog="\n".join(["scales:", *(indented(scale.name, scale.text) for scale in SCALES.values()), "", EPILOG]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "targets", nargs="+", choices=(*TARGETS, "all"), metavar="TARGET", help=f"{', '.join(TARGETS)}, or all"
    )
    parser.add_argument("--scale", choices=tuple(SCALES), default="smoke", help="how much of it (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of all files (default: reproduction/SCALE)")
    parser.add_argument("--models", type=Path, metavar="DIR", help="use the trained pairs in DIR (see below)")
    parser.add_argument("--no-training", action="store_true", help="leave out what would have to be trained first")
    parser.add_argument(
        "--solvers",
        nargs="*",
        default=list(DEFAULT_SOLVERS),
        metavar="NAME",
        help="solvers that are not trained here; others than the paper's become further columns, e.g. pyvrp "
        f"(default: {' '.join(DEFAULT_SOLVERS)})",
    )
    parser.add_argument(
        "--exact-backend",
        choices=("highs", "gurobi"),
        help="which solver stands for the paper's Gurobi (default: the scale's; gurobi at scale paper)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of trainings, test instances and solvers (default: %(default)s)")
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="trainings, and instances of solvers, at once (default: %(default)s)"
    )
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:0, ... (default: %(default)s)")
    parser.add_argument(
        "--num-threads",
        type=int,
        metavar="N",
        help="of torch, in each training (default: its own choice; 1 with several jobs)",
    )
    parser.add_argument("--overwrite", action="store_true", help="evaluate anew; trained pairs are kept")
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
    args = make_parser().parse_args(arguments)
    for name, value, least in (("--seed", args.seed, 0), ("--jobs", args.jobs, 1), ("--num-threads", args.num_threads, 1)):
        if value is not None and value < least:
            raise ValueError(f"{name} is {value}; it must be at least {least}.")
    check_solvers(args.solvers)
    # What may be missing is found before the long run, not after it.
    from sb3_uav.cli.evaluate import ProgressLines
    from sb3_uav.envs.render import require_matplotlib

    require_matplotlib()
    names = [name for name in TARGETS if name in args.targets or "all" in args.targets]
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    out = args.out or Path("reproduction") / args.scale
    try:
        with ProgressLines() as progress:
            session = make_session(args, out, shlex.join(["sb3-uav", "reproduce", *arguments]), progress)
            for position, name in enumerate(names):
                print(f"{name} ({position + 1} of {len(names)}), scale {args.scale}", file=sys.stderr, flush=True)
                for path in target_functions()[name](session):
                    print(path, flush=True)
    except KeyboardInterrupt:
        print(f"sb3-uav: {out} holds what is done so far; the same command goes on from there.", file=sys.stderr)
        raise
    return 0


def make_session(
    args: argparse.Namespace, out: Path, command: str, progress: Callable[[str, int, int], None] | None
) -> Session:
    """
    :param args: Of ``sb3-uav reproduce``
    :param out: Folder of all results
    :param command: What the user typed
    :param progress: Called before each solver starts and after each of its instances
    :return: What all tables and figures share
    :raises FileNotFoundError: If the folder of models is missing
    """
    import torch as th

    from sb3_uav.studies.reproduce.evaluator import Evaluator
    from sb3_uav.studies.reproduce.origin import Origin
    from sb3_uav.studies.reproduce.pairs import Models
    from sb3_uav.studies.reproduce.session import Session

    if args.num_threads is not None:
        th.set_num_threads(args.num_threads)
    scale = SCALES[args.scale]
    if args.exact_backend is not None:
        scale = replace(scale, exact_backend=args.exact_backend)
    models = Models(
        scale, out, args.models, args.seed, args.device, args.num_threads, args.jobs, training=not args.no_training
    )
    evaluator = Evaluator(scale, out, args.seed, args.device, args.jobs, args.overwrite, progress)
    return Session(scale, models, evaluator, args.solvers, Origin(command, scale, args.seed), out)

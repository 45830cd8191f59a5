"""``sb3-uav demo``: training, evaluation and figures for a small scenario in a few minutes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_uav.common.interruption import Interruption
from sb3_uav.common.optional import require
from sb3_uav.registration import DEMO_FLEET, DEMO_SIZE, allocation_id, ensure_registered
from sb3_uav.zoo.dependencies import require_zoo

_DESCRIPTION = "Train a small scenario through all phases of ITS, evaluate the pair beside heuristics, and draw figures."


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train a pair with all phases of the ITS, evaluate it beside simple heuristics, draw learning curves and a schedule.

    :param argv: Command line arguments; those of the process when None
    :return: Exit code: 1 if a schedule was infeasible
    :raises ValueError: If an argument is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that the demo needs is not installed
    :raises Interruption: After Ctrl-C, with the command that continues
    """
    parser = argparse.ArgumentParser(prog="sb3-uav demo", description=_DESCRIPTION)
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder of all results (default: %(default)s)")
    parser.add_argument("--env", default=allocation_id(DEMO_FLEET, DEMO_SIZE), help="default: %(default)s")
    parser.add_argument("--n-instances", type=int, default=200, help="test instances (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    args, train_args = parser.parse_known_args(argv)

    # Report missing packages before the training.
    require_zoo("The demo", "rich.console", "tensorboard")
    require("matplotlib.figure", "The demo", "plots")
    ensure_registered(args.env)
    from sb3_uav.studies.demo import evaluate_run, newest_run
    from sb3_uav.zoo.checkpoints import newest_checkpoint
    from sb3_uav.zoo.train import train

    logs = args.out / "logs"
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        train(
            [
                *("--algo", "reinforce", "--env", args.env, "--log-folder", str(logs), "--seed", str(args.seed)),
                *("--tensorboard-log", str(args.out / "tensorboard"), "--log-interval", "200"),
                *("--eval-freq", "1000000", "--eval-episodes", "50"),
                # Networks this small gain little from a second thread, and lose much if another process needs the core.
                *("--num-threads", "1"),
                *(["--progress"] if sys.stdout.isatty() else []),
                *train_args,
            ]
        )
    except Interruption as error:
        raise _continued(arguments, error.changes) from error
    run = newest_run(logs / "reinforce", args.env)
    try:
        return evaluate_run(run, args.env, args.out, args.n_instances, args.seed)
    except KeyboardInterrupt as error:
        # A training that is complete ends at once.
        checkpoint = newest_checkpoint(run)
        raise _continued(arguments, () if checkpoint is None else ("-i", str(checkpoint))) from error


def _continued(arguments: Sequence[str], changes: Sequence[str]) -> Interruption:
    from sb3_uav.zoo.interrupted import with_changes

    return Interruption(["sb3-uav", "demo", *with_changes(arguments, changes)])

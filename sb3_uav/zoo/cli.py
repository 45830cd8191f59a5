"""The command ``sb3-uav``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import sb3_uav

if TYPE_CHECKING:
    from sb3_uav.envs import Instances
    from sb3_uav.solvers import Solver

OK, INFEASIBLE, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
# Subcommands with a parser of their own: what follows them goes to the main function of that module.
FORWARDED = {
    "train": ("sb3_uav.zoo.train", "train from a zoo YAML (all flags of rl_zoo3's train)"),
    "enjoy": ("sb3_uav.zoo.enjoy", "replay a trained agent (all flags of rl_zoo3's enjoy)"),
    "compare": ("sb3_uav.zoo.compare", "train algorithms at an equal budget and compare them"),
    "demo": ("sb3_uav.zoo.demo", "train and evaluate a small scenario in a few minutes"),
}


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sb3-uav", description="Multi-UAV task scheduling with DL-DRL.")
    parser.add_argument("--version", action="version", version=f"sb3-uav {sb3_uav.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    evaluate = commands.add_parser(
        "evaluate",
        help="evaluate zips and solvers on the same instances",
        description="Evaluate a trained pair and other solvers on the same instances; every schedule is checked. "
        "Exit code 1 means that a schedule was infeasible, 2 that the input was wrong.",
    )
    pair = evaluate.add_argument_group("a trained pair")
    pair.add_argument("--allocator", type=Path, metavar="ZIP", help="SB3 zip of the allocator (needs --router)")
    pair.add_argument("--router", type=Path, metavar="ZIP", help="SB3 zip of the router (needs --allocator)")
    pair.add_argument("--decode", choices=("greedy", "sampling"), default="greedy", help="default: %(default)s")
    pair.add_argument("--samples", type=int, default=128, help="allocations per instance with sampling, default: %(default)s")
    pair.add_argument("--untrained", action="store_true", help="add the same networks before any training")
    pair.add_argument("--device", default="auto", help="cpu, cuda, cuda:0, ... (default: %(default)s)")
    pair.add_argument("--batch-size", type=int, help="instances solved at once, default: as many as memory allows")
    evaluate.add_argument("--instances", type=Path, nargs="+", required=True, metavar="NPZ", help="instance files")
    evaluate.add_argument(
        "--solvers", nargs="+", default=[], metavar="NAME[:KEY=VALUE,...]", help="other solvers, e.g. kmeans-nearest"
    )
    evaluate.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for results.csv and schedules.jsonl")
    evaluate.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    for name, (_, text) in FORWARDED.items():
        commands.add_parser(name, help=text, add_help=False)
    return parser


def load_instances(paths: Sequence[Path]) -> dict[str, Instances]:
    """
    :param paths: The files
    :return: Their instances by the stem of the file, or by the whole path where stems are alike
    :raises FileNotFoundError: If a file is missing
    :raises ValueError: If a file is damaged or given twice
    """
    from sb3_uav.envs import Instances

    stems = [path.stem for path in paths]
    names = [str(path) if stems.count(path.stem) > 1 else path.stem for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--instances names {name} twice; give every file once.")
    return {name: Instances.load(path) for name, path in zip(names, paths, strict=True)}


def make_solvers(args: argparse.Namespace) -> list[Solver]:
    """
    :param args: Of ``sb3-uav evaluate``
    :return: The solvers that they ask for, the trained pair first
    :raises FileNotFoundError: If a zip is missing
    :raises ValueError: If a zip is damaged, or an argument is not allowed
    """
    from sb3_uav.solvers.base import make_solver

    if (args.allocator is None) != (args.router is None):
        missing = "--allocator" if args.allocator is None else "--router"
        raise ValueError(f"--allocator and --router go together; {missing} is missing.")
    solvers: list[Solver] = []
    if args.allocator is not None:
        from sb3_uav.policies import AllocatorPolicy, RouterPolicy
        from sb3_uav.policies.loading import load_policy
        from sb3_uav.solvers.dl_drl import DLDRL

        allocator = load_policy(args.allocator, args.device, AllocatorPolicy)
        router = load_policy(args.router, args.device, RouterPolicy)
        trained = DLDRL(allocator, router, args.decode, args.samples, args.batch_size)
        solvers += [trained, trained.untrained(args.seed)] if args.untrained else [trained]
    elif args.untrained:
        raise ValueError("--untrained needs --allocator and --router, which say what the networks look like.")
    solvers += [make_solver(spec) for spec in args.solvers]
    if not solvers:
        raise ValueError("There is nothing to evaluate: give --allocator with --router, or --solvers.")
    return solvers


def run_evaluate(args: argparse.Namespace) -> int:
    """
    :param args: Of ``sb3-uav evaluate``
    :return: Exit code
    """
    from sb3_uav.solvers.evaluation import evaluate, print_table, require_rich

    # What may be missing or wrong is found before the long run, not after it.
    require_rich()
    if args.seed < 0:
        raise ValueError(f"--seed is {args.seed}; it must be at least 0.")
    instances = load_instances(args.instances)
    for name, batch in instances.items():
        n_real, n_reachable = int(batch.task_mask.sum()), int(batch.reachable().sum())
        if n_reachable < n_real:
            print(
                f"sb3-uav: {name}: {n_real - n_reachable} of {n_real} tasks lie farther than max_distance / 2 from their "
                "depot; no schedule can visit them.",
                file=sys.stderr,
            )
    solvers = make_solvers(args)
    summary = evaluate(solvers, instances, args.out, args.seed, progress=lambda line: print(line, file=sys.stderr, flush=True))
    print_table(summary)
    violations = [violation for row in summary for violation in row.violations]
    for violation in violations:
        print(f"sb3-uav: infeasible schedule: {violation}", file=sys.stderr)
    return INFEASIBLE if violations else OK


def run(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments of the command
    :return: Exit code
    """
    if argv and argv[0] in FORWARDED:
        # Not by argparse.REMAINDER, which swallows options of this parser that come first.
        return import_module(FORWARDED[argv[0]][0]).main(list(argv[1:])) or OK
    return run_evaluate(make_parser().parse_args(argv))


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code: 0, 1 if a schedule was infeasible, 2 if the input was wrong, 130 after Ctrl-C
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

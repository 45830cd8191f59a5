"""``sb3-uav evaluate``: zips and solvers side by side, on the same instances."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_uav.cli.solver_specs import add_run_options, solvers_of
from sb3_uav.common.interruption import continued_by
from sb3_uav.common.optional import install_command

if TYPE_CHECKING:
    from sb3_uav.envs import Instances
    from sb3_uav.evaluation import SummaryRow
    from sb3_uav.evaluation.instance_sets import InstanceFiles
    from sb3_uav.evaluation.shard import Shard
    from sb3_uav.solvers import Solver

_OK, _INFEASIBLE, _USER_ERROR, _FAILED = 0, 1, 2, 3
_EPILOG = """\
solvers:
  An unknown NAME makes the error message list all solvers, an unknown KEY all options of that solver.
  NAME:KEY=VALUE,... sets options of a solver; name=TEXT is its label in tables and files. A value with a comma stands in
  quotes, which the shell must leave alone: 'dl-drl:allocator="a,b.zip",router=r.zip'. Trained zips are solvers too:
    dl-drl:allocator=A.zip,router=R.zip,decode=sampling,samples=128      a trained pair
    dl-drl-i:allocator=A.zip,router=R.zip                                the same, named as in the paper (independent training)
    kmeans-am:router=R.zip                                               K-means and a trained router
    sb3:zip=Z.zip,router=R.zip                                           any zip of our policies, step by step
    sb3:zip=Z.zip,algo=ppo,trust=1                                       any other SB3 zip that you trust (it is unpickled)

files in DIR:
  results.csv, schedules.jsonl    one line per solver and instance, written as soon as it is known
  summary.csv, summary.json       the table, with more columns
  evaluation.json                 solvers, hashes of instances and zips, seeds, versions of packages
  Rerun the same command to resume an interrupted run; further runs add solvers, time limits and seeds. Results that are kept
  are checked again: one that is not what the checker says of its routes is refused.

several machines or processes:
  --shard I/N evaluates part I of N of every set, each in a DIR of its own; `sb3-uav merge DIR... --out DIR` joins them.
  torchrun --nproc-per-node N -m sb3_uav evaluate ... does both, with the parts in DIR/shard-I-of-N.

exit code:
  0    all schedules are feasible
  1    a schedule was infeasible, or a solver proved a bound that is wrong
  2    the input was wrong, or no solver could be made, and nothing was run
  3    a solver or its license is missing, or its options are wrong, or it refused the instances or its time limit, or
       failed; the others are complete
  130  interrupted by Ctrl-C
"""


def _make_parser() -> argparse.ArgumentParser:
    from sb3_uav.solvers.decoding import DECODINGS

    parser = argparse.ArgumentParser(
        prog="sb3-uav evaluate",
        description="Evaluate trained pairs and other solvers on the same instances. Every schedule is checked\n"
        "by the same independent code, and solvers are compared instance by instance.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--instances",
        type=Path,
        nargs="+",
        required=True,
        metavar="NPZ",
        help="instance files; a folder of such files is one set",
    )
    parser.add_argument(
        "--solvers", nargs="+", default=[], metavar="NAME[:KEY=VALUE,...]", help="solvers, e.g. kmeans-nearest (see below)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the results")
    parser.add_argument(
        "--time-limit",
        type=float,
        nargs="+",
        metavar="SECONDS",
        help="per instance, for solvers that use it; several run one after the other (default: each solver's own)",
    )
    parser.add_argument("--reference", metavar="NAME", help="solver that the others are compared with (default: the first)")
    add_run_options(parser)
    pair = parser.add_argument_group("a trained pair, the first of the solvers")
    pair.add_argument("--allocator", type=Path, metavar="ZIP", help="SB3 zip of the allocator (needs --router)")
    pair.add_argument("--router", type=Path, metavar="ZIP", help="SB3 zip of the router (needs --allocator)")
    pair.add_argument("--decode", choices=DECODINGS, default="greedy", help="default: %(default)s")
    pair.add_argument("--samples", type=int, default=128, help="tours per UAV unless greedy, default: %(default)s")
    pair.add_argument("--untrained", action="store_true", help="add the same networks before any training")
    return parser


def _warn_of_tasks_out_of_reach(name: str, instances: Instances, first: int = 0) -> None:
    """Say on stderr how many tasks no UAV can serve, and name those that must be served; rows are counted from ``first``."""
    reachable = instances.reachable()
    n_real, n_reachable = int(instances.task_mask.sum()), int(reachable.sum())
    if n_reachable == n_real:
        return
    why = "lie farther than max_distance / 2 from their depot" if instances.is_plain else "are out of reach of every UAV"
    print(f"sb3-uav: {name}: {n_real - n_reachable} of {n_real} tasks {why}; no schedule can visit them.", file=sys.stderr)
    if instances.must_serve is None:
        return
    lost = instances.must_serve & instances.task_mask & ~reachable
    for row in lost.any(1).nonzero()[:, 0].tolist():
        tasks = ", ".join(str(task) for task in lost[row].nonzero()[:, 0].tolist())
        print(f"sb3-uav: {name}: instance {first + row}: tasks that must be served are among them: {tasks}.", file=sys.stderr)


def _warn_of(name: str, files: InstanceFiles) -> None:
    """The same for a set of files, one after the other."""
    first = 0
    for part in range(len(files.paths)):
        batch = files.load(part)
        _warn_of_tasks_out_of_reach(name, batch, first)
        first += len(batch)


def _make_solvers(args: argparse.Namespace) -> list[Solver]:
    """
    :param args: Arguments of ``sb3-uav evaluate``
    :return: The solvers that they ask for, the trained pair first; in place of one that cannot be made, one that refuses all
        instances
    :raises OSError: If a zip of the trained pair is missing, or of the only solver
    :raises ValueError: If a zip of it is damaged, or another argument is not allowed
    """
    from sb3_uav.solvers.unavailable import UnavailableSolver

    if (args.allocator is None) != (args.router is None):
        missing = "--allocator" if args.allocator is None else "--router"
        raise ValueError(f"--allocator and --router go together; {missing} is missing.")
    solvers: list[Solver] = []
    if args.allocator is not None:
        from sb3_uav.solvers.dl_drl import load_dl_drl

        trained = load_dl_drl(args.allocator, args.router, args.decode, args.samples, args.device, args.batch_size)
        solvers += [trained, trained.untrained(args.seed)] if args.untrained else [trained]
    elif args.untrained:
        raise ValueError("--untrained needs --allocator and --router, which say what the networks look like.")
    more, wrong = solvers_of(args.solvers, args.device, args.batch_size)
    solvers += more
    if not solvers:
        raise ValueError("There is nothing to evaluate: give --allocator with --router, or --solvers.")
    if wrong and all(isinstance(solver, UnavailableSolver) for solver in solvers):
        raise wrong[0]
    return solvers


class ProgressLines:
    """
    One line for each solver and set of instances, and on a terminal a bar. Use it as a context manager.

    :raises ImportError: If tqdm is needed and not installed
    """

    def __init__(self) -> None:
        self._text = ""
        self._bar: Any = None
        self._make_bar: Any = None
        if sys.stderr.isatty():
            try:
                from tqdm import tqdm
            except ImportError as error:
                raise ImportError(f"The progress bar needs tqdm; run: {install_command('solvers')}") from error
            self._make_bar = partial(tqdm, leave=False, unit="instance", dynamic_ncols=True)

    def __enter__(self) -> ProgressLines:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, text: str, n_done: int, n_total: int) -> None:
        """
        :param text: What is being done
        :param n_done: How much of it is done
        :param n_total: How much there is to do
        """
        if text != self._text:
            self._start(text, n_done, n_total)
        elif self._bar is not None:
            self._bar.update(n_done - self._bar.n)

    def _start(self, text: str, n_done: int, n_total: int) -> None:
        if self._bar is not None:
            self._bar.close()
        self._text = text
        print(text, file=sys.stderr, flush=True)
        if self._make_bar is not None:
            self._bar = self._make_bar(initial=n_done, total=n_total)


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code, see :data:`_EPILOG`
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that evaluations need is not installed
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    args = _make_parser().parse_args(arguments)
    again = ["sb3-uav", "evaluate", *(word for word in arguments if word != "--overwrite")]
    from sb3_uav.cli.shards import run_shard
    from sb3_uav.evaluation.instance_sets import files_of
    from sb3_uav.evaluation.merge import merge
    from sb3_uav.evaluation.run import evaluate, find_reference
    from sb3_uav.evaluation.table import require_rich

    # What may be missing or wrong is found before the long run, not after it.
    require_rich()
    instances = files_of(args.instances)
    for name, files in instances.items():
        _warn_of(name, files)
    solvers = _make_solvers(args)
    reference = find_reference(solvers, args.reference)

    def run(shard: Shard, out: Path) -> list[SummaryRow]:
        with ProgressLines() as progress, continued_by(again):
            return evaluate(
                solvers,
                instances,
                out,
                args.seed,
                progress,
                time_limits=args.time_limit or (None,),
                n_jobs=args.jobs,
                reference=reference,
                resume=not args.overwrite,
                shard=shard,
            )

    summary = run_shard(args, run, partial(merge, overwrite=args.overwrite))
    return _OK if summary is None else report_summary(summary)


def report_summary(summary: Sequence[SummaryRow]) -> int:
    """
    Print the tables on the standard output, and what is wrong on the standard error.

    :param summary: The summary of an evaluation
    :return: Exit code, see :data:`_EPILOG`
    """
    from sb3_uav.evaluation.table import print_table

    print_table(summary)
    # A solver that uses no time limit stands in the summary of each.
    violations = dict.fromkeys(violation for row in summary for violation in row.violations)
    failures = dict.fromkeys(failure for row in summary for failure in row.failures)
    for violation in violations:
        print(f"sb3-uav: wrong: {violation}", file=sys.stderr)
    for line in (*failures, *dict.fromkeys(line for row in summary for line in row.unserved)):
        print(f"sb3-uav: {line}", file=sys.stderr)
    if violations:
        return _INFEASIBLE
    return _FAILED if failures else _OK

"""``sb3-uav bench``: solvers on the files of a public benchmark, compared with best-known values."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_uav.cli.solver_specs import add_run_options, solvers_of
from sb3_uav.common.interruption import continued_by
from sb3_uav.common.optional import install_command, require

if TYPE_CHECKING:
    from sb3_uav.evaluation.benchmarks.collection import BenchmarkFolder
    from sb3_uav.evaluation.benchmarks.gaps import GapRow
    from sb3_uav.evaluation.shard import Shard
    from sb3_uav.solvers import Solver

_OK, _INFEASIBLE, _FAILED = 0, 1, 3
_EPILOG = """\
files in FOLDER and in the folders in it:
  *.txt                Chao's team orienteering: n, m, tmax (the limit of each vehicle), then x, y and score of each point;
                       the first is the start, the last the end
  *.oplib, *.txt, ...  OPLib: TYPE OP, EDGE_WEIGHT_TYPE EUC_2D; other metrics are left out and named (needs the extra bench)
  *.npz                instances of this package
  Hidden files, other files and CSVs are skipped. Instances have the name of their file without the suffix; several of an .npz
  have its name, a dot and their row, from 0. They are grouped by folder, or else by their name up to the first dot.

OPLib's rule rounds the length of every edge. Solvers see Euclidean lengths; a tour that is too long by the rule is shortened,
by other orders first and then by leaving out tasks, before its objective is compared. With --use-rounding, further tasks are
put into tours, the most valuable per length first, as long as the rule admits it.

files in DIR:
  summary.md                      the table, what was left out, objectives above the best-known value, failures
  gaps.csv                        one line per solver and instance, with its gap
  routes.jsonl                    the routes that count, by the numbers of their nodes in the files
  anytime.png                     gap against time, with several time limits
  results.csv, schedules.jsonl, evaluation.json, summary.csv, summary.json   as of `sb3-uav evaluate`
  Rerun the same command to resume an interrupted run; further runs add solvers, time limits and seeds.
  With --shard I/N, DIR covers part I of N of every set; `sb3-uav merge DIR... --out DIR` joins the parts.

exit code:
  0    all schedules are feasible
  1    a schedule was infeasible
  2    the input was wrong, or no solver could be made, and nothing was run
  3    a solver is missing, or its options are wrong, or it refused some instances, or failed; the others are complete
  130  interrupted by Ctrl-C
"""


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav bench",
        description="Run solvers on the files of a public benchmark, check every schedule by independent code, and compare\n"
        "the objectives with best-known values.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the benchmark files, or one of them")
    parser.add_argument(
        "--best-known", type=Path, required=True, metavar="CSV", help="best-known values: columns instance,best_known"
    )
    parser.add_argument(
        "--solvers",
        nargs="+",
        required=True,
        metavar="NAME[:KEY=VALUE,...]",
        help="solvers, e.g. greedy-insertion pyvrp:time_limit=1; see `sb3-uav evaluate --help`",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the results")
    parser.add_argument("--only", nargs="+", default=[], metavar="PATTERN", help="names of instances, e.g. 'p7.*'")
    parser.add_argument(
        "--time-limits",
        "--time-limit",
        type=float,
        nargs="+",
        metavar="SECONDS",
        help="per instance, for solvers that use it; several run one after the other (default: each solver's own)",
    )
    parser.add_argument(
        "--use-rounding", action="store_true", help="OPLib: put more tasks into tours where rounding leaves room (see below)"
    )
    add_run_options(parser)
    return parser


class _Progress:
    """
    One bar for the whole run on a terminal, elsewhere a line for each solver and set. Use it as a context manager.

    :param n_total: How many results there will be
    :raises ImportError: If tqdm is needed and not installed
    """

    def __init__(self, n_total: int) -> None:
        self._text = ""
        self._n_before = self._n_set = 0
        self._bar: Any = None
        if sys.stderr.isatty():
            try:
                from tqdm import tqdm
            except ImportError as error:
                raise ImportError(f"The progress bar needs tqdm; run: {install_command('bench')}") from error
            self._bar = tqdm(total=n_total, leave=False, unit="instance", dynamic_ncols=True)

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, text: str, n_done: int, n_set: int) -> None:
        """
        :param text: What is being done
        :param n_done: How much of it is done
        :param n_set: How much of it there is to do
        """
        if text != self._text:
            self._n_before += self._n_set
            self._text, self._n_set = text, n_set
            if self._bar is None:
                print(text, file=sys.stderr, flush=True)
            else:
                self._bar.set_description(text.partition(":")[0], refresh=False)
        if self._bar is not None:
            self._bar.update(self._n_before + n_done - self._bar.n)


def _n_results(
    solvers: Sequence[Solver], benchmark: BenchmarkFolder, time_limits: Sequence[float | None], shard: Shard
) -> int:
    """:return: How many results a run has"""
    from sb3_uav.evaluation.benchmarks.collection import evaluation_sets

    sets = evaluation_sets(list(benchmark.instances.values()))
    return sum(len(shard.rows(len(members))) for members in sets.values()) * sum(
        len(time_limits) if solver.uses_time_limit else 1 for solver in solvers
    )


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code, see :data:`_EPILOG`
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that the run needs is not installed
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    args = _make_parser().parse_args(arguments)
    again = ["sb3-uav", "bench", *(word for word in arguments if word != "--overwrite")]
    from sb3_uav.cli.shards import run_shard
    from sb3_uav.evaluation.benchmarks import read_best_known, read_folder
    from sb3_uav.evaluation.benchmarks.run import compare_results, run_benchmark
    from sb3_uav.evaluation.merge import merge
    from sb3_uav.solvers.unavailable import UnavailableSolver

    # What may be missing or wrong is found before the long run, not after it.
    require("rich.table", "Printing tables", "bench")
    time_limits = args.time_limits or (None,)
    if len(time_limits) > 1:
        require("matplotlib.figure", "Drawing", "bench")
    best_known = read_best_known(args.best_known)
    benchmark = read_folder(args.folder, args.only, list(best_known))
    solvers, wrong = solvers_of(args.solvers, args.device, args.batch_size)
    if wrong and all(isinstance(solver, UnavailableSolver) for solver in solvers):
        raise wrong[0]
    about = {
        "folder": str(args.folder),
        "best_known": str(args.best_known),
        "only": list(args.only),
        "use_rounding": args.use_rounding,
    }

    def run(shard: Shard, out: Path) -> list[GapRow]:
        with _Progress(_n_results(solvers, benchmark, time_limits, shard)) as progress, continued_by(again):
            return run_benchmark(
                solvers,
                benchmark,
                best_known,
                out,
                args.seed,
                progress,
                time_limits=time_limits,
                n_jobs=args.jobs,
                resume=not args.overwrite,
                use_rounding=args.use_rounding,
                shard=shard,
                about={"benchmark": about},
            )

    def join(folders: Sequence[Path], out: Path) -> list[GapRow]:
        merge(folders, out, args.overwrite)
        return compare_results(out, benchmark, best_known, args.use_rounding)

    rows = run_shard(args, run, join)
    return _OK if rows is None else report_gaps(rows, benchmark, best_known, args.out)


def report_gaps(rows: Sequence[GapRow], benchmark: BenchmarkFolder, best_known: Mapping[str, float], out: Path) -> int:
    """
    Print the table and what has to be known of it, and draw the curve.

    :param rows: What :func:`~sb3_uav.evaluation.benchmarks.run_benchmark` returned
    :param benchmark: The benchmark
    :param best_known: Best-known values
    :param out: Folder of the results
    :return: Exit code, see :data:`_EPILOG`
    """
    from sb3_uav.evaluation.benchmarks.report import print_report, report
    from sb3_uav.evaluation.benchmarks.summary_file import notes, omissions, repairs

    name = benchmark.path.resolve().name
    print_report(report(rows), f"{name}: {len(benchmark.instances)} instances, gap to the best-known values")
    for line in (*notes(benchmark, best_known), *repairs(rows), *omissions(rows)):
        print(line)
    files = [out / "summary.md", *_draw_curve(rows, out, name)]
    print(*(str(path) for path in files))
    return _exit_code(rows)


def _draw_curve(rows: Sequence[GapRow], folder: Path, title: str) -> list[Path]:
    """:return: The curve of gap against time, if there are several time limits and something to draw"""
    if len({row.time_limit for row in rows if row.time_limit is not None}) < 2:
        return []
    from sb3_uav.evaluation.benchmarks.run import CURVE_FILE
    from sb3_uav.plots.gap_curve import plot_gaps

    try:
        return [plot_gaps(rows, folder / CURVE_FILE, title)]
    except ValueError as error:
        print(f"sb3-uav: {error}", file=sys.stderr)
        return []


def _exit_code(rows: Sequence[GapRow]) -> int:
    """:return: The exit code, after the failures are printed"""
    from sb3_uav.evaluation.benchmarks.gaps import failures
    from sb3_uav.evaluation.results import FAILED, INFEASIBLE

    for line in failures(rows):
        print(f"sb3-uav: {line}", file=sys.stderr)
    found = {row.status for row in rows}
    if INFEASIBLE in found:
        return _INFEASIBLE
    return _FAILED if FAILED in found else _OK

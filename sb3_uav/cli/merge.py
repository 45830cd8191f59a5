"""``sb3-uav merge``: the folders of shards become that of the whole evaluation."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_EPILOG = """\
Joins what `sb3-uav evaluate` or `sb3-uav bench` wrote with --shard 1/N to --shard N/N, and prints and writes what one run
without shards does. The folders must agree in instances, solvers, settings and versions, hold no result twice and miss none.
Of a benchmark, its folder and best-known values are read again, at the paths that were given to the shards.

exit code: as for `sb3-uav evaluate` and `sb3-uav bench`; 2 if the folders do not make one evaluation, and nothing is written
"""


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav merge",
        description="Join the results of the shards of an evaluation.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="folders of all shards, in any order")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the whole evaluation")
    parser.add_argument("--overwrite", action="store_true", help="replace an evaluation in DIR; earlier merges always are")
    parser.add_argument("--benchmark", type=Path, metavar="FOLDER", help="folder of the benchmark, if it has moved")
    parser.add_argument("--best-known", type=Path, metavar="CSV", help="file of best-known values, if it has moved")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code, see :data:`_EPILOG`
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that printing needs is not installed
    """
    args = _make_parser().parse_args(argv)
    from sb3_uav.cli.evaluate import report_summary
    from sb3_uav.evaluation.merge import benchmark_of, merge
    from sb3_uav.evaluation.table import require_rich

    require_rich()
    about = benchmark_of(args.folders[0])
    if about is None:
        return report_summary(merge(args.folders, args.out, args.overwrite))
    return _merge_benchmark(args, about)


def _merge_benchmark(args: argparse.Namespace, about: dict[str, Any]) -> int:
    """
    :param args: Arguments of the command
    :param about: What the shards say of the benchmark
    :return: Exit code
    """
    from sb3_uav.cli.bench import report_gaps
    from sb3_uav.evaluation.benchmarks import read_best_known, read_folder
    from sb3_uav.evaluation.benchmarks.run import check_same_instances, compare_results
    from sb3_uav.evaluation.merge import merge

    best_known = read_best_known(args.best_known or Path(str(about.get("best_known"))))
    benchmark = read_folder(args.benchmark or Path(str(about.get("folder"))), about.get("only") or (), list(best_known))
    check_same_instances(args.folders[0], benchmark)
    merge(args.folders, args.out, args.overwrite)
    rows = compare_results(args.out, benchmark, best_known, bool(about.get("use_rounding")))
    return report_gaps(rows, benchmark, best_known, args.out)

"""``sb3-uav bound``: how much value any schedule of each instance can have at most."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import signal
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.common.optional import require

if TYPE_CHECKING:
    from sb3_uav.bounds import Bound

COLUMNS = ("instance", "bound", "seconds", "status")
_EPILOG = """\
CSV has the columns instance,bound,seconds,status, a line per instance, and is complete after every instance.

status:
  optimal      a schedule of this value was found: it is the best, and the bound is its value
  bound        more time does not lower it
  time limit   more time might lower it

exit code:
  0    every instance has a bound
  2    the input was wrong, and nothing was written
  130  interrupted by Ctrl-C; CSV holds the bounds of the instances that were finished
"""


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav bound",
        description="Prove an upper bound on the value of any schedule of each instance; valid however short the time limit.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--instances", type=Path, required=True, metavar="NPZ", help="file of the instances")
    parser.add_argument("--out", type=Path, required=True, metavar="CSV", help="file of the bounds")
    parser.add_argument("--overwrite", action="store_true", help="replace CSV if it exists")
    parser.add_argument(
        "--time-limit", type=float, default=30.0, metavar="SECONDS", help="wall time per instance (default: %(default)g)"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: %(default)s)")
    return parser


def _bound_of(path: Path, row: int, time_limit: float) -> tuple[int, Bound]:
    """
    :param path: File of instances
    :param row: Which of them
    :param time_limit: Seconds
    :return: The row and its bound
    """
    from sb3_uav.bounds import upper_bound, warm_up
    from sb3_uav.envs.instances import Instances

    warm_up()
    return row, upper_bound(Instances.load(path)[row], time_limit)[0]


def _bounds(path: Path, n_rows: int, time_limit: float, n_jobs: int) -> Iterator[tuple[int, Bound]]:
    """
    :param path: File of instances
    :param n_rows: How many there are
    :param time_limit: Seconds for each
    :param n_jobs: Number of processes
    :return: Row and bound of each as soon as it is known
    """
    if n_jobs == 1:
        for row in range(n_rows):
            yield _bound_of(path, row, time_limit)
        return
    # Not by fork: torch and numba have threads.
    context = multiprocessing.get_context("spawn")
    # Ctrl-C reaches all processes of a terminal; the main one says so, and ends the others.
    with ProcessPoolExecutor(min(n_jobs, n_rows), context, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        futures = [pool.submit(_bound_of, path, row, time_limit) for row in range(n_rows)]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code, see :data:`_EPILOG`
    :raises ValueError: If an argument or a file is wrong
    :raises ImportError: If a package that bounds need is not installed
    """
    args = _make_parser().parse_args(argv)
    if not 0 < args.time_limit < math.inf:
        raise ValueError(f"--time-limit is {args.time_limit:g} seconds; it must be more than 0, and finite.")
    if args.jobs < 1:
        raise ValueError(f"--jobs is {args.jobs}; give at least 1.")
    if args.out.exists() and not args.overwrite:
        raise ValueError(f"{args.out} exists; choose another file, or add --overwrite.")
    require("numba", "A bound", "solvers")
    require("highspy", "A bound", "solvers")
    tqdm = require("tqdm", "The progress bar", "solvers").tqdm
    from sb3_uav.envs.instances import Instances

    n_rows = len(Instances.load(args.instances))
    found: dict[int, Bound] = {}
    bounds = _bounds(args.instances, n_rows, args.time_limit, args.jobs)
    for row, bound in tqdm(bounds, total=n_rows, unit="instance", disable=not sys.stderr.isatty(), leave=False):
        found[row] = bound
        with replaced_when_complete(args.out) as file:
            write_csv(
                file, COLUMNS, ((row, f"{b.value:.12g}", f"{b.seconds:.3f}", b.status) for row, b in sorted(found.items()))
            )
    n_optimal = sum(bound.status == "optimal" for bound in found.values())
    print(f"{args.out}: {len(found)} bounds, {n_optimal} of them reached by a schedule.")
    return 0

"""Running solvers on the files of a public benchmark, and comparing them with best-known values."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_uav.common.files import write_atomically
from sb3_uav.common.json_text import read_json_file
from sb3_uav.evaluation.benchmarks.collection import BenchmarkFolder, batch_of, evaluation_sets
from sb3_uav.evaluation.benchmarks.gaps import GAPS_FILE, ROUTES_FILE, GapRow, find_gaps, write_gaps
from sb3_uav.evaluation.benchmarks.summary_file import SUMMARY_FILE, summary_text
from sb3_uav.evaluation.instance_sets import instance_sets
from sb3_uav.evaluation.locking import locked_folder
from sb3_uav.evaluation.results import SETTINGS_FILE
from sb3_uav.evaluation.run import evaluate
from sb3_uav.evaluation.set_evaluation import Progress
from sb3_uav.evaluation.shard import Shard
from sb3_uav.solvers.base import Solver

# Drawn by the command, if there are several time limits.
CURVE_FILE = "anytime.png"


def run_benchmark(
    solvers: Sequence[Solver],
    benchmark: BenchmarkFolder,
    best_known: Mapping[str, float],
    out_dir: str | os.PathLike[str],
    seed: int = 0,
    progress: Progress | None = None,
    time_limits: Sequence[float | None] = (None,),
    n_jobs: int = 1,
    resume: bool = False,
    use_rounding: bool = False,
    shard: Shard = Shard(),  # noqa: B008 (a tuple)
    about: Mapping[str, Any] | None = None,
) -> list[GapRow]:
    """
    Run every solver on every instance of a benchmark, check all schedules, and compare them with the best-known values.

    Writes what :func:`~sb3_uav.evaluation.run.evaluate` writes, and at the end ``gaps.csv``, ``routes.jsonl`` and
    ``summary.md``, which cover all results in the folder.

    :param solvers: The solvers, with different names
    :param benchmark: What :func:`~sb3_uav.evaluation.benchmarks.collection.read_folder` returned
    :param best_known: Best-known values by the name of the instance
    :param out_dir: Folder of the files, created if missing
    :param seed: Seed of the solvers
    :param progress: As of :func:`~sb3_uav.evaluation.run.evaluate`
    :param time_limits: As of :func:`~sb3_uav.evaluation.run.evaluate`
    :param n_jobs: As of :func:`~sb3_uav.evaluation.run.evaluate`
    :param resume: As of :func:`~sb3_uav.evaluation.run.evaluate`
    :param use_rounding: Whether to put further tasks into tours of OPLib files where rounding leaves room for them
    :param shard: The part of every set to evaluate
    :param about: Further entries of the description of this run in ``evaluation.json``
    :return: One row for every result in the folder
    :raises ValueError: If no instance has a best-known value, or as :func:`~sb3_uav.evaluation.run.evaluate` says
    """
    if not set(best_known) & set(benchmark.instances):
        raise ValueError(
            f"{benchmark.path}: none of its instances has a best-known value; they have names like "
            f"{next(iter(benchmark.instances))!r}, the best-known values like {next(iter(best_known), '')!r}."
        )
    sets = evaluation_sets(list(benchmark.instances.values()))
    folder = Path(out_dir)

    def on_progress(text: str, n_done: int, n_total: int) -> None:
        # Not before: the folder may turn out to hold something else. These files describe the earlier results.
        for name in (GAPS_FILE, ROUTES_FILE, SUMMARY_FILE, CURVE_FILE):
            (folder / name).unlink(missing_ok=True)
        if progress is not None:
            progress(text, n_done, n_total)

    sources = {name: batch_of(members) for name, members in sets.items()}
    evaluate(solvers, sources, folder, seed, on_progress, time_limits, n_jobs, resume=resume, shard=shard, about=about)
    return compare_results(folder, benchmark, best_known, use_rounding)


def compare_results(
    folder: Path, benchmark: BenchmarkFolder, best_known: Mapping[str, float], use_rounding: bool = False
) -> list[GapRow]:
    """
    Compare all results in the folder of an evaluation with the best-known values, and write what a benchmark adds.

    :param folder: The folder
    :param benchmark: As of :func:`run_benchmark`
    :param best_known: As of :func:`run_benchmark`
    :param use_rounding: As of :func:`run_benchmark`
    :return: One row for every result in the folder
    :raises ValueError: If a file of the folder is damaged
    """
    members = [instance for group in evaluation_sets(list(benchmark.instances.values())).values() for instance in group]
    with locked_folder(folder):
        rows, routes = find_gaps(folder, members, best_known, use_rounding)
        write_gaps(folder, rows, routes)
        write_atomically(folder / SUMMARY_FILE, summary_text(benchmark, best_known, rows))
    return rows


def check_same_instances(folder: Path, benchmark: BenchmarkFolder) -> None:
    """
    :param folder: Folder of an evaluation
    :param benchmark: A benchmark
    :raises ValueError: If it is not the one that was evaluated
    """
    try:
        described = read_json_file(folder / SETTINGS_FILE)["instances"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{folder / SETTINGS_FILE}: does not describe an evaluation ({error}).") from error
    sets = evaluation_sets(list(benchmark.instances.values()))
    if described != [one.description() for one in instance_sets({name: batch_of(of) for name, of in sets.items()})]:
        raise ValueError(
            f"{benchmark.path}: holds other instances than those that {folder} has results of; give the folder of that "
            "benchmark with --benchmark."
        )

"""Running solvers on the same instances, with one independent check of everything that they return."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.folder import EvaluationFolder
from sb3_uav.evaluation.instance_sets import InstanceFiles, InstanceSet, instance_sets
from sb3_uav.evaluation.locking import locked_folder
from sb3_uav.evaluation.parallel import Failure, Runner
from sb3_uav.evaluation.set_evaluation import Progress, SetEvaluation
from sb3_uav.evaluation.shard import Shard
from sb3_uav.evaluation.summary import SUMMARY_CSV, SUMMARY_JSON, SummaryRow, summarize, write_summary
from sb3_uav.solvers.base import Solver

logger = logging.getLogger(__name__)


def evaluate(
    solvers: Sequence[Solver],
    instances: Instances | Mapping[str, Instances | InstanceFiles],
    out_dir: str | os.PathLike[str],
    seed: int = 0,
    progress: Progress | None = None,
    time_limits: Sequence[float | None] = (None,),
    n_jobs: int = 1,
    reference: str | None = None,
    resume: bool = False,
    shard: Shard = Shard(),  # noqa: B008 (a tuple)
    about: Mapping[str, Any] | None = None,
) -> list[SummaryRow]:
    """
    Run every solver on every instance, check all schedules, and compare the solvers.

    Writes ``results.csv`` and ``schedules.jsonl``, row by row as results become known; ``evaluation.json``, which describes
    instances, solvers, settings and versions; and at the end ``summary.csv`` and ``summary.json``. With several
    sets of instances, the column ``instance`` counts through all of them in the order given. The schedule of an
    instance depends on the seed and on the row of the instance in its set, or in its file where a set has several.

    A schedule that the checker refuses is written with ``feasible`` False and without an objective. Where a solver refuses the
    instances or fails on one, ``status`` is ``failed`` and ``message`` says why; the other solvers are still evaluated.

    :param solvers: The solvers, with different names
    :param instances: The instances, or several named sets of them; of sets in files, one file at a time is in memory
    :param out_dir: Folder of the files, created if missing
    :param seed: Seed of the solvers
    :param progress: Called before each solver starts on each set and after each of its instances
    :param time_limits: Seconds per instance for solvers that use them, None for their default; all are run one after the other
    :param n_jobs: In how many processes to run solvers that treat instances one by one; each has one thread, and their times
        are those of a busy machine. Scripts need the usual ``if __name__ == "__main__"``
    :param reference: Name of the solver that the others are compared with; the first when None
    :param resume: Keep the results of the same solvers and instances in the folder, except failed ones, instead of starting
        over. Solvers are the same if their names and settings are: change the name when you change the code
    :param shard: The part of every set to evaluate; :func:`~sb3_uav.evaluation.merge.merge` joins the folders of all parts
    :param about: Further entries of the description of this run in ``evaluation.json``
    :return: One row per set, time limit and solver, in this order; without sets of which the shard holds nothing
    :raises ValueError: If there is nothing to do, an argument is not allowed, two solvers have the same name, every solver
        refuses the instances, the folder cannot be written, or it holds results that cannot be resumed
    """
    time_limits = [None if time_limit is None else float(time_limit) for time_limit in time_limits]
    _check_arguments(solvers, instances, seed, time_limits)
    sets = instance_sets(instances)
    reference = find_reference(solvers, reference)
    refusals = _refusals(solvers, sets)
    run = {
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "solvers": [solver.name for solver in solvers],
        "reference": reference,
        "seed": seed,
        "time_limits": time_limits,
        "n_jobs": n_jobs,
        **({} if shard.is_whole else {"shard": str(shard)}),
        **(about or {}),
    }
    out_dir = Path(out_dir)
    summary: list[SummaryRow] = []
    with Runner(n_jobs) as runner, locked_folder(out_dir):
        with EvaluationFolder(out_dir, sets, solvers, run, resume, shard) as folder:
            if folder.changed_versions:
                changes = ", ".join(folder.changed_versions)
                logger.warning(f"{out_dir}: holds results of other versions ({changes}); --overwrite starts over.")
            # They describe the earlier results.
            for name in (SUMMARY_CSV, SUMMARY_JSON):
                (out_dir / name).unlink(missing_ok=True)
            for one in sets:
                rows = shard.rows(len(one))
                evaluation = SetEvaluation(one, seed, folder, runner, refusals[one.name], shard, progress)
                for time_limit in time_limits if rows else ():
                    results = {solver.name: evaluation.figures(solver, time_limit) for solver in solvers}
                    summary += summarize(one.name, np.array(rows), results, reference, time_limit)
        part = {} if shard.is_whole else {"shard": str(shard)}
        write_summary(summary, out_dir, {"reference": reference, "seed": seed, **part})
    return summary


def find_reference(solvers: Sequence[Solver], reference: str | None) -> str:
    """
    :param solvers: The solvers
    :param reference: Name of one of them, or its beginning up to the colon; the first one when None
    :return: The whole name
    :raises ValueError: If it names none of them, or several
    """
    names = [solver.name for solver in solvers]
    if reference is None:
        return names[0]
    found = [name for name in names if name == reference] or [name for name in names if name.partition(":")[0] == reference]
    if len(found) != 1:
        raise ValueError(f"The reference {reference!r} is {'none' if not found else 'several'} of the solvers {names}.")
    return found[0]


def _check_arguments(
    solvers: Sequence[Solver],
    instances: Instances | Mapping[str, Instances | InstanceFiles],
    seed: int,
    time_limits: Sequence[float | None],
) -> None:
    """
    :raises ValueError: If an argument of :func:`evaluate` is not allowed
    """
    names = [solver.name for solver in solvers]
    sources = ["instances"] if isinstance(instances, Instances) else list(instances)
    if not names or not sources or not time_limits:
        raise ValueError("There is nothing to evaluate: give at least one solver and one set of instances.")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"Solver {name!r} is given twice; every solver needs a name of its own.")
    for name in (*names, *sources):
        if "\n" in name or "\r" in name:
            raise ValueError(f"The name {name!r} breaks the line; give another one.")
    if seed < 0:
        raise ValueError(f"The seed is {seed}; it must be at least 0.")
    for time_limit in time_limits:
        # Each solver decides whether 0 is enough.
        if time_limit is not None and not 0 <= time_limit < math.inf:
            raise ValueError(f"A time limit is {time_limit}; it must be a number of seconds, at least 0.")
        if time_limits.count(time_limit) > 1:
            raise ValueError(f"The time limit {time_limit} is given twice.")


def _refusals(solvers: Sequence[Solver], sets: Sequence[InstanceSet]) -> dict[str, dict[tuple[int, str], str]]:
    """
    :param solvers: The solvers
    :param sets: The sets of instances
    :return: Why a solver cannot solve a part of a set: by the name of the set, then by the first row of the part and the name
        of the solver
    :raises ValueError: If no solver can solve anything
    """
    refusals: dict[str, dict[tuple[int, str], str]] = {one.name: {} for one in sets}
    reasons: dict[tuple[str, str], dict[str, None]] = {}
    n_parts = 0
    for one in sets:
        for first, _ in one.places():
            batch = one.part_at(first)
            n_parts += 1
            for solver in solvers:
                try:
                    solver.check(batch)
                except Exception as error:
                    # Any exception: the other solvers are still evaluated.
                    why = refusals[one.name][first, solver.name] = Failure.of(error).message
                    reasons.setdefault((solver.name, why), {})[one.name] = None
    if sum(map(len, refusals.values())) == len(solvers) * n_parts:
        raise ValueError(
            " ".join(
                f"{'; '.join(names)}: {solver} cannot solve these instances: {why}" for (solver, why), names in reasons.items()
            )
        )
    return refusals

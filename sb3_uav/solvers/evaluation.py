"""Running solvers on the same instances, with one independent check of everything that they return."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import InfeasibleScheduleError, ScheduleReport, check_schedule, schedule_to_json
from sb3_uav.solvers.base import Solver

RESULT_COLUMNS = ("solver", "instance", "n_uavs", "n_tasks", "objective", "length", "seconds", "feasible")
RESULTS_FILE = "results.csv"
SCHEDULES_FILE = "schedules.jsonl"
# Where the output is not a terminal, rich assumes 80 columns and would break the names of solvers.
FILE_WIDTH = 120


@dataclass(frozen=True)
class SummaryRow:
    """
    What one solver achieved on one set of instances.

    :param solver: Name of the solver
    :param source: Name of the set
    :param n_instances: Number of its instances
    :param objective: Mean objective of the feasible schedules; NaN if there are none
    :param standard_error: Of that mean; NaN with fewer than two
    :param seconds: Mean wall time per instance
    :param batch_size: How many instances were solved at once (the largest batch)
    :param violations: What the checker said of infeasible schedules, one line each
    """

    solver: str
    source: str
    n_instances: int
    objective: float
    standard_error: float
    seconds: float
    batch_size: int
    violations: tuple[str, ...] = ()


def evaluate(
    solvers: Sequence[Solver],
    instances: Instances | Mapping[str, Instances],
    out_dir: str | os.PathLike[str],
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> list[SummaryRow]:
    """
    Run every solver on every instance, check all schedules, and write ``results.csv`` and ``schedules.jsonl``.

    With several sets of instances, the column ``instance`` counts through all of them in the order given. A schedule that the
    checker refuses is written with ``feasible`` False and without an objective. The files appear when all has been done;
    until then, whatever an earlier evaluation wrote there stays.

    :param solvers: The solvers, with different names
    :param instances: The instances, or several named sets of them
    :param out_dir: Folder of the two files, created if missing
    :param seed: Seed of the solvers
    :param progress: Called with a line of text before each solver starts on each set
    :return: One row per solver and set, in the order of the sets
    :raises ValueError: If there is nothing to do, two solvers have the same name, the folder cannot be written, or a solver
        refuses the instances
    """
    sets = {"instances": instances} if isinstance(instances, Instances) else dict(instances)
    names = [solver.name for solver in solvers]
    if not names or not sets:
        raise ValueError("There is nothing to evaluate: give at least one solver and one set of instances.")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"Solver {name!r} is given twice; every solver needs a name of its own.")
    for source, batch in sets.items():
        for solver in solvers:
            try:
                solver.check(batch)
            except ValueError as error:
                raise ValueError(f"{source}: {solver.name} cannot solve these instances: {error}") from error
    summary = []
    with ExitStack() as stack:
        log = _ResultLog(
            stack.enter_context(replaced_when_complete(Path(out_dir) / RESULTS_FILE)),
            stack.enter_context(replaced_when_complete(Path(out_dir) / SCHEDULES_FILE)),
        )
        first_index = 0
        for source, batch in sets.items():
            batch = batch.to("cpu")
            for solver in solvers:
                if progress is not None:
                    progress(f"{solver.name} on {source}: {len(batch)} instances")
                summary.append(_evaluate_solver(solver, source, batch, first_index, seed, log))
            first_index += len(batch)
    return summary


class _ResultLog:
    """
    The two files of an evaluation.

    :param results: Opened ``results.csv``
    :param schedules: Opened ``schedules.jsonl``
    """

    def __init__(self, results: TextIO, schedules: TextIO) -> None:
        self._results = csv.writer(results, lineterminator="\n")
        self._results.writerow(RESULT_COLUMNS)
        self._schedules = schedules

    def write(self, row: dict[str, Any], schedule: dict[str, Any]) -> None:
        """
        :param row: Value of every column of ``results.csv``; None becomes an empty cell
        :param schedule: One line of ``schedules.jsonl``
        """
        self._results.writerow([row[column] for column in RESULT_COLUMNS])
        self._schedules.write(json.dumps(schedule) + "\n")


def _evaluate_solver(
    solver: Solver, source: str, instances: Instances, first_index: int, seed: int, log: _ResultLog
) -> SummaryRow:
    """
    :param solver: The solver
    :param source: Name of the set of instances
    :param instances: The set
    :param first_index: Index of its first instance in the files
    :param seed: Seed of the solver
    :param log: Where to write
    :return: What the solver achieved
    """
    results = solver.solve(instances, seed=seed)
    objectives, violations = [], []
    for row, (n_tasks, result) in enumerate(zip(instances.task_mask.sum(1).tolist(), results, strict=True)):
        report: ScheduleReport | None = None
        try:
            report = check_schedule(instances, row, result.schedule)
            objectives.append(report.objective)
        except InfeasibleScheduleError as error:
            violations.append(f"{solver.name}, instance {row} of {source}: {error}")
        index = first_index + row
        line = schedule_to_json(solver.name, index, result.schedule, report or ScheduleReport(math.nan, ()))
        if report is None:
            # JSON has no NaN.
            line["objective"] = None
        log.write(
            {
                "solver": solver.name,
                "instance": index,
                "n_uavs": instances.n_uavs,
                "n_tasks": n_tasks,
                "objective": None if report is None else report.objective,
                "length": None if report is None else report.length,
                "seconds": result.seconds,
                "feasible": report is not None,
            },
            line,
        )
    n_feasible = len(objectives)
    return SummaryRow(
        solver=solver.name,
        source=source,
        n_instances=len(instances),
        objective=float(np.mean(objectives)) if n_feasible > 0 else math.nan,
        standard_error=float(np.std(objectives, ddof=1)) / math.sqrt(n_feasible) if n_feasible > 1 else math.nan,
        seconds=math.fsum(result.seconds for result in results) / len(results),
        batch_size=max(result.batch_size for result in results),
        violations=tuple(violations),
    )


@contextmanager
def replaced_when_complete(path: Path) -> Iterator[TextIO]:
    """
    Write a text file under a temporary name, which is renamed when the ``with`` block ends without an exception.

    :param path: The file to write; its folder is created if missing
    :raises ValueError: If it cannot be written there
    """
    temporary = path.with_name(path.name + ".tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(temporary, "w", encoding="utf-8", newline="")
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror}); choose another output folder.") from error
    try:
        with file:
            yield file
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def require_rich() -> Any:
    """
    :return: The module ``rich`` with its tables
    :raises ImportError: With the command that installs it
    """
    try:
        import rich.console
        import rich.table
        import rich.text
    except ImportError as error:
        raise ImportError("Printing tables needs rich; run: pip install 'sb3-uav[solvers]'") from error
    return rich


def print_table(summary: Sequence[SummaryRow]) -> None:
    """
    Print a summary as a table on the standard output.

    :param summary: What :func:`evaluate` returned
    :raises ImportError: If rich is not installed
    """
    rich = require_rich()
    console = rich.console.Console()
    for source, rows in groupby(summary, key=lambda row: row.source):
        table, n_instances = rich.table.Table(), 0
        table.add_column("Solver", no_wrap=True)
        # Short enough for a terminal of 80 columns.
        for heading in ("Obj.", "Std.\nerror", "s per\ninstance", "Batch", "Infea-\nsible"):
            table.add_column(heading, justify="right", no_wrap=True)
        for row in rows:
            n_instances = row.n_instances
            table.add_row(
                # Text, because rich would take brackets in a name for markup.
                rich.text.Text(row.solver),
                _figure(row.objective, 2),
                _figure(row.standard_error, 2),
                _figure(row.seconds, 4),
                str(row.batch_size),
                str(len(row.violations)),
            )
        table.title = rich.text.Text(f"{source}: {n_instances} instances")
        if not console.is_terminal:
            console.width = FILE_WIDTH
        console.print(table)


def _figure(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"

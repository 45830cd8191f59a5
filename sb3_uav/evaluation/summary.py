"""Summaries of results: means, gaps, and differences on the same instances."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.common.statistics import CONFIDENCE, confidence_halfwidth
from sb3_uav.evaluation.results import FAILED, INFEASIBLE, RESULTS_FILE, ResultRow

SUMMARY_CSV, SUMMARY_JSON = "summary.csv", "summary.json"
# Solvers prove bounds up to rounding errors.
_BOUND_TOLERANCE = 1e-6


@dataclass(frozen=True)
class SummaryRow:
    """
    The results of one solver on one set of instances. Unknown figures are NaN.

    :param solver: Name of the solver
    :param source: Name of the set
    :param time_limit: Seconds that solvers were given for each instance; None without a limit
    :param n_instances: Number of instances
    :param n_feasible: On how many of them the solver found a feasible schedule
    :param objective: Mean objective of the feasible schedules
    :param standard_error: Standard error of that mean
    :param gap: See :func:`gaps`, in percent; NaN if the solver has no feasible schedule for some of the instances
    :param reference: Name of the solver that this one is compared with
    :param n_paired: On how many instances both found a feasible schedule
    :param difference: Mean over these of the objective minus the objective of the reference
    :param difference_low: Lower end of its confidence interval, see :func:`confidence_halfwidth`
    :param difference_high: Upper end of its confidence interval
    :param ratio: Mean objective divided by that of the reference, on the same instances
    :param n_bounds: For how many instances the solver proved a bound
    :param bound: Mean of these bounds
    :param optimality_gap: See :func:`_optimality_gap`, in percent, with the best bounds of all solvers
    :param seconds: Mean wall time per instance
    :param batch_size: How many instances were solved at once (the largest batch)
    :param n_unserved: How many tasks that must be served the feasible schedules leave out, all together. Means, gaps and
        differences are of values alone
    :param violations: Infeasible schedules and wrong bounds, one line each
    :param failures: Reasons of failures with the number of instances, one line each
    :param unserved: On how many instances tasks that must be served are left out, if on any
    """

    solver: str
    source: str
    time_limit: float | None
    n_instances: int
    n_feasible: int
    objective: float
    standard_error: float
    gap: float
    reference: str
    n_paired: int
    difference: float
    difference_low: float
    difference_high: float
    ratio: float
    n_bounds: int
    bound: float
    optimality_gap: float
    seconds: float
    batch_size: int
    n_unserved: int = 0
    violations: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()
    unserved: tuple[str, ...] = ()


_MESSAGES = ("violations", "failures", "unserved")
_SUMMARY_COLUMNS = tuple(field.name for field in fields(SummaryRow) if field.name not in _MESSAGES)


def gaps(objectives: Sequence[float]) -> list[float]:
    """
    The gap of every method to the best one (paper, equation (25)).

    ``Gap = (Obj_best - Obj) / Obj_best * 100 %``, "the normalized distance between an average objective value Obj and the best
    one Obj_best found among all methods".

    :param objectives: Average objective of every method on the same instances; NaN where there is none
    :return: The gap of each in percent; 0 if the best objective is 0
    """
    best = max((objective for objective in objectives if not math.isnan(objective)), default=math.nan)
    return [objective if math.isnan(objective) else 100 * (best - objective) / (best or 1.0) for objective in objectives]


def _optimality_gap(objectives: np.ndarray, bounds: np.ndarray) -> float:
    """
    How far objectives may be from the optimum: the mean of ``(bound - objective) / bound`` over the instances that have both.

    :param objectives: ``(n,)``, NaN where there is none
    :param bounds: ``(n,)`` upper bounds, NaN where none is known
    :return: In percent; an instance with bound 0 counts as solved; NaN if no instance has both
    """
    both = ~np.isnan(objectives) & ~np.isnan(bounds)
    if not both.any():
        return math.nan
    distance = np.maximum(bounds[both] - objectives[both], 0.0)
    return float(100 * np.mean(distance / np.where(bounds[both] > 0, bounds[both], 1.0)))


def summarize(
    source: str, results: Mapping[str, Sequence[ResultRow]], reference: str, time_limit: float | None = None
) -> list[SummaryRow]:
    """
    Compare solvers on one set of instances.

    :param source: Name of the set
    :param results: Results of every solver, of the same instances in the same order
    :param reference: Name of the solver that the others are compared with
    :param time_limit: Seconds that solvers were given for each instance
    :return: One row per solver
    """
    objectives = {solver: _column(rows, "objective") for solver, rows in results.items()}
    bounds = {solver: _column(rows, "bound") for solver, rows in results.items()}
    complete = [float(values.mean()) for values in objectives.values()]
    best_bounds = np.fmin.reduce(list(bounds.values()))
    best_found = np.fmax.reduce(list(objectives.values()))
    summary = []
    for (solver, rows), gap in zip(results.items(), gaps(complete), strict=True):
        found = objectives[solver][~np.isnan(objectives[solver])]
        paired = ~np.isnan(objectives[solver]) & ~np.isnan(objectives[reference])
        differences = (objectives[solver] - objectives[reference])[paired]
        difference, halfwidth = _mean(differences), float(confidence_halfwidth(differences))
        reference_objective = _mean(objectives[reference][paired])
        seconds = _column(rows, "seconds")
        summary.append(
            SummaryRow(
                solver=solver,
                source=source,
                time_limit=time_limit,
                n_instances=len(rows),
                n_feasible=len(found),
                objective=_mean(found),
                standard_error=float(np.std(found, ddof=1)) / math.sqrt(len(found)) if len(found) > 1 else math.nan,
                gap=gap,
                reference=reference,
                n_paired=int(paired.sum()),
                difference=difference,
                difference_low=difference - halfwidth,
                difference_high=difference + halfwidth,
                ratio=_mean(objectives[solver][paired]) / reference_objective if reference_objective > 0 else math.nan,
                n_bounds=int((~np.isnan(bounds[solver])).sum()),
                bound=_mean(bounds[solver][~np.isnan(bounds[solver])]),
                optimality_gap=_optimality_gap(objectives[solver], best_bounds),
                seconds=_mean(seconds[~np.isnan(seconds)]),
                batch_size=max(row.batch_size or 0 for row in rows),
                n_unserved=sum(row.unserved or 0 for row in rows),
                violations=(*_violations(rows), *_wrong_bounds(rows, best_found)),
                failures=_failures(rows),
                unserved=_unserved(rows),
            )
        )
    return summary


def _column(rows: Sequence[ResultRow], name: str) -> np.ndarray:
    """One column of the results, ``(n,)`` float64, NaN where it is None."""
    values = [getattr(row, name) for row in rows]
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _mean(values: np.ndarray) -> float:
    return math.fsum(values) / len(values) if len(values) > 0 else math.nan


def _violations(rows: Sequence[ResultRow]) -> list[str]:
    return [
        f"{row.solver}, instance {row.instance - rows[0].instance} of {row.source}: {row.message}"
        for row in rows
        if row.status == INFEASIBLE
    ]


def _wrong_bounds(rows: Sequence[ResultRow], best_found: np.ndarray) -> list[str]:
    """
    :param rows: Results of one solver
    :param best_found: ``(n,)``, best objective of all solvers; NaN where there is none
    :return: Which of its bounds cannot be true
    """
    return [
        f"{row.solver}, instance {row.instance - rows[0].instance} of {row.source}: its upper bound of {row.bound:g} is below "
        f"{best:g}, which a feasible schedule achieves."
        for row, best in zip(rows, best_found, strict=True)
        if row.bound is not None and best > row.bound + _BOUND_TOLERANCE * max(1.0, abs(row.bound))
    ]


def _failures(rows: Sequence[ResultRow]) -> tuple[str, ...]:
    """
    :param rows: Results of one solver
    :return: The reasons, each once
    """
    counts: dict[str, int] = {}
    for row in rows:
        if row.status == FAILED:
            counts[row.message] = counts.get(row.message, 0) + 1
    return tuple(
        f"{rows[0].solver} failed on {count} of {len(rows)} instances of {rows[0].source}: {message}"
        for message, count in counts.items()
    )


def _unserved(rows: Sequence[ResultRow]) -> tuple[str, ...]:
    """
    :param rows: Results of one solver
    :return: On how many instances it leaves tasks that must be served, because means of values do not show that
    """
    n_rows = sum((row.unserved or 0) > 0 for row in rows)
    if n_rows == 0:
        return ()
    text = "leaves out tasks that must be served, so that its value is no measure of how good its schedules are"
    return (f"{rows[0].solver}, {n_rows} of {len(rows)} instances of {rows[0].source}: {text}; see {RESULTS_FILE}.",)


def write_summary(summary: Sequence[SummaryRow], folder: Path, about: Mapping[str, Any]) -> None:
    """
    Write ``summary.csv`` and ``summary.json``. NaN becomes an empty cell and null.

    :param summary: What :func:`summarize` returned
    :param folder: Where to write
    :param about: Further entries of ``summary.json``
    """
    rows = [
        {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in asdict(row).items()}
        for row in summary
    ]
    with replaced_when_complete(folder / SUMMARY_CSV) as file:
        write_csv(file, _SUMMARY_COLUMNS, ([row[column] for column in _SUMMARY_COLUMNS] for row in rows))
    with replaced_when_complete(folder / SUMMARY_JSON) as file:
        json.dump({**about, "confidence": CONFIDENCE, "rows": rows}, file, indent=2, allow_nan=False)
        file.write("\n")

"""Summaries of results: means, gaps, and differences on the same instances."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.common.statistics import CONFIDENCE, confidence_halfwidth
from sb3_uav.evaluation.result_index import Figures
from sb3_uav.evaluation.results import FAILED, INFEASIBLE, RESULTS_FILE

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
    source: str, rows: np.ndarray, results: Mapping[str, Figures], reference: str, time_limit: float | None = None
) -> list[SummaryRow]:
    """
    Compare solvers on one set of instances.

    :param source: Name of the set
    :param rows: ``(n,)`` rows of the instances in the set, at least one
    :param results: Results of every solver on these instances, in the same order
    :param reference: Name of the solver that the others are compared with
    :param time_limit: Seconds that solvers were given for each instance
    :return: One row per solver
    """
    complete = [float(figures.objective.mean()) for figures in results.values()]
    best_bounds = np.fmin.reduce([figures.bound for figures in results.values()])
    best_found = np.fmax.reduce([figures.objective for figures in results.values()])
    baseline = results[reference].objective
    summary = []
    for (solver, figures), gap in zip(results.items(), gaps(complete), strict=True):
        objectives, bounds, seconds = figures.objective, figures.bound, figures.seconds
        found = objectives[~np.isnan(objectives)]
        paired = ~np.isnan(objectives) & ~np.isnan(baseline)
        differences = (objectives - baseline)[paired]
        difference, halfwidth = _mean(differences), float(confidence_halfwidth(differences))
        reference_objective = _mean(baseline[paired])
        messages = _Messages(solver, source, rows, figures)
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
                ratio=_mean(objectives[paired]) / reference_objective if reference_objective > 0 else math.nan,
                n_bounds=int((~np.isnan(bounds)).sum()),
                bound=_mean(bounds[~np.isnan(bounds)]),
                optimality_gap=_optimality_gap(objectives, best_bounds),
                seconds=_mean(seconds[~np.isnan(seconds)]),
                batch_size=int(figures.batch_size.max()),
                n_unserved=int(figures.unserved.sum()),
                violations=(*messages.violations(), *messages.wrong_bounds(best_found)),
                failures=messages.failures(),
                unserved=messages.unserved(),
            )
        )
    return summary


def _mean(values: np.ndarray) -> float:
    return math.fsum(values) / len(values) if len(values) > 0 else math.nan


class _Messages(NamedTuple):
    """
    What is to be said of the results of a solver.

    :param solver: Its name
    :param source: Name of the set
    :param rows: ``(n,)`` rows of the instances in the set
    :param figures: The results on these
    """

    solver: str
    source: str
    rows: np.ndarray
    figures: Figures

    def violations(self) -> list[str]:
        """:return: Why schedules are infeasible"""
        places = np.nonzero(self.figures.has_status(INFEASIBLE))[0].tolist()
        return [f"{self._instance(place)}: {self.figures.messages[place]}" for place in places]

    def _instance(self, place: int) -> str:
        return f"{self.solver}, instance {self.rows[place]} of {self.source}"

    def wrong_bounds(self, best_found: np.ndarray) -> list[str]:
        """
        :param best_found: ``(n,)``, best objective of all solvers; NaN where there is none
        :return: Which bounds cannot be true
        """
        bounds = self.figures.bound
        wrong = best_found > bounds + _BOUND_TOLERANCE * np.maximum(1.0, np.abs(bounds))
        return [
            f"{self._instance(place)}: its upper bound of {bounds[place]:g} is below {best_found[place]:g}, which a feasible "
            "schedule achieves."
            for place in np.nonzero(wrong)[0].tolist()
        ]

    def failures(self) -> tuple[str, ...]:
        """:return: The reasons, each once"""
        failed = np.nonzero(self.figures.has_status(FAILED))[0].tolist()
        counts = Counter(self.figures.messages[place] for place in failed)
        return tuple(
            f"{self.solver} failed on {count} of {len(self.rows)} instances of {self.source}: {message}"
            for message, count in counts.items()
        )

    def unserved(self) -> tuple[str, ...]:
        """:return: On how many instances it leaves tasks that must be served, because means of values do not show that"""
        n_rows = int((self.figures.unserved > 0).sum())
        if n_rows == 0:
            return ()
        text = "leaves out tasks that must be served, so that its value is no measure of how good its schedules are"
        return (f"{self.solver}, {n_rows} of {len(self.rows)} instances of {self.source}: {text}; see {RESULTS_FILE}.",)


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

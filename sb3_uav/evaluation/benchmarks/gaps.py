"""Gaps to best-known values, from the results of an evaluation: ``gaps.csv`` and ``routes.jsonl``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule, check_schedule
from sb3_uav.evaluation.benchmarks.instance import BenchmarkInstance
from sb3_uav.evaluation.benchmarks.rounding import check_rounded, fill, fit_to_rule
from sb3_uav.evaluation.results import (
    FAILED,
    INFEASIBLE,
    OK,
    RESULTS_FILE,
    SCHEDULES_FILE,
    ResultRow,
    one_line,
    read_results,
    read_schedules,
)

GAPS_FILE, ROUTES_FILE = "gaps.csv", "routes.jsonl"
# Values are sums of floats.
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class GapRow:
    """
    One line of ``gaps.csv``: a result, compared with the best-known value. Unknown values are None, and empty cells.

    :param instance: Name of the instance
    :param group: Its group
    :param solver: Name of the solver
    :param time_limit: Seconds that the solver was given
    :param seed: Seed of the solver
    :param status: ``ok``, ``infeasible`` or ``failed``
    :param best_known: The best-known value
    :param objective: Total value of the routes that count, under the rule of the file; with the score of the depot, if the
        file gives it one
    :param gap: How far the objective is below the best-known value, in percent of that; negative above it. 0 if both are 0
    :param reached: Whether the objective is at least the best-known value, and nothing is left out that must be served
    :param better: Whether it is more, and nothing is left out that must be served
    :param length: Total length of these routes, under the rule of the file
    :param euclidean_objective: What the solver found with Euclidean lengths, with the score of the depot
    :param n_dropped: How many tasks the rule of the file made drop
    :param n_added: How many tasks were put in because that rule admits more, on demand
    :param seconds: Wall time of the solver: that of its batch, divided by the size of the batch
    :param batch_size: How many instances were solved at once
    :param message: Why there is no objective; with one, which tasks that must be served are not
    :param unserved: How many tasks that must be served the routes that count leave out; None without an objective
    """

    instance: str
    group: str
    solver: str
    time_limit: float | None
    seed: int
    status: str
    best_known: float | None
    objective: float | None
    gap: float | None
    reached: bool
    better: bool
    length: float | None
    euclidean_objective: float | None
    n_dropped: int
    n_added: int
    seconds: float | None
    batch_size: int | None
    message: str
    unserved: int | None = None


GAP_COLUMNS = tuple(field.name for field in fields(GapRow))


def gap_to(best_known: float, objective: float) -> float:
    """
    :param best_known: The best-known value
    :param objective: Objective of a schedule
    :return: In percent; 0 if there is nothing to reach
    """
    return 100 * (best_known - objective) / best_known if best_known > 0 else 0.0


def find_gaps(
    folder: Path, instances: Sequence[BenchmarkInstance], best_known: Mapping[str, float], use_rounding: bool = False
) -> tuple[list[GapRow], list[dict[str, Any]]]:
    """
    Compare all results in the folder of an evaluation.

    :param folder: The folder
    :param instances: The instances in the order in which they were evaluated
    :param best_known: Best-known values by name
    :param use_rounding: Whether to put further tasks into tours where a rounding rule leaves room for them
    :return: A row for every result; and for every objective the routes that count, by the numbers of their nodes in the file
    :raises ValueError: If a file of the folder is damaged
    """
    rows, routes = [], []
    schedules = read_schedules(folder / SCHEDULES_FILE)
    for result in read_results(folder / RESULTS_FILE):
        # A longer list of instances may have been evaluated before.
        if result.instance >= len(instances):
            continue
        instance = instances[result.instance]
        schedule = None
        if result.status == OK:
            schedule = Schedule(json.loads(schedules[result.key])["routes"])
        row, counted = _compared(instance, result, schedule, best_known.get(instance.name), use_rounding)
        rows.append(row)
        if counted is not None:
            routes.append(_route_line(instance, row, counted))
    return rows, routes


def _compared(
    instance: BenchmarkInstance,
    result: ResultRow,
    schedule: Schedule | None,
    best_known: float | None,
    use_rounding: bool,
) -> tuple[GapRow, Schedule | None]:
    """
    :param instance: An instance
    :param result: A result
    :param schedule: Its schedule, if it is feasible with Euclidean lengths
    :param best_known: The best-known value, if there is one
    :param use_rounding: As of :func:`find_gaps`
    :return: The comparison, and the schedule that counts
    """
    status, message = result.status, result.message
    objective = length = unserved = None
    counted = schedule
    n_dropped = n_added = 0
    if schedule is not None:
        try:
            counted, objective, length = _counted(instance, schedule, use_rounding)
        except InfeasibleScheduleError as error:
            status, message, counted = INFEASIBLE, one_line(error), None
        else:
            found, kept = ({task for route in of.routes for task in route} for of in (schedule, counted))
            n_dropped, n_added = len(found - kept), len(kept - found)
            unserved = len(_unserved(instance, counted))
    tolerance = _TOLERANCE * max(1.0, best_known or 0.0)
    # A larger value does not make up for what must be served.
    known = objective is not None and best_known is not None and unserved == 0
    difference = (objective or 0.0) - (best_known or 0.0)
    row = GapRow(
        instance=instance.name,
        group=instance.group,
        solver=result.solver,
        time_limit=result.time_limit,
        seed=result.seed,
        status=status,
        best_known=best_known,
        objective=objective,
        gap=gap_to(best_known, objective) if objective is not None and best_known is not None else None,
        reached=known and difference >= -tolerance,
        better=known and difference > tolerance,
        length=length,
        euclidean_objective=None if result.objective is None else result.objective + instance.depot_score,
        n_dropped=n_dropped,
        n_added=n_added,
        seconds=result.seconds,
        batch_size=result.batch_size,
        message=message,
        unserved=unserved,
    )
    return row, counted


def _unserved(instance: BenchmarkInstance, schedule: Schedule) -> list[int]:
    """:return: Numbers in the file of the tasks that must be served and that the schedule leaves out"""
    must_serve = instance.instances.must_serve
    if must_serve is None:
        return []
    served = {task for route in schedule.routes for task in route}
    return [node for task, node in enumerate(instance.nodes) if must_serve[0, task] and task not in served]


def _counted(instance: BenchmarkInstance, schedule: Schedule, use_rounding: bool) -> tuple[Schedule, float, float]:
    """
    :param instance: An instance
    :param schedule: A schedule of it
    :param use_rounding: As of :func:`find_gaps`
    :return: The schedule under the rule of the file; its objective and its length by that rule, as the checkers say, with the
        score of the depot
    :raises InfeasibleScheduleError: If a checker refuses it
    """
    if instance.is_rounded:
        schedule = fit_to_rule(instance.instances, schedule)
    report = check_schedule(instance.instances, 0, schedule)
    if not instance.is_rounded:
        return schedule, report.objective + instance.depot_score, report.length
    if use_rounding:
        schedule = fill(instance.instances, schedule)
    rounded = check_rounded(instance.instances, schedule)
    return schedule, rounded.objective + instance.depot_score, math.fsum(rounded.lengths)


def _route_line(instance: BenchmarkInstance, row: GapRow, schedule: Schedule) -> dict[str, Any]:
    """:return: A line of ``routes.jsonl``; ``unserved`` only if a task that must be served is not"""
    unserved = _unserved(instance, schedule)
    return {
        "instance": row.instance,
        "solver": row.solver,
        "time_limit": row.time_limit,
        "seed": row.seed,
        "objective": row.objective,
        "length": row.length,
        "routes": [[instance.nodes[task] for task in route] for route in schedule.routes],
        **({"unserved": unserved} if unserved else {}),
    }


def write_gaps(folder: Path, rows: Sequence[GapRow], routes: Sequence[Mapping[str, Any]]) -> None:
    """
    Write ``gaps.csv`` and ``routes.jsonl``.

    :param folder: Where to write
    :param rows: What :func:`find_gaps` returned
    :param routes: What :func:`find_gaps` returned
    """
    with replaced_when_complete(folder / ROUTES_FILE) as file:
        file.writelines(json.dumps(route) + "\n" for route in routes)
    with replaced_when_complete(folder / GAPS_FILE) as file:
        write_csv(file, GAP_COLUMNS, (astuple(row) for row in rows))


def failures(rows: Sequence[GapRow]) -> list[str]:
    """
    :param rows: What :func:`find_gaps` returned
    :return: Every reason of a failure once, with the number of instances, or the name of the only one
    """
    # Of the names, which keep their order; several time limits or seeds count once.
    found: dict[tuple[str, str, str], dict[str, None]] = {}
    for row in rows:
        if row.status in (FAILED, INFEASIBLE):
            found.setdefault((row.solver, row.status, row.message), {})[row.instance] = None
    return [
        f"{solver} {'failed' if status == FAILED else 'was infeasible'} on "
        f"{names[0] if len(names) == 1 else f'{len(names)} instances ({names[0]} to {names[-1]})'}: {message}"
        for (solver, status, message), names in ((key, list(value)) for key, value in found.items())
    ]

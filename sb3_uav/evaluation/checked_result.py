"""One independent check of every schedule: of a new one, and again of one that is read from a file."""

from __future__ import annotations

import json
import math
from typing import Any

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule, ScheduleReport, check_schedule, schedule_to_json
from sb3_uav.evaluation.parallel import Failure
from sb3_uav.evaluation.results import FAILED, INFEASIBLE, OK, RESULT_COLUMNS, SCHEDULES_FILE, ResultRow, one_line
from sb3_uav.solvers.base import SolverResult

# Other versions of Python round lengths differently, in the last digit.
_TOLERANCE = 1e-9


def checked_result(
    instance: tuple[Instances, int, int, str], run: tuple[str, float | None, int], result: SolverResult | Failure
) -> tuple[ResultRow, dict[str, Any] | None]:
    """
    :param instance: Instances, the row among them, its index in the files, and the name of the set
    :param run: Name of the solver, the seconds that it was given, and its seed
    :param result: Its result, or the failure
    :return: The line of ``results.csv``, and that of ``schedules.jsonl`` if there is a schedule
    """
    (batch, row, index, source), (solver, time_limit, seed) = instance, run
    report: ScheduleReport | None = None
    status, message = OK, ""
    line: dict[str, Any] | None = None
    if isinstance(result, Failure):
        status, message = FAILED, result.message
    else:
        try:
            report = check_schedule(batch, row, result.schedule)
        except InfeasibleScheduleError as error:
            status, message = INFEASIBLE, one_line(error)
        if report is not None and report.unserved:
            tasks = ", ".join(str(task) for task in report.unserved)
            message = f"does not serve tasks that must be served: {tasks}"
        line = schedule_to_json(solver, index, result.schedule, report or ScheduleReport(math.nan, ()))
        if report is None:
            # JSON has no NaN.
            line["objective"] = None
        line |= {"time_limit": time_limit, "seed": seed}
    solved = None if isinstance(result, Failure) else result
    bound = None if result.bound is None or not math.isfinite(result.bound) else float(result.bound)
    found = ResultRow(
        solver=solver,
        instance=index,
        n_uavs=batch.n_uavs,
        n_tasks=int(batch.task_mask[row].sum()),
        objective=None if report is None else report.objective,
        length=None if report is None else report.length,
        seconds=None if solved is None else solved.seconds,
        feasible=report is not None,
        source=source,
        time_limit=time_limit,
        seed=seed,
        batch_size=None if solved is None else solved.batch_size,
        bound=bound,
        status=status,
        message=message,
        unserved=None if report is None else len(report.unserved),
    )
    return found, line


def check_again(batch: Instances, row: int, kept: ResultRow, text: str | None) -> None:
    """
    Compare a result of a file with what the checker says of its routes. Only times, sizes of batches and bounds are believed,
    because nothing else tells of them, and the wording of messages, which changes from version to version.

    :param batch: Instances
    :param row: That of the result
    :param kept: The result
    :param text: Its line of ``schedules.jsonl``; None for a failure
    :raises ValueError: If a field differs; the message names it, and says what is right
    """
    run = kept.solver, kept.time_limit, kept.seed
    result: SolverResult | Failure = Failure(kept.message, kept.bound)
    record: dict[str, Any] = {}
    if text is not None:
        if kept.seconds is None or kept.batch_size is None or kept.batch_size < 1:
            raise ValueError(f"seconds is {kept.seconds} and batch_size is {kept.batch_size}, where a schedule was found")
        record = json.loads(text)
        result = SolverResult(_schedule(record), kept.seconds, kept.batch_size, kept.bound)
    found, line = checked_result((batch, row, kept.instance, kept.source), run, result)
    for column, was, is_now in zip(RESULT_COLUMNS, kept.cells, found.cells, strict=True):
        if column != "message" and not _is_same(was, is_now):
            why = "for a failure" if text is None else f"by the routes in {SCHEDULES_FILE}"
            raise ValueError(f"{column} is {was!r}, but {why} it is {is_now!r}")
    for name in {**(line or {}), **record}:
        was, is_now = record.get(name), (line or {}).get(name)
        if not _is_same(was, is_now):
            raise ValueError(f"{name} in {SCHEDULES_FILE} is {was!r:.80}, but by the routes there it is {is_now!r:.80}")


def _is_same(was: Any, is_now: Any) -> bool:
    """Whether two values are the same but for rounding."""
    # Most are; they are of one type, too.
    if type(was) is type(is_now) and was == is_now and type(was) is not list:
        return True
    if isinstance(was, list) and isinstance(is_now, list):
        return len(was) == len(is_now) and all(map(_is_same, was, is_now))
    if type(was) is bool or type(is_now) is bool or not (isinstance(was, int | float) and isinstance(is_now, int | float)):
        return bool(was == is_now)
    return math.isclose(was, is_now, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE)


def _schedule(record: dict[str, Any]) -> Schedule:
    """
    :param record: A line of ``schedules.jsonl``
    :return: Its schedule
    :raises ValueError: If its routes are no lists of task indices
    """
    routes: Any = record.get("routes")
    is_whole = isinstance(routes, list) and all(
        isinstance(route, list) and all(type(task) is int for task in route) for route in routes
    )
    if not is_whole:
        raise ValueError(f"routes in {SCHEDULES_FILE} is {routes!r:.80}, not lists of task indices")
    return Schedule(routes)

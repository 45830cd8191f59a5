"""Evaluating solvers on one set of instances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import InfeasibleScheduleError, ScheduleReport, check_schedule, schedule_to_json
from sb3_uav.evaluation.folder import EvaluationFolder
from sb3_uav.evaluation.parallel import Failure, Runner
from sb3_uav.evaluation.results import FAILED, INFEASIBLE, OK, ResultKey, ResultRow, one_line
from sb3_uav.solvers.base import Solver, SolverResult

# Description of the task, number of instances done, number of instances in all.
Progress = Callable[[str, int, int], None]


@dataclass(eq=False)
class SetEvaluation:
    """
    Evaluates solvers on one set of instances.

    :param source: Name of the set
    :param instances: The set, on the CPU
    :param first_index: Index of its first instance in the files
    :param seed: Seed of the solvers
    :param folder: Folder of earlier and new results
    :param runner: Runs the solvers
    :param progress: Called before each solver starts and after each of its instances
    """

    source: str
    instances: Instances
    first_index: int
    seed: int
    folder: EvaluationFolder
    runner: Runner
    progress: Progress | None
    _found: dict[tuple[str, float | None], list[ResultRow]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._n_tasks = self.instances.task_mask.sum(1).tolist()

    def rows(self, solver: Solver, time_limit: float | None, refusal: str | None) -> list[ResultRow]:
        """
        :param solver: A solver
        :param time_limit: Seconds per instance, if the solver uses them
        :param refusal: Why it cannot solve the set, if it cannot
        :return: Its results on all instances, earlier and new ones
        """
        time_limit = time_limit if solver.uses_time_limit else None
        if (solver.name, time_limit) not in self._found:
            self._found[solver.name, time_limit] = self._run(solver, time_limit, refusal)
        return self._found[solver.name, time_limit]

    def _run(self, solver: Solver, time_limit: float | None, refusal: str | None) -> list[ResultRow]:
        """Find the results that :meth:`rows` returns."""
        keys = [ResultKey(solver.name, self.first_index + row, time_limit, self.seed) for row in range(len(self.instances))]
        missing = [
            row for row, key in enumerate(keys) if key not in self.folder.rows or self.folder.rows[key].status == FAILED
        ]
        limit = "" if time_limit is None else f", {time_limit:g} s each"
        text = f"{solver.name} on {self.source}: {len(keys)} instances{limit}"
        if len(missing) < len(keys):
            text += f", {len(keys) - len(missing)} of them done before"
        n_done = len(keys) - len(missing)
        if self.progress is not None:
            self.progress(text, n_done, len(keys))
        if refusal is not None:
            for row in missing:
                self._add(solver, row, time_limit, Failure(refusal))
        else:
            for row, result in self.runner.run(solver, self.instances, missing, time_limit, self.seed):
                self._add(solver, row, time_limit, result)
                n_done += 1
                if self.progress is not None:
                    self.progress(text, n_done, len(keys))
        return [self.folder.rows[key] for key in keys]

    def _add(self, solver: Solver, row: int, time_limit: float | None, result: SolverResult | Failure) -> None:
        """
        Check a result and add it to the folder.

        :param solver: The solver
        :param row: Row of its instance in the set
        :param time_limit: Seconds that the solver was given
        :param result: The result, or the failure
        """
        report: ScheduleReport | None = None
        status, message = OK, ""
        line: dict[str, Any] | None = None
        if isinstance(result, Failure):
            status, message = FAILED, result.message
        else:
            try:
                report = check_schedule(self.instances, row, result.schedule)
            except InfeasibleScheduleError as error:
                status, message = INFEASIBLE, one_line(error)
            if report is not None and report.unserved:
                tasks = ", ".join(str(task) for task in report.unserved)
                message = f"does not serve tasks that must be served: {tasks}"
            index = self.first_index + row
            line = schedule_to_json(solver.name, index, result.schedule, report or ScheduleReport(math.nan, ()))
            if report is None:
                # JSON has no NaN.
                line["objective"] = None
        solved = None if isinstance(result, Failure) else result
        bound = None if result.bound is None or not math.isfinite(result.bound) else float(result.bound)
        self.folder.add(
            ResultRow(
                solver=solver.name,
                instance=self.first_index + row,
                n_uavs=self.instances.n_uavs,
                n_tasks=self._n_tasks[row],
                objective=None if report is None else report.objective,
                length=None if report is None else report.length,
                seconds=None if solved is None else solved.seconds,
                feasible=report is not None,
                source=self.source,
                time_limit=time_limit,
                seed=self.seed,
                batch_size=None if solved is None else solved.batch_size,
                bound=bound,
                status=status,
                message=message,
                unserved=None if report is None else len(report.unserved),
            ),
            line,
        )

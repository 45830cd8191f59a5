"""Evaluating solvers on one set of instances."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.checked_result import checked_result
from sb3_uav.evaluation.folder import EvaluationFolder
from sb3_uav.evaluation.instance_sets import InstanceSet
from sb3_uav.evaluation.parallel import Failure, Runner
from sb3_uav.evaluation.result_index import Figures
from sb3_uav.evaluation.results import FAILED
from sb3_uav.evaluation.shard import Shard
from sb3_uav.solvers.base import Solver, SolverResult

# Description of the task, number of instances done, number of instances in all.
Progress = Callable[[str, int, int], None]


@dataclass(eq=False)
class SetEvaluation:
    """
    Evaluates solvers on one set of instances.

    :param instances: The set
    :param seed: Seed of the solvers
    :param folder: Folder of earlier and new results
    :param runner: Runs the solvers
    :param refusals: Why a solver cannot solve a part of the set, by its first row and the name of the solver
    :param shard: Which of the instances to solve
    :param progress: Called before each solver starts and after each of its instances
    """

    instances: InstanceSet
    seed: int
    folder: EvaluationFolder
    runner: Runner
    refusals: Mapping[tuple[int, str], str]
    shard: Shard
    progress: Progress | None
    _found: dict[tuple[str, float | None], Figures] = field(default_factory=dict, init=False)

    def figures(self, solver: Solver, time_limit: float | None) -> Figures:
        """
        :param solver: A solver
        :param time_limit: Seconds per instance, if the solver uses them
        :return: Its results on the instances of the shard, earlier and new ones
        """
        time_limit = time_limit if solver.uses_time_limit else None
        if (solver.name, time_limit) not in self._found:
            self._found[solver.name, time_limit] = self._run(solver, time_limit)
        return self._found[solver.name, time_limit]

    def _run(self, solver: Solver, time_limit: float | None) -> Figures:
        """Find the results that :meth:`figures` returns."""
        rows = self.shard.rows(len(self.instances))
        numbers = self.instances.first_index + np.arange(rows.start, rows.stop)
        run = self.folder.index.run(solver.name, time_limit, self.seed)
        missing = (~run.present | run.has_status(FAILED))[numbers]
        n_done = len(rows) - int(missing.sum())
        limit = "" if time_limit is None else f", {time_limit:g} s each"
        text = f"{solver.name} on {self.instances.name}: {len(rows)} instances{limit}"
        if n_done > 0:
            text += f", {n_done} of them done before"
        self._report(text, n_done, len(rows))
        if missing.any():
            for first, batch, part in self._parts(rows, missing):
                for row, result in self._solve(solver, first, batch, part, time_limit):
                    self.folder.add(
                        *checked_result(
                            (batch, row, self.instances.first_index + first + row, self.instances.name),
                            (solver.name, time_limit, self.seed),
                            result,
                        )
                    )
                    if (first, solver.name) not in self.refusals:
                        n_done += 1
                        self._report(text, n_done, len(rows))
        return run.selected(numbers)

    def _parts(self, rows: range, missing: np.ndarray) -> Iterator[tuple[int, Instances, list[int]]]:
        """
        :param rows: Those of the shard
        :param missing: ``(len(rows),)`` bool, which of them have no result yet
        :return: First row of each part with such instances, its instances, and their rows in it
        """
        wanted = rows.start + np.nonzero(missing)[0]
        for first, size in self.instances.places():
            part = wanted[(wanted >= first) & (wanted < first + size)] - first
            if len(part) > 0:
                yield first, self.instances.part_at(first), part.tolist()

    def _solve(
        self, solver: Solver, first: int, batch: Instances, rows: list[int], time_limit: float | None
    ) -> Iterator[tuple[int, SolverResult | Failure]]:
        """:return: Row in the part, and result, of each instance"""
        refusal = self.refusals.get((first, solver.name))
        if refusal is not None:
            return ((row, Failure(refusal)) for row in rows)
        return self.runner.run(solver, batch, rows, time_limit, self.seed)

    def _report(self, text: str, n_done: int, n_all: int) -> None:
        if self.progress is not None:
            self.progress(text, n_done, n_all)

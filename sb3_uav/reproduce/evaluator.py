"""Evaluations on instances of the paper's distribution, shared by all tables and figures that need the same results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_uav.common.random_streams import REPRODUCTION_SEED, keyed_generator
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.results import RESULTS_FILE, read_results
from sb3_uav.evaluation.run import evaluate
from sb3_uav.evaluation.set_evaluation import Progress
from sb3_uav.evaluation.summary import SummaryRow
from sb3_uav.reproduce.methods import DL_DRL, METHOD_NAMES
from sb3_uav.reproduce.pairs import Model
from sb3_uav.reproduce.paper import GUROBI, KMEANS_AM, KMEANS_VND, OR_TOOLS
from sb3_uav.reproduce.scales import Scale, Scenario
from sb3_uav.solvers import Solver, make_solver
from sb3_uav.solvers.unavailable import UnavailableSolver

# The solvers that stand for the paper's baselines.
BASELINES = {"milp": GUROBI, "ortools": OR_TOOLS, "kmeans-vnd": KMEANS_VND, "kmeans-am": KMEANS_AM}


class Results(NamedTuple):
    """
    :param rows: Summary of each solver, by its name
    :param failures: Error messages
    :param folder: Where the results of every instance are; None if there are none
    """

    rows: dict[str, SummaryRow]
    failures: list[str]
    folder: Path | None = None

    def by_instance(self, solver: str, seed: int) -> tuple[np.ndarray, np.ndarray] | None:
        """
        :param solver: Name of a solver
        :param seed: Seed of the solver
        :return: Objectives and seconds, ``(n,)`` each; None if it has not solved all instances
        """
        row = self.rows.get(solver)
        if self.folder is None or row is None or row.n_feasible < row.n_instances:
            return None
        found = {
            result.instance: (result.objective, result.seconds)
            for result in read_results(self.folder / RESULTS_FILE)
            if result.solver == solver and result.seed == seed
        }
        values = np.array([found[instance] for instance in range(row.n_instances)], dtype=np.float64)
        return values[:, 0], values[:, 1]


@dataclass(frozen=True)
class Evaluator:
    """
    Runs solvers on test instances; existing results are reused.

    :param scale: The scale
    :param out: Folder of all results; those of the evaluations are in ``evaluations``
    :param seed: Seed of test instances and solvers
    :param device: Device of the networks
    :param n_jobs: Number of instances solved at once by solvers that solve them one by one
    :param overwrite: Whether to discard existing results
    :param progress: Called before each solver starts and after each of its instances
    """

    scale: Scale
    out: Path
    seed: int = 0
    device: str = "auto"
    n_jobs: int = 1
    overwrite: bool = False
    progress: Progress | None = None
    # Folders written by this process, which overwrite must not discard.
    _begun: set[Path] = field(default_factory=set)

    def instances(self, scenario: Scenario, seed: int | None = None, n_instances: int | None = None) -> Instances:
        """
        :param scenario: The paper's name of the situation
        :param seed: Seed of the instances; that of the test instances when None
        :param n_instances: Number of instances; that of the scale when None
        :return: Uniform instances; a smaller number gives the first of a larger one
        """
        generator = UniformGenerator(self.scale.n_tasks(scenario), scenario.n_uavs, max_distance=self.scale.max_distance)
        n_instances = self.scale.n_instances[scenario.n_tasks] if n_instances is None else n_instances
        key = (REPRODUCTION_SEED, self.seed) if seed is None else (seed,)
        return generator(n_instances, keyed_generator(*key, scenario.n_uavs, scenario.n_tasks))

    def run(
        self, scenario: Scenario, solvers: Sequence[Solver], instances: Instances | None = None, folder: str = ""
    ) -> Results:
        """
        :param scenario: The paper's name of the situation
        :param solvers: The solvers
        :param instances: The instances; the scale's test instances when None
        :param folder: Appended to the name of the folder
        :return: Summaries and failures
        :raises ValueError: If earlier results are of other instances, or of other solvers of the same name
        """
        path = self.out / "evaluations" / (scenario.folder + folder)
        batch = self.instances(scenario) if instances is None else instances
        refusals = [text for solver in solvers if (text := _refusal(solver, batch)) is not None]
        if len(refusals) == len(solvers):
            return Results({}, [f"{scenario.name}: {text}" for text in refusals])
        resume = not self.overwrite or path in self._begun
        self._begun.add(path)
        source = scenario.folder if self.scale.shrink == 1 else f"{scenario.folder} (N = {self.scale.n_tasks(scenario)})"
        rows = evaluate(solvers, {source: batch}, path, self.seed, self.progress, n_jobs=self.n_jobs, resume=resume)
        return Results({row.solver: row for row in rows}, [failure for row in rows for failure in row.failures], path)

    def baseline(self, solver: str, router: Model | None = None) -> Solver:
        """
        :param solver: Name of a solver that is not trained, or ``"kmeans-am"``
        :param router: The pair whose router ``"kmeans-am"`` uses
        :return: The solver with the time limit of the scale; one that refuses all instances if a package is missing
        :raises ValueError: If there is no such solver
        """
        options, limit = [], self.scale.time_limits.get(solver)
        if limit is not None:
            options.append(f"time_limit={limit:g}")
        name = BASELINES.get(solver, solver)
        if solver == "milp":
            options.append(f"backend={self.scale.exact_backend}")
            name = f"milp with {self.scale.exact_backend}"
        if solver == "kmeans-am":
            from sb3_uav.solvers.kmeans_am import load_kmeans_am

            assert router is not None
            found: Solver = load_kmeans_am(str(router.router), device=self.device)
            name = f"{name} {router.label}"
        else:
            spec = f"{solver}:{','.join(options)}" if options else solver
            try:
                found = make_solver(spec, device=self.device)
            except (ImportError, ValueError) as error:
                # A package or a license is missing.
                found = UnavailableSolver(spec, str(error))
        found.name = f"{name} ({limit:g} s)" if limit is not None else name
        return found

    def pair(self, model: Model, sampling: bool) -> Solver:
        """
        :param model: A trained pair
        :param sampling: Whether to keep the best of several sampled allocations, or to decode greedily
        :return: The solver
        """
        from sb3_uav.solvers.dl_drl import load_dl_drl

        decode = "sampling" if sampling else "greedy"
        solver = load_dl_drl(str(model.allocator), str(model.router), decode, self.scale.samples, self.device)
        method = METHOD_NAMES.get(model.strategy, DL_DRL)
        solver.name = f"{method} {model.label} ({f'sampling {self.scale.samples}' if sampling else 'greedy'})"
        return solver


def _refusal(solver: Solver, instances: Instances) -> str | None:
    """The reason why a solver cannot solve the instances, if there is one."""
    try:
        solver.check(instances)
    except ValueError as error:
        return f"{solver.name}: {error}"
    return None


def complete(row: SummaryRow | None, measure: Callable[[SummaryRow], float]) -> float | None:
    """
    :param row: Summary of a solver, if there is one
    :param measure: Selects a figure of the summary
    :return: The figure; None if the solver has not solved all instances
    """
    return None if row is None or row.n_feasible < row.n_instances else measure(row)

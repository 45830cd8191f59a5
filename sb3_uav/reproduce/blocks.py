"""The evaluations that Tables II to IV and Figs. 6 and 7 show, by column."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sb3_uav.evaluation.summary import SummaryRow
from sb3_uav.reproduce.evaluator import BASELINES, Results
from sb3_uav.reproduce.methods import DL_DRL, DL_DRL_I, column, learned_methods
from sb3_uav.reproduce.pairs import Model
from sb3_uav.reproduce.paper import EXACT_COLUMNS, GUROBI, KMEANS_AM, SIZES
from sb3_uav.reproduce.scales import Scenario
from sb3_uav.reproduce.session import Notes, Session
from sb3_uav.solvers.base import Solver

Pairs = Mapping[tuple[Scenario, str], Model]


class Block(NamedTuple):
    """
    Results of several methods on the same instances.

    :param results: What the evaluation found
    :param solvers: Name of the solver of each method
    :param seed: Seed of the solvers
    """

    results: Results
    solvers: dict[str, str]
    seed: int

    @classmethod
    def run(
        cls,
        session: Session,
        scenario: Scenario,
        solvers: Mapping[str, Solver],
        notes: Notes,
        n_instances: int | None = None,
        folder: str = "",
    ) -> Block:
        """
        :param session: The evaluations
        :param scenario: The scenario to solve
        :param solvers: The solvers by method
        :param notes: Receives failures
        :param n_instances: Number of instances; that of the scale when None
        :param folder: Appended to the name of the folder
        :return: The results
        """
        instances = session.evaluator.instances(scenario, n_instances=n_instances)
        results = session.evaluator.run(scenario, list(solvers.values()), instances, folder)
        notes.add(*results.failures)
        return cls(results, {method: solver.name for method, solver in solvers.items()}, session.evaluator.seed)

    @property
    def rows(self) -> dict[str, SummaryRow]:
        """Summaries by method."""
        rows = self.results.rows
        return {method: rows[solver] for method, solver in self.solvers.items() if solver in rows}

    def by_instance(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """:return: Objectives and seconds, ``(n,)`` each, of the methods that solved all instances"""
        found = {method: self.results.by_instance(solver, self.seed) for method, solver in self.solvers.items()}
        return {method: values for method, values in found.items() if values is not None}


def make_solvers(session: Session, scenario: Scenario, pairs: Pairs, notes: Notes) -> dict[str, Solver]:
    """
    :param session: The scale, the trained pairs, the evaluations and the output folder
    :param scenario: The scenario to solve
    :param pairs: The trained pairs by scenario and method
    :param notes: Receives what is left out
    :return: The solvers by column of Tables II and III
    """
    found: dict[str, Solver] = {}
    router = pairs.get((scenario, DL_DRL if session.scale.universal else DL_DRL_I))
    for solver, name in BASELINES.items():
        if solver not in session.solvers:
            notes.add(f"{name} was not requested (--solvers).")
        elif solver != "kmeans-am":
            found[name] = session.evaluator.baseline(solver)
        elif router is not None:
            found[name] = session.evaluator.baseline(solver, router)
    if KMEANS_AM in found:
        whose = (
            "of DL-DRL."
            if session.scale.universal
            else "of DL-DRL-I, which is trained on whole uniform instances only, for as many epochs as that of DL-DRL."
        )
        notes.add(f"{KMEANS_AM} uses the router {whose}")
    for method in learned_methods(session.models):
        model = pairs.get((scenario, method))
        if model is None:
            trained = session.scale.trained_for(scenario).name
            notes.add(f"{method} has no trained pair for {trained}, and --no-training forbids training one.")
            continue
        for sampling in (False, True):
            found[column(method, sampling)] = session.evaluator.pair(model, sampling)
    return found | {solver: session.evaluator.baseline(solver) for solver in session.extra_solvers}


def exact_block(session: Session, scenario: Scenario, solvers: Mapping[str, Solver], notes: Notes) -> Block:
    """
    :param session: The scale and the evaluations
    :param scenario: The scenario to solve
    :param solvers: The solvers by column
    :param notes: Receives what is left out
    :return: Results of the exact block of Tables II and III
    """
    scale = session.scale
    chosen = {name: solvers[name] for name in EXACT_COLUMNS if name in solvers}
    if GUROBI in chosen:
        notes.add(f"{GUROBI}: ours is the paper's model, equations (1) to (8), solved by {scale.exact_backend}.")
        if scenario.n_tasks not in scale.exact_sizes:
            del chosen[GUROBI]
            left_out = ", ".join(str(size) for size in SIZES if size not in scale.exact_sizes)
            notes.add(f"The exact solver does not run with {left_out} tasks at scale {scale.name}.")
    return Block.run(session, scenario, chosen, notes, scale.n_exact_instances, "-exact")


def full_block(session: Session, scenario: Scenario, solvers: Mapping[str, Solver], notes: Notes) -> Block:
    """
    :param session: The evaluations
    :param scenario: The scenario to solve
    :param solvers: The solvers by column
    :param notes: Receives failures
    :return: Results of all others on the scale's test instances
    """
    return Block.run(session, scenario, {name: solver for name, solver in solvers.items() if name != GUROBI}, notes)

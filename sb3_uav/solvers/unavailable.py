"""Solvers that cannot be made, and their placeholder in an evaluation."""

from __future__ import annotations

from sb3_uav.envs.instances import Instances
from sb3_uav.solvers.base import Solver, SolverResult
from sb3_uav.solvers.registry import solver_factory, solver_label


class UnavailableError(ValueError):
    """A solver that cannot be made here or within this time, although its options are right."""


class UnavailableSolver(Solver):
    """
    Placeholder for a solver that could not be made: the evaluation records a failure for each instance.

    It has the name of that solver and, as far as is known, its use of time limits, so that earlier results of the solver are
    found and later ones replace the failures.

    :param spec: The text that the solver should have been made from
    :param reason: Why it could not be made
    """

    def __init__(self, spec: str, reason: str) -> None:
        self.name, self.spec = solver_label(spec), spec
        self.reason = reason
        try:
            self.uses_time_limit = getattr(solver_factory(spec), "uses_time_limit", True)
        except (ImportError, ValueError):
            # The class is unknown.
            self.uses_time_limit = True

    def settings(self) -> None:
        """There are no results."""
        return None

    def check(self, instances: Instances) -> None:
        raise ValueError(self.reason)

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        raise ValueError(self.reason)

"""Solvers that cannot be made here, and what stands for them in an evaluation."""

from __future__ import annotations

from sb3_uav.envs.instances import Instances
from sb3_uav.solvers.base import Solver, SolverResult
from sb3_uav.solvers.registry import solver_factory, solver_label


class UnavailableError(ValueError):
    """A solver that cannot be made here or in this time, though its options are right; others may be."""


class UnavailableSolver(Solver):
    """
    Stands for a solver that could not be made, so that the evaluation of the others says so.

    It has the name of that solver, and as far as is known its use of time limits, so that earlier results of that solver are
    found and later ones take the place of the failures.

    :param spec: The text that it should have been made from
    :param reason: Why it could not be
    """

    def __init__(self, spec: str, reason: str) -> None:
        self.name, self.spec = solver_label(spec), spec
        self.reason = reason
        try:
            self.uses_time_limit = getattr(solver_factory(spec), "uses_time_limit", True)
        except (ImportError, ValueError):
            # Not even its class is known.
            self.uses_time_limit = True

    def settings(self) -> None:
        """Nothing is known that results could depend on."""
        return None

    def check(self, instances: Instances) -> None:
        raise ValueError(self.reason)

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        raise ValueError(self.reason)

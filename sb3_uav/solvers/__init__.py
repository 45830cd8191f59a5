from typing import Any

from sb3_uav.solvers.base import NoScheduleError, OneByOneSolver, Solution, Solver, SolverResult
from sb3_uav.solvers.dl_drl import DLDRL
from sb3_uav.solvers.kmeans_am import KMeansAM
from sb3_uav.solvers.registry import SOLVERS, make_solver

__all__ = [
    "DLDRL",
    "SOLVERS",
    "KMeansAM",
    "NoScheduleError",
    "OneByOneSolver",
    "Solution",
    "Solver",
    "SolverResult",
    "make_solver",
]


def __getattr__(name: str) -> Any:
    # Until release 0.1 these stood here. The one place where a lower room looks into a higher one: old scripts keep running.
    if name in ("SummaryRow", "evaluate", "print_table"):
        from sb3_uav import evaluation

        return getattr(evaluation, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

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
    # These names were here in release 0.1. This is the only import of a higher folder, so that old scripts keep running.
    if name in ("SummaryRow", "evaluate", "print_table"):
        from sb3_uav import evaluation

        return getattr(evaluation, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

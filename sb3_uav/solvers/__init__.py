from sb3_uav.solvers.base import SOLVERS, OneByOneSolver, Solution, Solver, SolverResult, make_solver
from sb3_uav.solvers.dl_drl import DLDRL
from sb3_uav.solvers.evaluation import SummaryRow, evaluate, print_table

__all__ = [
    "DLDRL",
    "SOLVERS",
    "OneByOneSolver",
    "Solution",
    "Solver",
    "SolverResult",
    "SummaryRow",
    "evaluate",
    "make_solver",
    "print_table",
]

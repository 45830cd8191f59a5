from sb3_uav.solvers.base import SOLVERS, OneByOneSolver, Solution, Solver, SolverResult, make_solver
from sb3_uav.solvers.comparison import SummaryRow
from sb3_uav.solvers.dl_drl import DLDRL
from sb3_uav.solvers.evaluation import evaluate
from sb3_uav.solvers.kmeans_am import KMeansAM
from sb3_uav.solvers.tables import print_table

__all__ = [
    "DLDRL",
    "SOLVERS",
    "KMeansAM",
    "OneByOneSolver",
    "Solution",
    "Solver",
    "SolverResult",
    "SummaryRow",
    "evaluate",
    "make_solver",
    "print_table",
]

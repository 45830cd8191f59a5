"""Public benchmarks: their files, best-known values, and how far solvers are from them."""

from sb3_uav.evaluation.benchmarks.best_known import read_best_known
from sb3_uav.evaluation.benchmarks.collection import read_folder
from sb3_uav.evaluation.benchmarks.report import report
from sb3_uav.evaluation.benchmarks.run import run_benchmark

__all__ = ["read_best_known", "read_folder", "report", "run_benchmark"]

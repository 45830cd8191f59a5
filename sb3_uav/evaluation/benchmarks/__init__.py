"""Public benchmarks: their files, best-known values, and how far solvers are from them."""

from sb3_uav.evaluation.benchmarks.best_known import read_best_known
from sb3_uav.evaluation.benchmarks.collection import BenchmarkFolder, read_folder
from sb3_uav.evaluation.benchmarks.instance import BenchmarkInstance

__all__ = ["BenchmarkFolder", "BenchmarkInstance", "read_best_known", "read_folder"]

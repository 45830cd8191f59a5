"""Mixed-integer linear programs, and the solvers that they are given to: HiGHS and Gurobi."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.optional import require
from sb3_uav.solvers.unavailable import UnavailableError

# Tolerance that the solvers are given for constraints, for integers, and for the gap between the best value and its bound.
_SOLVER_TOLERANCE = 1e-9
# Columns, and rows, of the largest program: about 4 GB in HiGHS, and of the largest that Gurobi's free license admits.
_LARGEST_SIZE = 2_000_000
_FREE_LICENSE_SIZE = 2000


@dataclass(frozen=True)
class Program:
    """
    Maximize ``objective @ x`` subject to ``lower <= A x <= upper`` and ``0 <= x <= column_upper``.

    :param objective: ``(n_columns,)``
    :param column_upper: ``(n_columns,)``
    :param binary: ``(n_columns,)`` bool; the other columns are continuous
    :param lower: ``(n_rows,)``, equal to ``upper`` or -inf
    :param upper: ``(n_rows,)``
    :param starts: ``(n_rows + 1,)``, where the entries of each row of ``A`` start in the next two
    :param columns: ``(n_entries,)``
    :param coefficients: ``(n_entries,)``
    """

    objective: np.ndarray
    column_upper: np.ndarray
    binary: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    starts: np.ndarray
    columns: np.ndarray
    coefficients: np.ndarray


class Rows:
    """Collects the rows of a program, many at once."""

    def __init__(self) -> None:
        self.n_rows = 0
        self._entries: list[tuple[np.ndarray, ...]] = []
        self._bounds: list[tuple[np.ndarray, ...]] = []

    def new(self, lower: Any, upper: Any) -> np.ndarray:
        """
        Start rows.

        :param lower: Of every new row, broadcast against ``upper``
        :param upper: Of every new row
        :return: Their indices, of the broadcast shape
        """
        lower, upper = np.broadcast_arrays(np.asarray(lower, dtype=float), np.asarray(upper, dtype=float))
        self._bounds.append((lower.ravel(), upper.ravel()))
        self.n_rows += lower.size
        return np.arange(self.n_rows - lower.size, self.n_rows).reshape(lower.shape)

    def add(self, rows: np.ndarray, columns: np.ndarray, coefficients: Any) -> None:
        """
        Add entries; the arguments are broadcast against each other.

        :param rows: From :meth:`new`
        :param columns: Columns
        :param coefficients: Coefficients
        """
        parts = np.broadcast_arrays(rows, columns, np.asarray(coefficients, dtype=float))
        self._entries.append(tuple(part.ravel() for part in parts))

    def program(self, objective: np.ndarray, column_upper: np.ndarray, binary: np.ndarray) -> Program:
        """
        :param objective: As of :class:`Program`
        :param column_upper: As of :class:`Program`
        :param binary: As of :class:`Program`
        :return: The program with these rows
        """
        rows, columns, coefficients = map(np.concatenate, zip(*self._entries, strict=True))
        lower, upper = map(np.concatenate, zip(*self._bounds, strict=True))
        order = rows.argsort(kind="stable")
        starts = np.concatenate([[0], np.bincount(rows, minlength=self.n_rows).cumsum()])
        return Program(objective, column_upper, binary, lower, upper, starts, columns[order], coefficients[order])


class _Answer(NamedTuple):
    """
    The answer of a backend.

    :param columns: ``(n_columns,)``, the best solution; None if there is none yet
    :param bound: Proven upper bound of the objective
    """

    columns: np.ndarray | None
    bound: float


class _Backend(ABC):
    """
    A solver of programs.

    :ivar size_limit: How many columns, and how many rows, it takes
    :ivar size_reason: Why not more, and what to do then
    """

    size_limit = _LARGEST_SIZE
    size_reason = "which already takes some 4 GB of memory; use another solver for so many tasks"

    @abstractmethod
    def solve(self, program: Program, time_limit: float, threads: int, seed: int) -> _Answer:
        """
        :param program: A program that has a solution, and of a size that :meth:`check_size` allows
        :param time_limit: Seconds
        :param threads: Number of threads
        :param seed: Seed of the solver
        :return: The solution and the bound
        """

    def check_size(self, n_columns: int, n_rows: int) -> None:
        """
        :param n_columns: Number of columns of a program
        :param n_rows: Number of its rows
        :raises ValueError: If that is too large
        """
        if max(n_columns, n_rows) > self.size_limit:
            raise ValueError(
                f"the model has {n_columns} variables and {n_rows} constraints; milp can have {self.size_limit} of each, "
                f"{self.size_reason}"
            )


class _HiGHSBackend(_Backend):
    """
    :raises ImportError: If highspy is not installed
    """

    def __init__(self) -> None:
        require("highspy", "Solver milp", "solvers")

    def solve(self, program: Program, time_limit: float, threads: int, seed: int) -> _Answer:
        highspy: Any = require("highspy", "Solver milp", "solvers")
        model = highspy.HighsLp()
        model.sense_ = highspy.ObjSense.kMaximize
        model.num_col_, model.num_row_ = len(program.objective), len(program.lower)
        model.col_cost_ = program.objective
        model.col_lower_, model.col_upper_ = np.zeros(len(program.objective)), program.column_upper
        model.row_lower_, model.row_upper_ = program.lower, program.upper
        kinds = (highspy.HighsVarType.kContinuous, highspy.HighsVarType.kInteger)
        model.integrality_ = [kinds[binary] for binary in program.binary.tolist()]
        model.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        model.a_matrix_.start_ = program.starts
        model.a_matrix_.index_ = program.columns
        model.a_matrix_.value_ = program.coefficients
        # HiGHS has one pool of threads per process, which otherwise keeps the size of its first use.
        highspy.Highs.resetGlobalScheduler(True)
        solver = highspy.Highs()
        solver.silent()
        for option, value in {
            "time_limit": time_limit,
            "threads": threads,
            "random_seed": seed,
            "mip_rel_gap": 0.0,
            "mip_abs_gap": _SOLVER_TOLERANCE,
            "mip_feasibility_tolerance": _SOLVER_TOLERANCE,
            "primal_feasibility_tolerance": _SOLVER_TOLERANCE,
        }.items():
            solver.setOptionValue(option, value)
        solver.passModel(model)
        solver.run()
        status, info = solver.getModelStatus(), solver.getInfo()
        if status not in (highspy.HighsModelStatus.kOptimal, highspy.HighsModelStatus.kTimeLimit):
            raise RuntimeError(f"HiGHS ended with the status {solver.modelStatusToString(status)!r} on a feasible program.")
        has_solution = info.primal_solution_status == highspy.kSolutionStatusFeasible
        return _Answer(np.array(solver.getSolution().col_value) if has_solution else None, info.mip_dual_bound)


class _GurobiBackend(_Backend):
    """
    :raises ImportError: If gurobipy is not installed
    :raises UnavailableError: If Gurobi finds no valid license
    """

    def __init__(self) -> None:
        gurobipy, environment = self._start()
        # Gurobi has no other way to ask what a license admits.
        with environment, gurobipy.Model(env=environment) as model:
            model.addVars(_FREE_LICENSE_SIZE + 1)
            try:
                model.optimize()
            except gurobipy.GurobiError as error:
                if error.errno != gurobipy.GRB.Error.SIZE_LIMIT_EXCEEDED:
                    raise self._refused(error) from error
                self.size_limit = _FREE_LICENSE_SIZE
                self.size_reason = "which is what Gurobi's free license admits; install another, or use milp:backend=highs"

    @staticmethod
    def _refused(error: Exception) -> UnavailableError:
        return UnavailableError(f"Gurobi found no valid license ({error}); install one, or use milp:backend=highs.")

    def _start(self) -> tuple[Any, Any]:
        """
        :return: The module ``gurobipy``, and a new environment
        """
        gurobipy: Any = require("gurobipy", "Solver milp:backend=gurobi", "gurobi")
        try:
            return gurobipy, gurobipy.Env(params={"OutputFlag": 0})
        except gurobipy.GurobiError as error:
            raise self._refused(error) from error

    def solve(self, program: Program, time_limit: float, threads: int, seed: int) -> _Answer:
        gurobipy, environment = self._start()
        constants = gurobipy.GRB
        with environment, gurobipy.Model(env=environment) as model:
            for parameter, value in {
                "TimeLimit": time_limit,
                "Threads": threads,
                "Seed": seed,
                "MIPGap": 0.0,
                "MIPGapAbs": _SOLVER_TOLERANCE,
                "FeasibilityTol": _SOLVER_TOLERANCE,
                "IntFeasTol": _SOLVER_TOLERANCE,
            }.items():
                model.setParam(parameter, value)
            model.ModelSense = constants.MAXIMIZE
            kinds = (constants.CONTINUOUS, constants.BINARY)
            columns = [
                model.addVar(0.0, upper, objective, kinds[binary])
                for upper, objective, binary in zip(
                    program.column_upper.tolist(), program.objective.tolist(), program.binary.tolist(), strict=True
                )
            ]
            for row, (first, last) in enumerate(pairwise(program.starts.tolist())):
                indices = program.columns[first:last].tolist()
                terms = gurobipy.LinExpr(program.coefficients[first:last].tolist(), [columns[index] for index in indices])
                sense = constants.EQUAL if program.lower[row] == program.upper[row] else constants.LESS_EQUAL
                model.addLConstr(terms, sense, float(program.upper[row]))
            model.optimize()
            if model.Status not in (constants.OPTIMAL, constants.TIME_LIMIT):
                raise RuntimeError(f"Gurobi ended with the status {model.Status} on a feasible program.")
            return _Answer(np.array(model.getAttr("X", columns)) if model.SolCount > 0 else None, model.ObjBound)


BACKENDS: dict[str, Callable[[], _Backend]] = {"highs": _HiGHSBackend, "gurobi": _GurobiBackend}

"""What the tests of MILP, OR-Tools, PyVRP and greedy insertion share: their names, a clock, and the checker's objective."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from conftest import seeds
from hypothesis import strategies as st

from sb3_uav.envs import Instances, check_schedule
from sb3_uav.solvers import Solver, SolverResult, make_solver

# PyVRP 0.14 needs Python 3.11.
HAS_PYVRP = find_spec("pyvrp") is not None

needs_pyvrp = pytest.mark.skipif(not HAS_PYVRP, reason="PyVRP is not installed")

UNTIMED = ("greedy-insertion", "ortools")

# PyVRP completes a first local search whatever its time limit; guided local search may end without any solution.
RELIABLE = ("milp", *UNTIMED, *(["pyvrp:time_limit=0.02"] if HAS_PYVRP else []))

ALL = (*RELIABLE, "ortools-gls:time_limit=0.02")


class Ticks:
    """A clock on which every look at it takes a millisecond."""

    def __init__(self) -> None:
        self.looks = 0

    def perf_counter(self) -> float:
        self.looks += 1
        return self.looks / 1000


def solved(spec: str | Solver, instances: Instances, row: int = 0) -> tuple[float, SolverResult]:
    """
    :return: What the checker says of the objective, and the result
    """
    solver = make_solver(spec) if isinstance(spec, str) else spec
    (result,) = solver.solve(instances[row])
    return check_schedule(instances, row, result.schedule).objective, result


def objective(spec: str | Solver, instances: Instances, row: int = 0) -> float:
    return solved(spec, instances, row)[0]


@st.composite
def tight_instances(draw: st.DrawFn, max_tasks: int = 6) -> Instances:
    """One instance in general position in which the UAVs can seldom visit everything, with every kind of values."""
    n_tasks = draw(st.integers(1, max_tasks))
    generator = np.random.default_rng(draw(seeds))
    points = generator.random((n_tasks + 1, 2))
    values = draw(
        st.sampled_from(
            [np.ones(n_tasks), generator.integers(0, 5, n_tasks), generator.random(n_tasks), 10 ** generator.random(n_tasks)]
        )
    )
    return Instances.from_arrays(points[0], points[1:], values, draw(st.floats(0.3, 2.0)), draw(st.integers(1, 4)))

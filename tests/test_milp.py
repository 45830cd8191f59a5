"""MILP: exact, with a proven bound, and clear about sizes and licenses."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brute_force import largest_value
from classical_helpers import ALL, objective, solved, tight_instances
from conftest import instance_batches
from evaluation_helpers import read_rows
from hypothesis import given, settings

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.evaluation import evaluate
from sb3_uav.solvers import NoScheduleError, make_solver
from sb3_uav.solvers.milp import MILP, _paper_program, _Places, _program_size
from sb3_uav.solvers.programs import _FREE_LICENSE_SIZE, _Answer, _Backend
from sb3_uav.solvers.unavailable import UnavailableError

pytestmark = pytest.mark.usefixtures("ticks")

# --------------------------------------------------------------------------------------------------------------- optimality


def check_against_brute_force(instance: Instances) -> None:
    best = largest_value(instance)
    found, result = solved("milp", instance)
    assert found == pytest.approx(best, rel=1e-7)
    assert result.bound == pytest.approx(best, rel=1e-6) and result.bound is not None and result.bound >= found
    for spec in ALL:
        assert objective(spec, instance) <= best * (1 + 1e-12), spec


@settings(max_examples=40)
@given(tight_instances())
def test_milp_is_optimal(instance: Instances) -> None:
    """Brute force = MILP = its bound >= every other solver."""
    check_against_brute_force(instance)


@settings(max_examples=40)
@given(instance_batches(max_tasks=6, max_batch=1))
def test_milp_is_optimal_far_from_general_position(instance: Instances) -> None:
    """Also for coincident and collinear tasks, tours of exactly the maximum length, and more UAVs than tasks."""
    check_against_brute_force(instance)


# ----------------------------------------------------------------------------------------------------------------------- MILP


@pytest.mark.parametrize("spec", ["milp", "milp:backend=gurobi"])
def test_cycles_within_the_solvers_tolerance(spec: str) -> None:
    """Two tasks so near to each other that (7) does not exclude a cycle of them alone: it is forbidden, and not counted."""
    if "gurobi" in spec:
        pytest.importorskip("gurobipy")
    tasks = [[0.9, 0.0], [0.9, 1e-11], [-0.9, 0.0]]
    found, result = solved(spec, Instances.from_arrays([0.0, 0.0], tasks, [0.4, 0.4, 1.0], 2.0, 1))
    assert (found, result.bound) == pytest.approx((1.0, 1.0))


class Pretender(_Backend):
    """
    A backend that reports what it is told to, once per round.

    :param answers: What it says
    """

    def __init__(self, *answers: _Answer) -> None:
        self.answers = list(answers)

    def solve(self, program: Any, time_limit: float, threads: int, seed: int) -> _Answer:
        return self.answers.pop(0)


@pytest.mark.parametrize("answer, bound", [(_Answer(None, math.inf), 9.0), (_Answer(None, 5.5), 5.5)])
def test_without_an_incumbent_milp_says_so_and_keeps_the_bound(answer: _Answer, bound: float, tmp_path: Path) -> None:
    """An empty schedule would look like a result; an evaluation records a failure with the bound."""
    solver = MILP(7.0)
    solver.backend = Pretender(answer, answer)
    instance = UniformGenerator(9, n_uavs=2)(1, np.random.default_rng(0))
    assert int(instance.reachable().sum()) == 9
    message = f"no schedule found within the time limit of 7 s; bound {bound:g}"
    with pytest.raises(NoScheduleError, match=f"^{message}$") as error:
        solver.solve(instance)
    assert error.value.bound == bound and pickle.loads(pickle.dumps(error.value)).bound == bound
    (row,) = evaluate([solver], {"set": instance}, tmp_path)
    assert row.failures == (f"milp failed on 1 of 1 instances of set: {message}",)
    (result,) = read_rows(tmp_path)
    assert (result["status"], result["objective"], result["bound"]) == ("failed", "", str(bound))
    assert row.bound == bound


def test_what_is_feasible_of_an_incumbent_is_kept() -> None:
    """Of a tour and a cycle beside it, the tour stays when no time is left for another round."""
    instance = Instances.from_arrays([0.0, 0.0], [[0.5, 0.0], [0.0, 0.7], [0.0, 0.8]], None, 2.0, 1)
    # Arcs are (0, 1), (0, 2), (0, 3), (1, 0), (1, 2), (1, 3), (2, 0), (2, 1), (2, 3), (3, 0), (3, 1), (3, 2).
    columns = np.array([1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 1] + [1] * 3 + [0] * 3, dtype=float)
    solver = MILP()
    solver.backend = Pretender(_Answer(columns, 3.0), _Answer(None, 2.5))
    found, result = solved(solver, instance)
    assert (found, result.bound) == (1.0, 2.5)


def test_the_time_limit_is_kept_and_the_bound_holds() -> None:
    """Too large to be solved in a second; the bound is above what another solver finds."""
    instance = UniformGenerator(30, n_uavs=3, max_distance=1.2)(1, np.random.default_rng(4))
    try:
        bound = solved("milp:time_limit=1", instance)[1].bound
    except NoScheduleError as error:
        # On a machine that is busy.
        bound = error.bound
    assert bound is not None and bound >= objective("ortools", instance)


@pytest.mark.parametrize("n_tasks, n_uavs", [(1, 1), (1, 3), (4, 2), (7, 3), (30, 2), (20, 4), (16, 6)])
def test_size_of_the_program(n_tasks: int, n_uavs: int) -> None:
    reduced = ReducedInstance.of(UniformGenerator(n_tasks, n_uavs, max_distance=9.0)(1, np.random.default_rng(0)))
    program = _paper_program(_Places.of(reduced))
    assert _program_size(n_tasks, n_uavs) == (len(program.objective), len(program.lower))
    assert len(program.starts) == len(program.lower) + 1 == len(program.upper) + 1
    assert program.starts[-1] == len(program.columns) == len(program.coefficients)


@pytest.mark.parametrize("n_uavs, largest", [(2, 30), (4, 20), (6, 16)])
def test_sizes_of_the_free_license(n_uavs: int, largest: int) -> None:
    assert max(_program_size(largest, n_uavs)) <= _FREE_LICENSE_SIZE < max(_program_size(largest + 1, n_uavs))


def test_too_large_for_any_machine() -> None:
    instance = UniformGenerator(1500, 6, max_distance=9.0)(1, np.random.default_rng(0))
    solver = make_solver("milp")
    for action in (solver.check, solver.solve):
        with pytest.raises(ValueError, match=r"13527000 variables and .* milp can have 2000000 of each.*use another solver"):
            action(instance)


def test_gurobi_and_its_license() -> None:
    """Both backends agree; beyond the free license there is a clear message, before any solving and during it."""
    gurobipy = pytest.importorskip("gurobipy")
    solver: Any = make_solver("milp:backend=gurobi")
    batch = UniformGenerator(7, n_uavs=2, max_distance=1.2)(4, np.random.default_rng(0))
    for row in range(4):
        (gurobi, result), (highs, _) = solved(solver, batch, row), solved("milp", batch, row)
        assert gurobi == highs == pytest.approx(result.bound)
    if solver.backend.size_limit != _FREE_LICENSE_SIZE:
        pytest.skip(f"gurobipy {gurobipy.gurobi.version()} has a full license here")
    large = Instances.concatenate([batch.pad(40), UniformGenerator(40, 2, max_distance=9.0)(1, np.random.default_rng(0))])
    with pytest.raises(
        ValueError, match=r"instance 4: the model has 3440 variables .* free license admits.*milp:backend=highs"
    ):
        solver.check(large)
    with pytest.raises(ValueError, match="free license admits"):
        solver.solve(large[4:])


def test_gurobi_without_a_license(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    pytest.importorskip("gurobipy")
    license = tmp_path / "gurobi.lic"
    license.write_text("EXPIRATION=2001-01-01\nKEY=00000000\n")
    monkeypatch.setenv("GRB_LICENSE_FILE", str(license))
    with pytest.raises(UnavailableError, match=r"Gurobi found no valid license .* or use milp:backend=highs"):
        make_solver("milp:backend=gurobi")

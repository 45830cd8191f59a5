"""MILP, OR-Tools, PyVRP and greedy insertion: exact where they claim it, feasible everywhere, clear when they cannot run."""

from __future__ import annotations

import math
import pickle
import re
import sys
from itertools import pairwise

import numpy as np
import pytest
from brute_force import largest_value
from classical_helpers import ALL, RELIABLE, UNTIMED, needs_pyvrp, objective, solved
from conftest import instance_batches
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sb3_uav.common.optional import install_command
from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.solvers import make_solver, ortools_routing

pytestmark = pytest.mark.usefixtures("ticks")

# --------------------------------------------------------------------------------------------------------------- optimality


def test_brute_force() -> None:
    """By hand: a square of side 1 around the depot's corner."""
    tasks = [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    for distance, n_uavs, best in (
        (1.99, 1, 0.0),
        (2.0, 1, 3.0),
        (2.0, 2, 5.0),
        (3.5, 1, 8.0),
        (3.5, 2, 10.0),
        (4.0, 1, 10.0),
    ):
        assert largest_value(Instances.from_arrays([0.0, 0.0], tasks, [2.0, 5.0, 3.0], distance, n_uavs)) == best


@pytest.mark.parametrize("spec", ["milp", "ortools", pytest.param("pyvrp:time_limit=0.1", marks=needs_pyvrp)])
def test_value_counts_before_number_and_length(spec: str) -> None:
    """One UAV must choose between a far task and three near ones."""
    for far, best in ((3.5, 3.5), (2.5, 3.0), (1e6, 1e6)):
        instance = Instances.from_arrays([0.0, 0.0], [[1, 0], [-0.1, 0], [-0.2, 0], [-0.3, 0]], [far, 1, 1, 1], 2.0, 1)
        assert objective(spec, instance) == best


# -------------------------------------------------------------------------------------------------------------- feasibility


@pytest.mark.slow
@pytest.mark.parametrize("spec", ALL)
def test_schedules_of_any_instance_are_feasible(spec: str) -> None:
    """A thousand random instances for the five solvers."""
    solver = make_solver(spec)
    n_solved = 0

    @settings(max_examples=200)
    @given(instance_batches(max_tasks=5 if spec == "milp" else 15, max_batch=1))
    def check(batch: Instances) -> None:
        nonlocal n_solved
        for row, result in enumerate(solver.solve(batch)):
            report = check_schedule(batch, row, result.schedule)
            assert len(result.schedule.routes) == batch.n_uavs
            assert result.bound is None or result.bound >= report.objective
            worth = batch.reachable()[row] & (batch.values[row] > 0)
            assert (report.objective > 0) == bool(worth.any()) or spec not in RELIABLE
            n_solved += 1

    check()
    assert n_solved >= 200


@settings(max_examples=25)
@given(st.floats(1e-3, 1e3), st.floats(0, 2 * math.pi))
def test_the_farthest_reachable_task_is_visited(max_distance: float, angle: float) -> None:
    """Rounding may not cost a task that lies exactly half the maximum distance away."""
    task = [[max_distance / 2 * math.cos(angle), max_distance / 2 * math.sin(angle)]]
    instance = Instances.from_arrays([0.0, 0.0], task, None, max_distance, 1)
    assume(bool(instance.reachable().all()))
    for spec in RELIABLE:
        assert objective(spec, instance) == 1, spec


@pytest.mark.parametrize("spec", ["milp", "greedy-insertion", "kmeans-nearest", "kmeans-vnd"])
@pytest.mark.parametrize("excess", [3.9e-10, 4.3e-10, 4.8e-10, 4.99e-10, 5.01e-10, 6e-10])
def test_tours_at_the_edge_of_the_tolerance(excess: float, spec: str) -> None:
    """Who proves bounds must know all tours that others, and the checker, think short enough."""
    points = [[0.5 * (1 + excess), 0.0], [0.1, 0.0]]
    instance = Instances.from_arrays([0.0, 0.0], points, max_distance=1.0, n_uavs=1)
    value, result = solved(spec, instance)
    assert value == (2.0 if excess < 5e-10 else 1.0)
    assert result.bound in (None, value)


@pytest.mark.parametrize("spec", ALL)
def test_nothing_to_win(spec: str) -> None:
    """Tasks out of reach, tasks worth nothing, and padding alone give empty schedules of the whole fleet."""
    far = Instances.from_arrays([0.0, 0.0], [[1.0, 0.0]], None, 1.9, 3)
    worthless = Instances.from_arrays([0.0, 0.0], [[0.5, 0.0]], [0.0], 2.0, 3)
    padded = Instances.from_arrays([[0.0, 0.0]], [[[0.5, 0.0]]], None, 2.0, 3, task_mask=[[False]])
    for instance in (far, worthless, padded):
        _, result = solved(spec, instance)
        assert result.schedule == Schedule([(), (), ()])
        assert result.bound in (None, 0.0)


@pytest.mark.parametrize("spec", RELIABLE)
def test_tasks_at_the_depot_cost_nothing(spec: str) -> None:
    instance = Instances.from_arrays([0.3, 0.3], [[0.3, 0.3], [0.3, 0.3], [0.3, 1.3]], [1.0, 2.0, 4.0], 2.0, 1)
    assert objective(spec, instance) == 7.0
    assert objective(spec, instance.trim(2)) == 3.0


@pytest.mark.parametrize("spec", UNTIMED)
def test_repeatable_and_padding_changes_nothing(spec: str) -> None:
    batch = UniformGenerator(30, n_uavs=3, max_distance=1.0)(3, np.random.default_rng(0))
    solver = make_solver(spec)
    expected = [result.schedule for result in solver.solve(batch)]
    assert [result.schedule for result in solver.solve(batch.pad(41), seed=1)] == expected


@pytest.mark.parametrize("spec", RELIABLE)
def test_solvers_travel_to_other_processes(spec: str) -> None:
    batch = UniformGenerator(5, n_uavs=2, max_distance=1.0)(1, np.random.default_rng(0))
    assert objective(pickle.loads(pickle.dumps(make_solver(spec))), batch) == objective(spec, batch)


# ------------------------------------------------------------------------------------------------------------ greedy insertion


@settings(max_examples=50)
@given(instance_batches(max_tasks=10, max_batch=1))
def test_greedy_insertion_leaves_no_room(instance: Instances) -> None:
    """No further task fits anywhere in its tours."""
    limit = float(instance.max_distance[0]) * (1 - 1e-9)
    _, result = solved("greedy-insertion", instance)
    nodes = [instance.depot[0].tolist(), *instance.tasks[0].tolist()]
    missing = set(range(int(instance.task_mask.sum()))) - {task for route in result.schedule.routes for task in route}
    for route in result.schedule.routes:
        for task in missing:
            if instance.values[0, task] == 0:
                continue
            for position in range(len(route) + 1):
                stops = [0, *(stop + 1 for stop in (*route[:position], task, *route[position:])), 0]
                assert sum(math.dist(nodes[a], nodes[b]) for a, b in pairwise(stops)) > limit


def test_greedy_insertion_takes_the_best_rate_first() -> None:
    """The first tour takes value 3 over length 1.6, not 1 over 0.8; the rest no longer fits."""
    instance = Instances.from_arrays([0.0, 0.0], [[0.4, 0.0], [0.0, 0.8], [-0.4, 0.0]], [1.0, 3.0, 0.1], 1.9, 1)
    _, result = solved("greedy-insertion", instance)
    assert result.schedule == Schedule([(1,)])


# ------------------------------------------------------------------------------------------------------------------- OR-Tools


@needs_pyvrp
def test_stronger_solvers_are_stronger() -> None:
    """On the paper's distribution, local search gains on insertion, and PyVRP on OR-Tools' local optimum."""
    batch = UniformGenerator(60, n_uavs=3)(5, np.random.default_rng(2))
    insertion, ortools, pyvrp = (
        sum(objective(spec, batch, row) for row in range(len(batch)))
        for spec in ("greedy-insertion", "ortools", "pyvrp:time_limit=0.3")
    )
    assert insertion < ortools < pyvrp


def test_search_parameters_of_ortools() -> None:
    """The paper's variant has no limit at all; guided local search gets what is left of its time, and at least something."""
    pywrapcp = pytest.importorskip("ortools.constraint_solver.pywrapcp")
    enums = pytest.importorskip("ortools.constraint_solver.routing_enums_pb2")
    now = ortools_routing.time.perf_counter()
    plain, early, late = (ortools_routing._search_parameters(pywrapcp, end) for end in (None, now + 1e6, now - 1.0))
    for parameters in (plain, early, late):
        assert parameters.first_solution_strategy == enums.FirstSolutionStrategy.PATH_CHEAPEST_ARC
    assert plain.local_search_metaheuristic == enums.LocalSearchMetaheuristic.GREEDY_DESCENT
    assert early.local_search_metaheuristic == enums.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    assert not plain.HasField("time_limit")
    assert 0.9e6 < early.time_limit.ToSeconds() <= 1e6 and late.time_limit.ToMilliseconds() == 1


# --------------------------------------------------------------------------------------------------------- what is not there


@pytest.mark.parametrize(
    "spec, package, extra",
    [
        ("milp", "highspy", "solvers"),
        ("milp:backend=gurobi", "gurobipy", "gurobi"),
        ("ortools", "ortools.constraint_solver.pywrapcp", "solvers"),
        ("ortools-gls", "ortools.constraint_solver.pywrapcp", "solvers"),
        ("pyvrp", "pyvrp", "solvers"),
    ],
)
def test_packages_that_are_missing(spec: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The solver cannot be made, and the message says what to install; the others can."""
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"Solver {spec} needs {package} .*; run: {re.escape(install_command(extra))}"):
        make_solver(spec)
    for other in ALL:
        if other.partition(":")[0].partition("-")[0] != spec.partition(":")[0].partition("-")[0]:
            make_solver(other)


@pytest.mark.parametrize("name", ["milp", "ortools-gls", pytest.param("pyvrp", marks=needs_pyvrp)])
@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf"])
def test_time_limits_that_make_no_sense(name: str, seconds: str) -> None:
    message = f"time_limit of {name}.* is {seconds} seconds; it must be more than 0, and finite"
    with pytest.raises(ValueError, match=message):
        make_solver(f"{name}:time_limit={seconds}")
    batch = UniformGenerator(5, n_uavs=2)(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match=message):
        make_solver(name).solve(batch, time_limit=float(seconds))


@pytest.mark.parametrize(
    "spec, message",
    [
        ("milp:backend=cplex", r"backend of milp is 'cplex'; choose one of \['gurobi', 'highs'\]"),
        ("milp:threads=0", "threads of milp is 0; give at least 1"),
        pytest.param("pyvrp:num_neighbours=0", "num_neighbours of pyvrp is 0; give at least 1", marks=needs_pyvrp),
        ("ortools:time_limit=3", "'ortools' has no option 'time_limit=3'"),
    ],
)
def test_wrong_options(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_solver(spec)

"""MILP, OR-Tools, PyVRP and greedy insertion: exact where they claim it, feasible everywhere, clear when they cannot run."""

from __future__ import annotations

import math
import pickle
import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from brute_force import largest_value
from conftest import instance_batches, seeds
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sb3_uav.common.optional import install_command
from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.reduction import RESOLUTION, ReducedInstance
from sb3_uav.solvers import Solver, SolverResult, limits, make_solver, milp, ortools_routing, pyvrp_search
from sb3_uav.solvers.limits import UnavailableError
from sb3_uav.solvers.milp import MILP, Places, paper_program, program_size
from sb3_uav.solvers.programs import FREE_LICENCE_SIZE, Answer, Backend
from sb3_uav.solvers.pyvrp_search import polish_schedule

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


@pytest.fixture(scope="module", autouse=True)
def ticks() -> Iterator[Ticks]:
    """PyVRP looks once per iteration, so that it makes 1000 of them a second however busy the machine is."""
    clock = Ticks()
    with pytest.MonkeyPatch.context() as patch:
        for module in (limits, milp, ortools_routing, pyvrp_search):
            patch.setattr(module, "time", clock)
        yield clock


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


# ---------------------------------------------------------------------------------------------------------------------- PyVRP


@needs_pyvrp
@pytest.mark.parametrize("kind", ["powers", "one jackpot", "large fleet", "whole"])
def test_pyvrp_with_uneven_values(kind: str) -> None:
    """Its penalties can enforce the maximum distance whatever the values are."""
    generator = np.random.default_rng(3)
    n_tasks = 80
    values = {
        "powers": 10.0 ** generator.uniform(-6, 6, n_tasks),
        "one jackpot": np.where(np.arange(n_tasks) < 3, 1e6, 1.0),
        "large fleet": generator.random(n_tasks),
        "whole": generator.integers(1, 10, n_tasks) * 1000.0,
    }[kind]
    instance = UniformGenerator(n_tasks)(1, generator)
    instance = Instances.from_arrays(instance.depot, instance.tasks, values[None], 1.0, 60 if kind == "large fleet" else 2)
    assert objective("pyvrp:time_limit=0.3", instance) >= 0.98 * objective("greedy-insertion", instance) > 0


@needs_pyvrp
def test_pyvrp_without_a_feasible_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tours that are too long are left out, where penalties are too low to avoid them."""
    monkeypatch.setattr(pyvrp_search, "PENALTY_PER_PRIZE", 1)
    generator = np.random.default_rng(3)
    for n_uavs in (1, 2, 3):
        values = 10.0 ** generator.uniform(-6, 6, 80)
        instance = UniformGenerator(80)(1, generator)
        instance = Instances.from_arrays(instance.depot, instance.tasks, values[None], 1.0, n_uavs)
        objective("pyvrp:time_limit=0.1", instance)


@needs_pyvrp
def test_pyvrp_ends_when_all_is_visited(ticks: Ticks) -> None:
    instance = UniformGenerator(10, n_uavs=2, max_distance=9.0)(1, np.random.default_rng(0))
    before = ticks.looks
    assert objective("pyvrp:time_limit=10", instance) == 10
    assert ticks.looks - before < 100


@needs_pyvrp
@pytest.mark.parametrize("seed", range(3))
def test_polish_starts_from_the_schedule(seed: int) -> None:
    """In no time at all it returns what it was given; with some, it gains on it."""
    instance = UniformGenerator(150, n_uavs=3)(1, np.random.default_rng(seed))
    value, result = solved("ortools", instance)
    instant = polish_schedule(instance, result.schedule, 1e-9, seed)
    assert check_schedule(instance, 0, instant).objective == value
    polished = polish_schedule(instance, result.schedule, 0.5, seed)
    assert check_schedule(instance, 0, polished).objective > value


@needs_pyvrp
@settings(max_examples=20)
@given(instance_batches(max_tasks=12, max_batch=1), seeds)
def test_polish_is_never_worse(instance: Instances, seed: int) -> None:
    for start in (make_solver("kmeans-nearest").solve(instance, seed=seed)[0].schedule, Schedule([])):
        polished = polish_schedule(instance, start, 0.01, seed)
        before = check_schedule(instance, 0, start).objective
        assert check_schedule(instance, 0, polished).objective >= before


@needs_pyvrp
def test_the_seed_reaches_pyvrp() -> None:
    """The same seed and number of iterations give the same schedule."""
    instance = UniformGenerator(100, n_uavs=3)(1, np.random.default_rng(0))
    solver = make_solver("pyvrp:time_limit=0.05")
    first, second, other = (solver.solve(instance, seed=seed)[0].schedule for seed in (1, 1, 2))
    assert first == second != other


# ----------------------------------------------------------------------------------------------------------------------- MILP


@pytest.mark.parametrize("spec", ["milp", "milp:backend=gurobi"])
def test_cycles_within_the_solvers_tolerance(spec: str) -> None:
    """Two tasks so near to each other that (7) does not exclude a cycle of them alone: it is forbidden, and not counted."""
    if "gurobi" in spec:
        pytest.importorskip("gurobipy")
    tasks = [[0.9, 0.0], [0.9, 1e-11], [-0.9, 0.0]]
    found, result = solved(spec, Instances.from_arrays([0.0, 0.0], tasks, [0.4, 0.4, 1.0], 2.0, 1))
    assert (found, result.bound) == pytest.approx((1.0, 1.0))


class Pretender(Backend):
    """
    A backend that reports what it is told to, once per round.

    :param answers: What it says
    """

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)

    def solve(self, program: Any, time_limit: float, threads: int, seed: int) -> Answer:
        return self.answers.pop(0)


def test_no_incumbent_gives_the_empty_schedule() -> None:
    solver = MILP()
    solver.backend = Pretender(Answer(None, math.inf))
    instance = UniformGenerator(9, n_uavs=2)(1, np.random.default_rng(0))
    found, result = solved(solver, instance)
    assert found == 0 and result.schedule == Schedule([(), ()])
    assert result.bound == int(instance.reachable().sum())


def test_what_is_feasible_of_an_incumbent_is_kept() -> None:
    """Of a tour and a cycle beside it, the tour stays when no time is left for another round."""
    instance = Instances.from_arrays([0.0, 0.0], [[0.5, 0.0], [0.0, 0.7], [0.0, 0.8]], None, 2.0, 1)
    # Arcs are (0, 1), (0, 2), (0, 3), (1, 0), (1, 2), (1, 3), (2, 0), (2, 1), (2, 3), (3, 0), (3, 1), (3, 2).
    columns = np.array([1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 1] + [1] * 3 + [0] * 3, dtype=float)
    solver = MILP()
    solver.backend = Pretender(Answer(columns, 3.0), Answer(None, 2.5))
    found, result = solved(solver, instance)
    assert (found, result.bound) == (1.0, 2.5)


def test_the_time_limit_is_kept_and_the_bound_holds() -> None:
    """Too large to be solved in a second; the bound is above what another solver finds."""
    instance = UniformGenerator(30, n_uavs=3, max_distance=1.2)(1, np.random.default_rng(4))
    _, result = solved("milp:time_limit=1", instance)
    assert result.bound is not None and result.bound >= objective("ortools", instance)


@pytest.mark.parametrize("n_tasks, n_uavs", [(1, 1), (1, 3), (4, 2), (7, 3), (30, 2), (20, 4), (16, 6)])
def test_size_of_the_program(n_tasks: int, n_uavs: int) -> None:
    reduced = ReducedInstance.of(UniformGenerator(n_tasks, n_uavs, max_distance=9.0)(1, np.random.default_rng(0)))
    program = paper_program(Places.of(reduced), n_uavs)
    assert program_size(n_tasks, n_uavs) == (len(program.objective), len(program.lower))
    assert len(program.starts) == len(program.lower) + 1 == len(program.upper) + 1
    assert program.starts[-1] == len(program.columns) == len(program.coefficients)


@pytest.mark.parametrize("n_uavs, largest", [(2, 30), (4, 20), (6, 16)])
def test_sizes_of_the_free_licence(n_uavs: int, largest: int) -> None:
    assert max(program_size(largest, n_uavs)) <= FREE_LICENCE_SIZE < max(program_size(largest + 1, n_uavs))


def test_too_large_for_any_machine() -> None:
    instance = UniformGenerator(1500, 6, max_distance=9.0)(1, np.random.default_rng(0))
    solver = make_solver("milp")
    for action in (solver.check, solver.solve):
        with pytest.raises(ValueError, match=r"13527000 variables and .* milp can have 2000000 of each.*use another solver"):
            action(instance)


def test_gurobi_and_its_licence() -> None:
    """Both backends agree; beyond the free licence there is a clear message, before any solving and during it."""
    gurobipy = pytest.importorskip("gurobipy")
    solver: Any = make_solver("milp:backend=gurobi")
    batch = UniformGenerator(7, n_uavs=2, max_distance=1.2)(4, np.random.default_rng(0))
    for row in range(4):
        (gurobi, result), (highs, _) = solved(solver, batch, row), solved("milp", batch, row)
        assert gurobi == highs == pytest.approx(result.bound)
    if solver.backend.size_limit != FREE_LICENCE_SIZE:
        pytest.skip(f"gurobipy {gurobipy.gurobi.version()} has a full licence here")
    large = Instances.concatenate([batch.pad(40), UniformGenerator(40, 2, max_distance=9.0)(1, np.random.default_rng(0))])
    with pytest.raises(
        ValueError, match=r"instance 4: the model has 3440 variables .* free licence admits.*milp:backend=highs"
    ):
        solver.check(large)
    with pytest.raises(ValueError, match="free licence admits"):
        solver.solve(large[4:])


def test_gurobi_without_a_licence(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    pytest.importorskip("gurobipy")
    licence = tmp_path / "gurobi.lic"
    licence.write_text("EXPIRATION=2001-01-01\nKEY=00000000\n")
    monkeypatch.setenv("GRB_LICENSE_FILE", str(licence))
    with pytest.raises(UnavailableError, match=r"Gurobi found no valid licence .* or use milp:backend=highs"):
        make_solver("milp:backend=gurobi")


# ------------------------------------------------------------------------------------------------------------------ reduction


@settings(max_examples=50)
@given(instance_batches(max_batch=1), st.integers(1, 10**6), st.integers(1, 62))
def test_prizes(instance: Instances, finest: int, bits: int) -> None:
    """Any prize outweighs every distance, larger values have at least as large prizes, and sums stay in bounds."""
    reduced = ReducedInstance.of(instance)
    assume(reduced.n_tasks > 0)
    prizes = reduced.integer_prizes(finest, 2**bits)
    smallest = reduced.n_uavs * RESOLUTION + 1
    assert prizes.min() >= smallest and (prizes % smallest == 0).all()
    assert sum(prizes.tolist()) <= max(2**bits, reduced.n_tasks * smallest)
    by_value = prizes[np.argsort(reduced.values, kind="stable")]
    assert (np.diff(by_value) >= 0).all()


@pytest.mark.parametrize(
    "values, ratios",
    [
        ([3, 3, 3], [1, 1, 1]),
        ([0.1, 0.1, 0.1], [1, 1, 1]),
        ([2, 4, 10], [1, 2, 5]),
        # Of two small tasks and a great one of the same value, the shorter tour must win.
        ([0.5, 1.5, 1.0], [1, 3, 2]),
        ([0.1, 0.3, 0.7], [1, 3, 7]),
        ([0.2, 0.3, 0.5], [2, 3, 5]),
        # Too fine: rounded, but never to nothing.
        ([1, 1000.4, 2000], [1, 500, 1000]),
        ([1e-9, 1e30, 5e29], [1, 1000, 500]),
    ],
)
def test_prizes_in_exact_proportion(values: list[float], ratios: list[int]) -> None:
    instance = Instances.from_arrays([0.0, 0.0], [[0.1, 0.0]] * 3, values, 2.0, 2)
    prizes = ReducedInstance.of(instance).integer_prizes(1000, 2**60)
    assert prizes.tolist() == [ratio * (2 * RESOLUTION + 1) for ratio in ratios]


@settings(max_examples=50)
@given(instance_batches(max_batch=1), st.data())
def test_integer_tours_are_feasible(instance: Instances, data: st.DataObject) -> None:
    """A closed tour that is short enough in rounded distances passes the checker."""
    reduced = ReducedInstance.of(instance)
    assume(reduced.n_tasks > 0)
    route = data.draw(st.permutations(range(1, reduced.n_tasks + 1)))[: data.draw(st.integers(1, reduced.n_tasks))]
    distances = reduced.integer_distances()
    length = sum(int(distances[a, b]) for a, b in zip([0, *route], [*route, 0], strict=True))
    if length <= RESOLUTION:
        schedule = reduced.schedule([route])
        check_schedule(instance, 0, schedule)
        assert reduced.routes(schedule) == [list(route)]


@settings(max_examples=30)
@given(seeds, st.integers(2, 12))
def test_tours_that_are_just_too_long(seed: int, n_tasks: int) -> None:
    """Rounding never makes an infeasible tour feasible, nor much that is feasible infeasible."""
    points = np.random.default_rng(seed).random((n_tasks + 1, 2))
    stops = [*range(n_tasks + 1), 0]
    length = sum(math.dist(points[a], points[b]) for a, b in pairwise(stops))
    for factor, feasible in ((1 - 1e-8, False), (1 + 1e-5, True)):
        distances = ReducedInstance.of(
            Instances.from_arrays(points[0], points[1:], None, length * factor, 1)
        ).integer_distances()
        assert (sum(int(distances[a, b]) for a, b in pairwise(stops)) <= RESOLUTION) == feasible


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


@needs_pyvrp
def test_other_versions_of_pyvrp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyvrp_search, "version", lambda _: "0.11.3")
    with pytest.raises(ImportError, match=r"needs PyVRP 0\.14, which needs Python 3.11 or newer; found PyVRP 0\.11\.3"):
        make_solver("pyvrp")


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

"""Tours of exactly the maximum flight distance are flyable for every solver, and rounding loses no schedule."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from brute_force import largest_value
from classical_helpers import HAS_PYVRP, objective
from conftest import instance_batches, seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from solver_helpers import MANY, make_kmeans_am, make_pair

from sb3_uav.envs import Instances, Schedule, check_schedule
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.local_search.search import improve, repair
from sb3_uav.solvers import Solver, make_solver, pyvrp_search
from sb3_uav.solvers.overlong_tours import with_feasible_tours
from sb3_uav.solvers.pyvrp_search import polish_schedule

pytestmark = pytest.mark.usefixtures("ticks")

SEARCHES = ("ortools", "ortools-gls:time_limit=0.05", *(["pyvrp:time_limit=0.3"] if HAS_PYVRP else []))
# Solvers that find every optimum of a handful of tasks here.
STRONG = ("milp", *SEARCHES)
HEURISTICS = ("greedy-insertion", "kmeans-nearest", "kmeans-vnd", "random-nearest")


def every_solver(n_uavs: int) -> list[Solver]:
    networks = [make_pair(n_uavs), make_pair(n_uavs, decode="augment", samples=MANY, repair=True), make_kmeans_am()]
    return [*map(make_solver, (*STRONG, *HEURISTICS)), *networks]


def length_of(points: np.ndarray) -> float:
    """Of the closed tour through points in this order, as the checker adds it up."""
    length = 0.0
    for a, b in pairwise([*points.tolist(), points[0].tolist()]):
        length += math.dist(a, b)
    return length


@st.composite
def rings(draw: st.DrawFn) -> Instances:
    """One UAV, and tasks around a circle or a rectangle of a lattice, whose one shortest tour has exactly the length D."""
    n_tasks = draw(st.integers(2, 12))
    if draw(st.booleans()):
        angle = 2 * math.pi * np.arange(n_tasks + 1) / (n_tasks + 1)
        points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        width, height = draw(st.integers(1, 4)), draw(st.integers(1, 3))
        bottom, top = [(x, 0) for x in range(width)], [(x, height) for x in range(width, 0, -1)]
        points = np.array(
            [*bottom, *((width, y) for y in range(height)), *top, *((0, y) for y in range(height, 0, -1))], dtype=float
        )
    points = points * draw(st.sampled_from([1.0, 1 / 3, 0.1, 1e6])) + draw(st.sampled_from([0.0, 0.7]))
    return Instances.from_arrays(points[0], points[1:], None, length_of(points), 1)


@settings(max_examples=40)
@given(rings())
def test_a_tour_of_exactly_the_maximum_distance_is_flown(instance: Instances) -> None:
    """Whatever its number of legs; integer distances that were rounded up lost it."""
    for spec in STRONG:
        if spec == "milp" and instance.n_tasks > 6:
            continue
        assert objective(spec, instance) == instance.n_tasks, spec
    whole = Schedule([range(instance.n_tasks)])
    for improved in (repair(instance, whole), improve(instance, whole, seed=1)):
        assert check_schedule(instance, 0, improved).objective == instance.n_tasks
    if HAS_PYVRP:
        assert check_schedule(instance, 0, polish_schedule(instance, whole, 0.1)).objective == instance.n_tasks


@pytest.mark.parametrize("spec", STRONG)
@pytest.mark.parametrize("n_tasks", [29, 100])
def test_tours_of_many_legs(spec: str, n_tasks: int) -> None:
    """Rounding every leg may not add up to a task."""
    if spec == "milp":
        pytest.skip("too large to be proven optimal in a test")
    angle = 2 * math.pi * np.arange(n_tasks + 1) / (n_tasks + 1)
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    instance = Instances.from_arrays(points[0], points[1:], None, length_of(points), 1)
    assert objective(spec, instance) == n_tasks


@st.composite
def lattices(draw: st.DrawFn) -> Instances:
    """A few valued tasks on a lattice, and a maximum distance that many tours have exactly."""
    generator = np.random.default_rng(draw(seeds))
    n_tasks = draw(st.integers(1, 6))
    points = generator.integers(0, 4, (n_tasks + 1, 2)) / draw(st.sampled_from([1.0, 3.0, 10.0]))
    order = generator.permutation(n_tasks)[: draw(st.integers(1, n_tasks))]
    limit = length_of(points[[0, *(order + 1)]])
    values = generator.integers(1, 4, n_tasks) if draw(st.booleans()) else None
    return Instances.from_arrays(points[0], points[1:], values, limit or 1.0, draw(st.integers(1, 3)))


@settings(max_examples=40)
@given(lattices())
def test_no_optimum_of_a_lattice_is_lost(instance: Instances) -> None:
    """Exact solvers and searches reach what brute force finds; nobody reaches more."""
    best = largest_value(instance)
    for spec in ("milp", *(["pyvrp:time_limit=0.3"] if HAS_PYVRP else [])):
        assert objective(spec, instance) == best, spec
    for spec in ("ortools", "ortools-gls:time_limit=0.05", *HEURISTICS):
        assert objective(spec, instance) <= best, spec


@settings(max_examples=40)
@given(instance_batches(max_tasks=10, max_batch=1))
def test_nobody_finds_less_than_the_best_single_tasks(instance: Instances) -> None:
    worth = instance.values[0][instance.reachable()[0]].sort(descending=True).values[: instance.n_uavs]
    for solver in every_solver(instance.n_uavs):
        assert objective(solver, instance) >= math.fsum(worth.tolist()) * (1 - 1e-15), solver.name


@pytest.mark.skipif(not HAS_PYVRP, reason="PyVRP is not installed")
def test_the_best_tour_misses_the_grid_by_a_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyVRP's tour is short enough in rounded distances and too long in true ones: it loses a task, not all of them."""
    monkeypatch.setattr(pyvrp_search, "RESOLUTION", 2_000_000)
    angle = 2 * math.pi * np.arange(21) / 21
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    instance = Instances.from_arrays(points[0], points[1:], None, length_of(points) * (1 - 1e-6), 1)
    reduced = ReducedInstance.of(instance)
    whole = list(range(1, 21))
    distances = reduced.coarse_distances()
    assert sum(distances[a, b] for a, b in pairwise([0, *whole, 0])) <= pyvrp_search.RESOLUTION
    assert reduced.tour_length(whole) > 1
    assert objective("pyvrp:time_limit=0.3", instance) == 19


@settings(max_examples=60)
@given(instance_batches(max_tasks=10, max_batch=1), seeds)
def test_tours_that_are_too_long_lose_as_little_as_they_must(instance: Instances, seed: int) -> None:
    """Feasible routes stay as they are, and the others keep at least their most valuable task."""
    reduced = ReducedInstance.of(instance)
    owner = np.random.default_rng(seed).integers(max(reduced.n_uavs, 1), size=reduced.n_tasks)
    routes = [[node for node in range(1, reduced.n_tasks + 1) if owner[node - 1] == uav] for uav in range(reduced.n_uavs)]
    found = with_feasible_tours(reduced, routes)
    check_schedule(instance, 0, reduced.schedule(found))
    for before, after in zip(routes, found, strict=True):
        if reduced.tour_length(before) <= 1:
            assert set(before) <= set(after)
        assert max((reduced.values[node - 1] for node in before), default=0) <= max(
            (reduced.values[node - 1] for node in after), default=0
        )
    if all(reduced.tour_length(route) <= 1 for route in routes):
        assert found == routes

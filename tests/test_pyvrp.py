"""PyVRP: any values, any seed, and starts from given schedules."""

from __future__ import annotations

import numpy as np
import pytest
from classical_helpers import Ticks, needs_pyvrp, objective, solved
from conftest import instance_batches, seeds
from hypothesis import given, settings

from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.solvers import make_solver, pyvrp_search
from sb3_uav.solvers.pyvrp_search import polish_schedule

pytestmark = pytest.mark.usefixtures("ticks")

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
    monkeypatch.setattr(pyvrp_search, "_PENALTY_PER_PRIZE", 1)
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


# --------------------------------------------------------------------------------------------------------- what is not there


@needs_pyvrp
def test_other_versions_of_pyvrp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyvrp_search, "version", lambda _: "0.11.3")
    with pytest.raises(ImportError, match=r"needs PyVRP 0\.14, which needs Python 3.11 or newer; found PyVRP 0\.11\.3"):
        make_solver("pyvrp")

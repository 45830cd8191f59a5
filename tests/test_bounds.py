"""Bounds: never below what any schedule is worth, equal to the optimum where they close, valid whenever they are stopped."""

from __future__ import annotations

import csv
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from brute_force import best_score
from classical_helpers import objective, solved, tight_instances
from conftest import instance_batches
from hypothesis import given, settings

pytest.importorskip("numba")
pytest.importorskip("highspy")

from sb3_uav.bounds import bound as bound_module
from sb3_uav.bounds import upper_bound, warm_up
from sb3_uav.cli import main as cli
from sb3_uav.common.optional import install_command
from sb3_uav.envs import Instances, Schedule, UniformGenerator


class Looks:
    """A clock that moves on with every look, so that a time limit ends after so many looks."""

    def __init__(self) -> None:
        self.n = 0

    def __call__(self) -> float:
        self.n += 1
        return float(self.n)


@pytest.fixture(autouse=True)
def short_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """First schedules by few trials instead of time, which a clock that counts looks does not measure."""
    monkeypatch.setattr(bound_module, "_MOST_SEARCH_SECONDS", 0.002)


def optimum(instance: Instances) -> float:
    """The largest total value of any schedule, whatever must be served."""
    plain = Instances.from_arrays(
        **{name: getattr(instance, name).numpy() for name in instance.present_fields() if name != "must_serve"},
        n_uavs=instance.n_uavs,
    )
    return best_score(plain)[1]


def check(instance: Instances, time_limit: float = 20.0) -> None:
    best = optimum(instance)
    (bound,) = upper_bound(instance, time_limit)
    # Brute force adds values up in another order.
    assert bound.value >= best * (1 - 1e-14)
    assert bound.best <= best * (1 + 1e-12)
    is_met, some_must = bound.best >= bound.value * (1 - 1e-8), instance.must_serve is not None and instance.must_serve.any()
    assert (bound.status == "optimal") == (is_met and not some_must)
    if bound.status == "optimal":
        assert bound.value == pytest.approx(best, rel=1e-8)


@settings(max_examples=25)
@given(tight_instances())
def test_never_below_the_optimum(instance: Instances) -> None:
    check(instance)


@settings(max_examples=25)
@given(instance_batches(max_tasks=6, max_batch=1))
def test_never_below_the_optimum_far_from_general_position(instance: Instances) -> None:
    """Coincident and collinear tasks, tours of exactly the maximum length, values of 0, more UAVs than tasks."""
    check(instance)


def whole_instance(seed: int, n_tasks: int = 6) -> Instances:
    """UAVs with their own starts, ends and distances, service costs, and tasks that must be served; some on a lattice."""
    rng = np.random.default_rng(seed)
    n_uavs = int(rng.integers(1, 4))
    points = rng.random((n_tasks, 2)) if seed % 3 else rng.integers(0, 3, (n_tasks, 2)) / 2.0
    ends = rng.random((2, n_uavs, 2)) if seed % 2 else np.repeat(rng.random((2, 1, 2)), n_uavs, 1)
    return Instances.from_arrays(
        [0.5, 0.5],
        points,
        rng.integers(0, 5, n_tasks) if seed % 5 else rng.random(n_tasks),
        rng.uniform(0.0, 1.5, n_uavs) + 0.01,
        n_uavs,
        start=ends[0],
        end=ends[1] if seed % 7 else ends[0],
        service=rng.random(n_tasks) * 0.2 * (rng.random() < 0.7),
        must_serve=rng.random(n_tasks) < 0.3,
    )


@pytest.mark.parametrize("first", range(0, 60, 20))
def test_never_below_the_optimum_of_the_whole_problem(first: int) -> None:
    for seed in range(first, first + 20):
        check(whole_instance(seed))


@settings(max_examples=10)
@given(tight_instances(max_tasks=5))
def test_equals_milp_where_it_closes(instance: Instances) -> None:
    found, result = solved("milp", instance)
    (bound,) = upper_bound(instance, 20.0)
    assert bound.value >= found and result.bound is not None
    if bound.status == "optimal":
        assert bound.value == pytest.approx(result.bound, rel=1e-6)


@pytest.mark.parametrize("n_looks", [1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377])
def test_valid_whenever_it_is_stopped(n_looks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped at any look at the clock, the bound is no lower than the bound that more time proves."""
    monkeypatch.setattr("sb3_uav.bounds.pricing._CHUNK", 20)
    monkeypatch.setattr("sb3_uav.bounds.column_generation.ColumnGeneration.add", lambda self, routes: None)
    instance = whole_instance(2, 7)
    (bound,) = upper_bound(instance, float(n_looks), clock=Looks())
    assert bound.value >= optimum(instance) * (1 - 1e-14)


def test_valid_with_hardly_any_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_FIRST_LABELS", "_LAST_LABELS", "_FAST_LABELS"):
        monkeypatch.setattr(f"sb3_uav.bounds.column_generation.{name}", 10)
    for seed in range(6):
        check(whole_instance(seed, 7))


@pytest.mark.parametrize("n_tasks, n_uavs, max_distance", [(20, 1, 1.5), (25, 3, 1.2), (30, 2, 1.0)])
def test_no_solver_is_above_it(n_tasks: int, n_uavs: int, max_distance: float) -> None:
    instances = UniformGenerator(n_tasks, n_uavs, max_distance)(2, np.random.default_rng(5))
    for row, bound in enumerate(upper_bound(instances, 5.0)):
        for spec in ("greedy-insertion", "kmeans-vnd", "local-search:time_limit=0.2"):
            assert objective(spec, instances, row) <= bound.value
        assert bound.value < n_tasks or bound.status == "optimal"


def test_closes_on_a_small_instance() -> None:
    """Where local search finds the best schedule, and column generation proves it."""
    instances = UniformGenerator(10, 2, 1.0)(6, np.random.default_rng(3))
    bounds = upper_bound(instances, 10.0)
    assert [bound.value for bound in bounds] == [optimum(instances[row]) for row in range(6)]
    assert sum(bound.status == "optimal" for bound in bounds) >= 5


@pytest.mark.parametrize("spread", [0.0, 1e-13, 1e-9, 1e-4])
def test_heaps_of_tasks(spread: float) -> None:
    """More tasks at one point, or nearly, than a route remembers: no walk goes round there for ever."""
    rng = np.random.default_rng(0)
    tasks = np.array([[0.3, 0.0]] * 20 + [[-0.4, 0.0]] * 20) + spread * rng.random((40, 2))
    instance = Instances.from_arrays([0.0, 0.0], tasks, np.ones(40), 0.9, 1)
    (bound,) = upper_bound(instance, 2.0)
    assert bound.value >= 20
    if spread < 1e-10:
        assert (bound.value, bound.status) == (20, "optimal")


def test_whole_values_round_down() -> None:
    instances = UniformGenerator(30, 2, 1.0)(2, np.random.default_rng(1))
    assert all(bound.value == int(bound.value) for bound in upper_bound(instances, 1.0))
    tens = Instances.from_arrays(instances.depot, instances.tasks, 10 * instances.values, instances.max_distance, 2)
    assert all(bound.value % 10 == 0 for bound in upper_bound(tens, 1.0))


def test_nothing_in_reach_and_nothing_of_value() -> None:
    far = Instances.from_arrays([0.0, 0.0], [[9.0, 9.0]], [1.0], 1.0, 3)
    worthless = Instances.from_arrays([0.0, 0.0], [[0.1, 0.1]], [0.0], 1.0, 3)
    for instance in (far, worthless):
        (bound,) = upper_bound(instance, 1.0)
        assert (bound.value, bound.status) == (0.0, "optimal")


def test_an_optimal_incumbent_ends_it() -> None:
    instance = Instances.from_arrays([0.0, 0.0], [[0.1, 0.0], [0.2, 0.0]], None, 1.0, 1)
    (bound,) = upper_bound(instance, 1.0, [Schedule([[0, 1]])], clock=Looks())
    assert (bound.value, bound.status, bound.seconds) == (2.0, "optimal", 1.0)


def test_what_is_refused() -> None:
    instance = Instances.from_arrays([0.0, 0.0], [[0.1, 0.0]], None, 1.0, 1)
    with pytest.raises(ValueError, match="time_limit of a bound is 0 seconds"):
        upper_bound(instance, 0.0)
    with pytest.raises(ValueError, match="2 schedules for 1 instances"):
        upper_bound(instance, 1.0, [None, None])
    with pytest.raises(ValueError, match="inf seconds"):
        upper_bound(instance, math.inf)


def test_a_bound_below_a_schedule_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_uav.bounds.column_generation.ColumnGeneration.bound", 3.0)
    instances = UniformGenerator(10, 2, 1.0)(1, np.random.default_rng(3))
    with pytest.raises(AssertionError, match="above the bound of 3; please report"):
        upper_bound(instances, 1.0)


# ------------------------------------------------------------------------------------------------------------------- command


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    instances = UniformGenerator(10, 2, 1.0)(2, np.random.default_rng(3))
    instances.save(tmp_path / "set.npz")
    out = tmp_path / "bounds.csv"
    arguments = ["bound", "--instances", str(tmp_path / "set.npz"), "--time-limit", "5", "--out", str(out)]
    assert cli.main(arguments) == 0
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["instance", "bound", "seconds", "status"]
    assert [float(row["bound"]) for row in rows] == [optimum(instances[row]) for row in range(2)]
    before = out.read_bytes()
    assert cli.main(arguments) == 2
    assert "add --overwrite" in capsys.readouterr().err and out.read_bytes() == before
    assert cli.main([*arguments, "--overwrite", "--jobs", "0"]) == 2
    assert "--jobs is 0" in capsys.readouterr().err


def test_without_numba() -> None:
    code = "import sys; sys.modules['numba'] = None; import sb3_uav.bounds.kernels"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert re.search(rf"Bounds need numba; run: {re.escape(install_command('solvers'))}", result.stderr)

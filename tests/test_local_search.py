"""Local search, ruin and recreate, K-means+VND: feasible, repeatable, never worse, at a local optimum where they say so."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from brute_force import largest_value
from conftest import instance_batches, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.common.optional import install_command
from sb3_uav.envs import ClusteredGenerator, Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import InfeasibleScheduleError
from sb3_uav.local_search import kernels
from sb3_uav.local_search import search as local_search
from sb3_uav.local_search.search import LocalSearch, improve, repair, repair_best
from sb3_uav.solvers import base, kmeans_vnd, make_solver
from sb3_uav.solvers.kmeans import kmeans


def random_schedule(instance: Instances, seed: int) -> Schedule:
    """Tasks in random order, each appended to a random tour or left out, where it fits."""
    rng = np.random.default_rng(seed)
    routes: list[list[int]] = [[] for _ in range(instance.n_uavs)]
    for task in rng.permutation(int(instance.task_mask[0].sum())):
        route = routes[rng.integers(len(routes))]
        if tour_length(instance, [*route, task]) <= float(instance.max_distance[0]) and rng.random() < 0.8:
            route.append(int(task))
    return Schedule(routes)


def with_starts(batch: Instances, seed: int) -> Iterator[tuple[Instances, Schedule]]:
    """Every instance of a batch with an empty and with a random schedule."""
    for row in range(len(batch)):
        yield batch[row], Schedule([])
        yield batch[row], random_schedule(batch[row], seed)


def tour_length(instance: Instances, route: list[int] | tuple[int, ...]) -> float:
    depot, tasks = instance.depot[0].tolist(), instance.tasks[0].tolist()
    return sum(math.dist(a, b) for a, b in itertools.pairwise([depot, *(tasks[task] for task in route), depot]))


def rank(instance: Instances, schedule: Schedule) -> tuple[float, float]:
    """Value first, then length; the check comes with it."""
    report = check_schedule(instance, 0, schedule)
    return report.objective, -report.length


def medium(n_tasks: int = 60, n_uavs: int = 3, seed: int = 0, valued: bool = False) -> Instances:
    instance = UniformGenerator(n_tasks, n_uavs)(1, np.random.default_rng(seed))
    if valued:
        values = np.random.default_rng(seed).random((1, n_tasks)) * 7
        instance = Instances.from_arrays(instance.depot, instance.tasks, values, n_uavs=n_uavs)
    return instance


# ------------------------------------------------------------------------------------------------------------------ repair


@settings(max_examples=150)
@given(instance_batches(max_tasks=12), seeds)
def test_repair_of_anything(batch: Instances, seed: int) -> None:
    """Feasible, never worse, and a second repair changes nothing, whatever the instance and the schedule."""
    for instance, start in with_starts(batch, seed):
        for max_string in (0, 3):
            repaired = repair(instance, start, max_string=max_string)
            assert rank(instance, repaired) >= rank(instance, start)
            assert repair(instance, repaired, max_string=max_string) == repaired


@settings(max_examples=15)
@given(seeds, st.booleans(), st.integers(1, 6), st.sampled_from([0.2, 1.0, 2.0, 10.0]))
def test_nothing_is_left_to_do(seed: int, valued: bool, n_uavs: int, max_distance: float) -> None:
    """After a repair nothing can be inserted, replaced, or reversed for the better: tried out in plain Python."""
    rng = np.random.default_rng(seed)
    points, values = rng.random((31, 2)), rng.integers(1, 4, 30) if valued else None
    instance = Instances.from_arrays(points[0], points[1:], values, max_distance, n_uavs)
    repaired = repair(instance, random_schedule(instance, seed))
    worth = instance.values[0].tolist()
    missing = set(range(30)) - set(itertools.chain(*repaired.routes))
    for route in repaired.routes:
        length = tour_length(instance, route)
        for i, j in itertools.combinations(range(len(route) + 1), 2):
            assert tour_length(instance, route[:i] + route[i:j][::-1] + route[j:]) > length - 1e-9
        for task, place in itertools.product(missing, range(len(route) + 1)):
            assert tour_length(instance, (*route[:place], task, *route[place:])) > max_distance
        for out in range(len(route)):
            rest = route[:out] + route[out + 1 :]
            for task, place in itertools.product(missing, range(len(route))):
                new = tour_length(instance, (*rest[:place], task, *rest[place:]))
                gain = worth[task] - worth[route[out]]
                assert gain < 0 or new > max_distance or (gain == 0 and new > length - 1e-9)


@pytest.mark.parametrize("valued", [False, True])
@pytest.mark.parametrize("generator", [UniformGenerator(120, 4), ClusteredGenerator(120, 4)])
def test_repair_gains(generator: UniformGenerator | ClusteredGenerator, valued: bool) -> None:
    """Of nearest-task tours it makes far better ones, and strings help."""
    batch = generator(6, np.random.default_rng(0))
    if valued:
        values = np.random.default_rng(1).random((6, 120)) * 7
        batch = Instances.from_arrays(batch.depot, batch.tasks, values, n_uavs=4)
    starts = [result.schedule for result in make_solver("kmeans-nearest").solve(batch)]
    value = np.array(
        [
            [
                rank(batch[row], schedule)[0]
                for schedule in (start, repair(batch[row], start, max_string=0), repair(batch[row], start))
            ]
            for row, start in enumerate(starts)
        ]
    )
    assert (np.diff(value, axis=1) >= 0).all()
    mean = value.mean(0)
    assert mean[1] > 1.15 * mean[0] and mean[2] > mean[1]


@settings(max_examples=25)
@given(seeds, st.integers(2, 5), st.integers(0, 10))
def test_shortening_keeps_the_books(seed: int, n_uavs: int, n_near: int) -> None:
    """The moves of one and between tours visit the same tasks on a shorter way, and what they say of lengths is true."""
    instance = medium(40, n_uavs, seed % 1000)
    search = LocalSearch(instance)
    plan = search._load(random_schedule(instance, seed))
    before, visited = plan.tours["length"].sum(), np.flatnonzero(plan.nodes["owner"] >= 0)
    plan.lists[kernels.QUEUE, : len(visited)] = visited
    plan.nodes["queued"][visited] = True
    changed = kernels.shorten(plan, len(visited), n_near)
    assert not plan.nodes["queued"][1:].any()
    np.testing.assert_array_equal(np.flatnonzero(plan.nodes["owner"] >= 0), visited)
    lengths, owners, positions = plan.tours["length"].copy(), plan.nodes["owner"].copy(), plan.nodes["position"].copy()
    kernels.measure_all(plan)
    np.testing.assert_allclose(plan.tours["length"], lengths, atol=1e-12)
    assert (plan.tours["length"] <= 1).all()
    np.testing.assert_array_equal(plan.nodes["owner"], owners)
    np.testing.assert_array_equal(plan.nodes["position"][visited], positions[visited])
    assert (lengths.sum() < before - 1e-12) if changed else (lengths.sum() == before)


@pytest.mark.parametrize("seed", range(3))
def test_values_that_differ_by_rounding(seed: int) -> None:
    """Sums of such values differ by the order of their terms; searches that took that for gains went round in circles."""
    rng = np.random.default_rng(seed)
    points, values = rng.random((61, 2)), np.where(rng.random(60) < 0.5, 0.3, 0.1 + 0.2)
    instance = Instances.from_arrays(points[0], points[1:], values, n_uavs=2)
    plan = LocalSearch(instance)._load(Schedule([]))
    n_rounds = next(n for n in range(500) if not kernels.descend(plan, 10, 16, 3))
    assert n_rounds > 1
    for max_string in (0, 3):
        repaired = repair(instance, Schedule([]), max_string=max_string)
        assert repair(instance, repaired, max_string=max_string) == repaired
    assert rank(instance, improve(instance, repaired, seconds=0.01)) >= rank(instance, repaired)


def test_values_of_very_different_sizes() -> None:
    """Small values count beside great ones, and beside greater ones that no UAV can reach."""
    points, values = [[0, 0.1], [0.1, 0], [0.1, 0.1], [9, 9]], [1e-300, 1e-9, 1, 1e30]
    instance = Instances.from_arrays([0, 0], points, values, max_distance=2.0, n_uavs=1)
    assert sorted(repair(instance, Schedule([])).routes[0]) == [0, 1, 2]
    near = Instances.from_arrays([0, 0], [[0, 0.5], [0.5, 0], [9, 9]], [1e-9, 2e-9, 1e9], max_distance=1.0, n_uavs=1)
    assert repair(near, Schedule([[0]])) == Schedule([[1]])


def test_distances_at_the_limit() -> None:
    """A tour of exactly the longest length is feasible, for the kernels as for the checker."""
    instance = Instances.from_arrays([0.1, 0.1], [[0.1, 0.4], [0.4, 0.1], [0.1, 0.5]], max_distance=0.6, n_uavs=1)
    assert repair(instance, Schedule([])).n_visited == 1
    square = Instances.from_arrays([0, 0], [[0, 1], [1, 1], [1, 0]], max_distance=4.0, n_uavs=1)
    assert repair(square, Schedule([])).n_visited == 3
    just_short = Instances.from_arrays([0, 0], [[0, 1], [1, 1], [1, 0]], max_distance=4.0 - 1e-7, n_uavs=1)
    assert repair(just_short, Schedule([])).n_visited == 2


def test_worthless_tasks_are_left_out() -> None:
    instance = Instances.from_arrays([0, 0], [[0, 0.1], [0.1, 0], [0.2, 0]], values=[0, 0, 1], n_uavs=2)
    assert repair(instance, Schedule([[0, 1], [2]])) == Schedule([[], [2]])
    assert repair(instance, Schedule([[0]])).routes.count(()) == 1


@pytest.mark.parametrize("valued", [False, True])
def test_padding_and_time(valued: bool) -> None:
    instance = medium(valued=valued)
    start = random_schedule(instance, 0)
    repaired = repair(instance, start)
    assert repair(instance.pad(90), start) == repaired
    assert repair(instance, start, seconds=1e9) == repaired
    assert repair(instance, start, seconds=0) == start


def test_the_best_of_many() -> None:
    instance = medium(valued=True)
    starts = [random_schedule(instance, seed) for seed in range(8)]
    ranks = [rank(instance, repair(instance, start)) for start in starts]
    assert rank(instance, repair_best(instance, starts)) == max(ranks)
    assert repair_best(instance, iter(starts * 2)) == repair_best(instance, starts)
    # Without any time it is the best of those that were given.
    best = max(starts, key=lambda start: rank(instance, start))
    assert repair_best(instance, starts, seconds=0) == best
    with pytest.raises(ValueError, match="no schedule to repair"):
        repair_best(instance, [])


def test_threads() -> None:
    """Searches do not get into one another's way."""
    instance = medium(100)
    search = LocalSearch(instance)
    starts = [random_schedule(instance, seed) for seed in range(12)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(search.repair, starts)) == [repair(instance, start) for start in starts]


def test_wrong_arguments() -> None:
    batch = UniformGenerator(5, 2)(2, np.random.default_rng(0))
    with pytest.raises(ValueError, match="one instance at a time, found 2"):
        repair(batch, Schedule([]))
    for call in (repair, improve):
        with pytest.raises(InfeasibleScheduleError, match="visited twice"):
            call(batch[0], Schedule([[0], [0]]))
    with pytest.raises(InfeasibleScheduleError, match="task 7"):
        repair_best(batch[0], [Schedule([[7]])])


# ------------------------------------------------------------------------------------------------------ ruin and recreate


@settings(max_examples=40)
@given(instance_batches(max_tasks=12), seeds)
def test_improvement_of_anything(batch: Instances, seed: int) -> None:
    """Feasible, never worse, and the seed decides."""
    for instance, start in with_starts(batch, seed):
        improved = improve(instance, start, seed=seed)
        assert rank(instance, improved) >= rank(instance, start)
        assert improve(instance, start, seed=seed) == improved


@pytest.mark.parametrize("valued", [False, True])
def test_improvement_finds_the_optimum(valued: bool) -> None:
    rng = np.random.default_rng(0)
    for n_uavs, max_distance in itertools.product((1, 2), (0.8, 1.2, 1.6, 2.0)):
        for _ in range(4):
            points, values = rng.random((7, 2)), rng.integers(1, 5, 6) if valued else None
            instance = Instances.from_arrays(points[0], points[1:], values, max_distance, n_uavs)
            assert rank(instance, improve(instance, Schedule([])))[0] == pytest.approx(largest_value(instance))


@pytest.mark.parametrize("valued", [False, True])
def test_improvement_beats_repair(valued: bool) -> None:
    gains, seed_matters = [], []
    for seed in range(4):
        instance = medium(100, 4, seed, valued)
        repaired = repair(instance, Schedule([]))
        improved = improve(instance, repaired, seed=seed)
        gains.append(rank(instance, improved)[0] / rank(instance, repaired)[0])
        seed_matters.append(improved != improve(instance, repaired, seed=seed + 100))
    assert np.mean(gains) > 1.01
    # Not everywhere: two seeds may find the same best schedule.
    assert any(seed_matters)


def test_improvement_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even without any time it gets at least as far as one repair, if that may end."""
    monkeypatch.setattr(local_search, "_LAST_REPAIR_SECONDS", math.inf)
    instance = medium()
    repaired = repair(instance, Schedule([]))
    for seconds in (0.0, 1e-6, 0.1):
        improved = improve(instance, Schedule([]), seconds)
        assert rank(instance, improved) >= rank(instance, repaired)


@pytest.mark.parametrize("given", [None, 0.0])
def test_the_last_repair_ends(given: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """However long it would go on, if there was a time limit at all."""
    rounds = iter(range(40))
    monkeypatch.setattr(kernels, "descend", lambda *_: next(rounds) < 30)
    monkeypatch.setattr(local_search, "_LAST_REPAIR_SECONDS", 0.0)
    improve(medium(), Schedule([]), given)
    assert next(rounds) == (31 if given is None else 0)


def test_random_numbers() -> None:
    plan = LocalSearch(medium())._load(Schedule([]), seed=3)
    drawn = np.array([kernels.uniform(plan) for _ in range(4000)])
    assert 0 <= drawn.min() and drawn.max() < 1
    counts = np.histogram(drawn, bins=20, range=(0, 1))[0]
    assert np.square(counts - 200).sum() / 200 < 60


@settings(max_examples=30)
@given(seeds, st.integers(0, 40), st.integers(1, 10))
def test_nearest_tasks(seed: int, n_tasks: int, n_near: int) -> None:
    points = np.random.default_rng(seed).integers(0, 6, (n_tasks + 1, 2))
    n_near = max(min(n_near, n_tasks - 1), 0)
    nodes = np.zeros(n_tasks + 1, kernels.NODE)
    nodes["x"], nodes["y"] = points.T
    near = np.full((n_tasks + 1, n_near), -1, np.int32)
    kernels.find_near(nodes, n_tasks, near)
    squares = np.square(points[:, None] - points).sum(-1).astype(float)
    squares[:, 0] = np.inf
    np.fill_diagonal(squares, np.inf)
    np.testing.assert_array_equal(near, squares.argsort(1, kind="stable")[:, :n_near])


def test_without_numba() -> None:
    code = """
import sys
sys.modules["numba"] = None
import sb3_uav.solvers
try:
    sb3_uav.solvers.make_solver("kmeans-vnd")
except ImportError as error:
    print(error)
"""
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert install_command("solvers") in printed


# ------------------------------------------------------------------------------------------------------------- K-means+VND


@settings(max_examples=60)
@given(instance_batches(max_tasks=12), seeds)
def test_kmeans_vnd_is_never_worse_than_its_start(batch: Instances, seed: int) -> None:
    vnd, nearest = make_solver("kmeans-vnd"), make_solver("kmeans-nearest")
    for row, (found, start) in enumerate(zip(vnd.solve(batch, seed=seed), nearest.solve(batch, seed=seed), strict=True)):
        assert rank(batch[row], found.schedule) >= rank(batch[row], start.schedule)


def test_kmeans_vnd_gains() -> None:
    """It beats K-means with the nearest task by far more than 10 %, and tours keep to their clusters."""
    batch = UniformGenerator(200, 4)(10, np.random.default_rng(0))
    value = {}
    for name in ("kmeans-vnd", "kmeans-nearest"):
        results = make_solver(name).solve(batch, seed=5)
        value[name] = np.mean([rank(batch[row], result.schedule)[0] for row, result in enumerate(results)])
        for row, result in enumerate(results):
            in_reach = np.flatnonzero(batch.reachable()[row])
            clusters = np.full(200, -1)
            clusters[in_reach] = kmeans(batch.tasks[row, in_reach].numpy(), 4, np.random.default_rng([5, row]))
            for uav, route in enumerate(result.schedule.routes):
                assert (clusters[list(route)] == uav).all()
    assert value["kmeans-vnd"] > 1.1 * value["kmeans-nearest"]


def test_loading_the_code_takes_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once in a process, and before the clock of the first instance starts."""
    clock = iter(range(100))
    calls: list[int] = []
    monkeypatch.setattr(kmeans_vnd, "_warm_up", cache(kmeans_vnd._warm_up.__wrapped__))
    monkeypatch.setattr(local_search, "warm_up", lambda: calls.append(next(clock)))
    monkeypatch.setattr(base, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    results = make_solver("kmeans-vnd").solve(UniformGenerator(5, 2)(2, np.random.default_rng(0)))
    assert calls == [0]
    assert [result.seconds for result in results] == [1, 1]


def test_warm_up() -> None:
    """K-means+VND loads nothing more after it."""
    code = """
from sb3_uav.envs import UniformGenerator
from sb3_uav.local_search import kernels
from sb3_uav.solvers import make_solver
import numpy as np

def signatures():
    return {name: len(f.signatures) for name, f in vars(kernels).items() if hasattr(f, "signatures")}

solver = make_solver("kmeans-vnd")
solver.prepare()
before = signatures()
assert before["descend"] == 1
solver.solve(UniformGenerator(30, 3)(1, np.random.default_rng(0)))
assert signatures() == before, (before, signatures())
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_restarts() -> None:
    for name in ("kmeans-vnd", "kmeans-nearest"):
        with pytest.raises(ValueError, match=f"restarts of {name} is 0; K-means needs at least 1 start"):
            make_solver(f"{name}:restarts=0")

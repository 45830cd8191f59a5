"""Local search on the whole problem, tasks that are dear, and schedules of the paper's problem that must stay as they are."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from brute_force import largest_value
from conftest import seeds, whole_batches
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import ClusteredGenerator, Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import InfeasibleScheduleError
from sb3_uav.local_search import kernels
from sb3_uav.local_search.search import LocalSearch, improve, repair
from sb3_uav.solvers import make_solver

GOLDEN: dict[str, list[str]] = json.loads((Path(__file__).parent / "golden" / "local_search.json").read_text(encoding="utf-8"))


def random_schedule(instance: Instances, seed: int) -> Schedule:
    """Tasks in random order, each appended to a random tour or left out, where the checker admits it."""
    rng = np.random.default_rng(seed)
    routes: list[list[int]] = [[] for _ in range(instance.n_uavs)]
    for task in rng.permutation(int(instance.task_mask[0].sum())).tolist():
        uav = int(rng.integers(len(routes)))
        routes[uav].append(task)
        try:
            check_schedule(instance, 0, Schedule(routes))
        except InfeasibleScheduleError:
            routes[uav].pop()
    return Schedule(routes)


def rank(instance: Instances, schedule: Schedule) -> tuple[float, float]:
    """Sum of prizes first, then length; the check comes with it."""
    report = check_schedule(replace(instance, values=instance.prizes, must_serve=None), 0, schedule)
    return report.objective, -report.length


# -------------------------------------------------------------------------------------------------------- the whole problem


@settings(max_examples=150)
@given(whole_batches(max_tasks=12), seeds)
def test_repair_of_anything(batch: Instances, seed: int) -> None:
    """Feasible, never worse, and a second repair changes nothing."""
    for row, empty in itertools.product(range(len(batch)), (True, False)):
        instance = batch[row]
        start = Schedule([]) if empty else random_schedule(instance, seed)
        for max_string in (0, 3):
            repaired = repair(instance, start, max_string=max_string)
            assert rank(instance, repaired) >= rank(instance, start)
            assert repair(instance, repaired, max_string=max_string) == repaired


@settings(max_examples=60)
@given(whole_batches(max_tasks=12), seeds)
def test_improvement_of_anything(batch: Instances, seed: int) -> None:
    """Feasible, never worse, and the seed decides."""
    for row, empty in itertools.product(range(len(batch)), (True, False)):
        instance = batch[row]
        start = Schedule([]) if empty else random_schedule(instance, seed)
        improved = improve(instance, start, seed=seed)
        assert rank(instance, improved) >= rank(instance, start)
        assert improve(instance, start, seed=seed) == improved


def whole(n_tasks: int, n_uavs: int, seed: int, **changes: Any) -> Instances:
    """Every UAV has its own start, end and distance, every task its own value and service cost."""
    rng = np.random.default_rng(seed)
    fields: dict[str, Any] = {
        "depot": rng.random(2),
        "tasks": rng.random((n_tasks, 2)),
        "values": rng.integers(1, 10, n_tasks),
        "max_distance": rng.uniform(0.8, 2.0, n_uavs) if n_uavs > 1 else 1.5,
        "n_uavs": n_uavs,
        "start": rng.random((n_uavs, 2)),
        "end": rng.random((n_uavs, 2)),
        "service": 0.1 * rng.random(n_tasks),
    }
    return Instances.from_arrays(**{**fields, **changes})


@settings(max_examples=40)
@given(seeds, st.integers(2, 5), st.integers(0, 10), st.booleans())
def test_shortening_keeps_the_books(seed: int, n_uavs: int, n_near: int, one_depot: bool) -> None:
    """
    The moves of one and between tours visit the same tasks on a shorter way, what they say of lengths is true, limits are kept
    and every tour keeps its own terminals.
    """
    depot = np.tile(np.random.default_rng(seed).random(2), (n_uavs, 1))
    instance = whole(40, n_uavs, seed, **({"start": depot, "end": depot} if one_depot else {}))
    search = LocalSearch(instance)
    plan = search._load(random_schedule(instance, seed))
    n_tasks = len(search._tasks)
    terminals = plan.routes[:n_uavs, 0].copy(), plan.routes[np.arange(n_uavs), plan.tours["size"] + 1].copy()
    before, visited = plan.tours["length"].sum(), 1 + np.flatnonzero(plan.nodes["owner"][1 : n_tasks + 1] >= 0)
    plan.lists[kernels.QUEUE, : len(visited)] = visited
    plan.nodes["queued"][visited] = True
    changed = kernels.shorten(plan, len(visited), n_near)
    assert not plan.nodes["queued"][1 : n_tasks + 1].any()
    np.testing.assert_array_equal(1 + np.flatnonzero(plan.nodes["owner"][1 : n_tasks + 1] >= 0), visited)
    np.testing.assert_array_equal(plan.routes[:n_uavs, 0], terminals[0])
    np.testing.assert_array_equal(plan.routes[np.arange(n_uavs), plan.tours["size"] + 1], terminals[1])
    lengths, owners = plan.tours["length"].copy(), plan.nodes["owner"].copy()
    kernels.measure_all(plan)
    np.testing.assert_allclose(plan.tours["length"], lengths, atol=1e-12)
    flying = plan.tours["size"] > 0
    assert (plan.tours["length"] <= plan.tours["limit"])[flying].all()
    np.testing.assert_array_equal(plan.nodes["owner"], owners)
    assert (lengths.sum() < before - 1e-12) if changed else (lengths.sum() == before)
    report = check_schedule(instance, 0, search._unload(plan))
    np.testing.assert_allclose(np.array(report.lengths)[flying] / float(instance.unit[0]), lengths[flying], atol=1e-12)


@settings(max_examples=15)
@given(seeds, st.integers(1, 4))
def test_nothing_is_left_to_do(seed: int, n_uavs: int) -> None:
    """After a repair nothing can be inserted, replaced by more, or reversed for the better: tried out by the checker."""
    instance = whole(20, n_uavs, seed)
    repaired = repair(instance, random_schedule(instance, seed))
    worth, value = instance.values[0].tolist(), rank(instance, repaired)[0]
    missing = set(range(20)) - set(itertools.chain(*repaired.routes))

    def changed(uav: int, route: tuple[int, ...]) -> Schedule | None:
        """The schedule with another route, if that is feasible."""
        schedule = Schedule([*repaired.routes[:uav], route, *repaired.routes[uav + 1 :]])
        try:
            check_schedule(instance, 0, schedule)
        except InfeasibleScheduleError:
            return None
        return schedule

    for uav, route in enumerate(repaired.routes):
        for i, j in itertools.combinations(range(len(route) + 1), 2):
            turned = changed(uav, route[:i] + route[i:j][::-1] + route[j:])
            assert turned is None or rank(instance, turned) <= (value, rank(instance, repaired)[1] + 1e-9)
        for task, place in itertools.product(missing, range(len(route) + 1)):
            assert changed(uav, (*route[:place], task, *route[place:])) is None
        for out, task, place in itertools.product(range(len(route)), missing, range(len(route))):
            rest = route[:out] + route[out + 1 :]
            if worth[task] > worth[route[out]]:
                assert changed(uav, (*rest[:place], task, *rest[place:])) is None


@st.composite
def tiny(draw: st.DrawFn) -> Instances:
    """Six tasks and up to three UAVs that differ in any of the fields, with values of any size."""
    rng, n_uavs = np.random.default_rng(draw(seeds)), draw(st.integers(1, 3))
    kinds = {"ones": np.ones(6), "few": rng.integers(1, 5, 6), "orders": 10.0 ** rng.integers(-1, 9, 6)}
    changes: dict[str, Any] = {"values": kinds[draw(st.sampled_from(sorted(kinds)))]}
    for name in ("start", "end", "service"):
        if draw(st.booleans()):
            changes[name] = None
    if draw(st.booleans()):
        changes["must_serve"] = rng.random(6) < 0.3
    if draw(st.booleans()):
        changes["max_distance"] = 1.2
    return whole(6, n_uavs, draw(seeds), **changes)


@settings(max_examples=40)
@given(tiny())
def test_improvement_finds_the_optimum(instance: Instances) -> None:
    """No search finds more than there is, and a longer one finds all of it from one of a few seeds."""
    best, search = largest_value(instance), LocalSearch(instance)
    found = [rank(instance, search.improve(Schedule([]), seed=seed, n_trials=4000))[0] for seed in range(3)]
    found.append(rank(instance, search.repair(Schedule([])))[0])
    found.append(rank(instance, search.insertion())[0])
    assert max(found) == pytest.approx(best, rel=1e-9, abs=1e-300)


@settings(max_examples=30)
@given(seeds, st.sampled_from(["start", "end", "both", "service", "max_distance", "must_serve"]))
def test_the_paper_s_problem_in_other_words(seed: int, field: str) -> None:
    """One depot that every UAV starts from and ends at, or equal distances, however they are given, are no other problem."""
    plain = UniformGenerator(30, n_uavs=3)(1, np.random.default_rng(seed))
    depots = plain.depot[:, None].expand(-1, 3, -1).clone()
    forms: dict[str, dict[str, Any]] = {
        "start": {"start": depots},
        "end": {"end": depots},
        "both": {"start": depots, "end": depots},
        "service": {"service": th.zeros_like(plain.values)},
        "max_distance": {"max_distance": plain.max_distance[:, None].expand(-1, 3).clone()},
        "must_serve": {"must_serve": th.zeros_like(plain.task_mask)},
    }
    same = replace(plain, **forms[field])
    for instance in (plain, same):
        search = LocalSearch(instance)
        assert len(search._nodes) == len(search._tasks) + 1
        assert search.insertion() == LocalSearch(plain).insertion()
        assert search.repair(Schedule([]), max_string=0) == LocalSearch(plain).repair(Schedule([]), max_string=0)


@settings(max_examples=40)
@given(whole_batches(max_tasks=10, max_batch=1), seeds)
def test_padding_and_scale_change_nothing(instance: Instances, seed: int) -> None:
    """More slots, or another unit of length that is a power of two."""
    start = random_schedule(instance, seed)
    repaired, improved = repair(instance, start), improve(instance, start, seed=seed)
    assert repair(instance.pad(13), start) == repaired
    larger = instance.map_points(lambda points: 8.0 * points)
    larger = replace(
        larger,
        depot=8.0 * instance.depot,
        max_distance=8.0 * instance.max_distance,
        service=None if instance.service is None else 8.0 * instance.service,
    )
    assert repair(larger, start) == repaired and improve(larger, start, seed=seed) == improved


def test_moves_by_hand() -> None:
    """What stays of a tour when start and end differ: nothing is turned round as a whole, and tails change their end."""
    straight = Instances.from_arrays(
        [0, 0], [[1, 0], [2, 0], [3, 0]], None, 4.0, 1, start=[[0, 0]], end=[[4, 0]], service=[0, 0, 0]
    )
    assert repair(straight, Schedule([[0]])) == Schedule([[0, 1, 2]])
    # Two UAVs that cross over to each other's tasks.
    points = [[0, 0.1], [1, 0.1], [0, 0.9], [1, 0.9]]
    crossed = Instances.from_arrays([0, 0], points, None, 3.0, 2, start=[[0, 0], [0, 1]], end=[[1, 0], [1, 1]])
    assert repair(crossed, Schedule([[0, 3], [2, 1]])) == Schedule([[0, 1], [2, 3]])
    # The same, but each has to end on the other side.
    back = Instances.from_arrays([0, 0], points, None, 3.0, 2, start=[[0, 0], [1, 1]], end=[[1, 0], [0, 1]])
    assert repair(back, Schedule([[0, 2], [3, 1]])) == Schedule([[0, 1], [3, 2]])
    # Service costs what it says.
    dear = Instances.from_arrays([0, 0], [[1, 0], [0, 1]], None, 3.5, 1, service=[0.0, 0.05])
    assert repair(dear, Schedule([])).n_visited == 2
    assert repair(replace(dear, service=th.tensor([[0.0, 0.1]], dtype=th.float64)), Schedule([])).n_visited == 1


def test_a_uav_that_cannot_reach_its_end_takes_no_tasks() -> None:
    instance = Instances.from_arrays([0, 0], [[0, 0], [1, 0]], None, 3.0, 2, end=[[9, 0], [0, 0]])
    for search in (repair, improve):
        assert search(instance, Schedule([])).routes[0] == ()
        assert sorted(search(instance, Schedule([])).routes[1]) == [0, 1]


@pytest.mark.parametrize("seed", range(3))
def test_annealing_is_blind_to_the_end_of_a_uav_that_cannot_fly(seed: int) -> None:
    """Its way is no part of the length that tours are saved."""
    found = []
    for far in (3.0, 30.0):
        end = np.full((3, 2), 0.5)
        end[2] += far
        instance = whole(60, 3, seed, max_distance=np.array([1.5, 1.8, 1.0]), start=np.full((3, 2), 0.5), end=end)
        search = LocalSearch(instance)
        found.append(search.improve(Schedule([]), seed=seed, n_trials=1000).routes)
    assert found[0] == found[1] and found[0][2] == () and min(map(len, found[0][:2])) > 0


def test_a_uav_that_flies_a_tiny_part_of_what_another_flies() -> None:
    """Rounding of the far one's coordinates must not make tours of the near one too long for the checker."""
    rng = np.random.default_rng(0)
    for part in (1e-2, 1e-4, 1e-6):
        tasks = 0.3 + part * rng.integers(0, 5, (30, 2)) / 8
        start = [[0.3, 0.3], [0.0, 0.0]]
        instance = Instances.from_arrays([0, 0], tasks, None, [part * 1.5, 0.1], 2, start=start, end=start)
        repaired = repair(instance, Schedule([]))
        assert check_schedule(instance, 0, repaired).objective >= 5
        assert (
            check_schedule(instance, 0, improve(instance, repaired)).objective
            >= check_schedule(instance, 0, repaired).objective
        )


# ---------------------------------------------------------------------------------------------------------------- dear tasks


def with_a_dear_task(seed: int, n_uavs: int) -> tuple[Instances, Schedule, int]:
    """A repaired schedule without the farthest task in reach, which is worth more than all others together."""
    rng = np.random.default_rng(seed)
    points, values = rng.random((41, 2)), 3.0 * rng.random(40)
    home = np.hypot(*(points[1:] - points[0]).T)
    dear = int(np.argmax(np.where(2 * home <= 1.6, home, 0.0)))
    values[dear] = 0.0
    schedule = repair(Instances.from_arrays(points[0], points[1:], values, 1.6, n_uavs), Schedule([]))
    values[dear] = 1.01 * values.sum()
    return Instances.from_arrays(points[0], points[1:], values, 1.6, n_uavs), schedule, dear


@pytest.mark.parametrize("n_uavs", [1, 3])
def test_a_dear_task_is_never_missed(n_uavs: int) -> None:
    missed = {"repair": 0, "improve": 0}
    for seed in range(24):
        instance, start, dear = with_a_dear_task(seed, n_uavs)
        assert all(dear not in route for route in start.routes)
        for name, found in (("repair", repair(instance, start)), ("improve", improve(instance, start, 0.01))):
            missed[name] += all(dear not in route for route in found.routes)
    assert missed == {"repair": 0, "improve": 0}


@settings(max_examples=100)
@given(whole_batches(max_tasks=10, max_batch=1), seeds, st.sampled_from([1.01, 1e9]))
def test_no_dear_task_is_missed_in_any_instance(instance: Instances, seed: int, factor: float) -> None:
    reachable = th.nonzero(instance.reachable()[0])[:, 0].tolist()
    if not reachable:
        return
    dear = reachable[seed % len(reachable)]
    start = Schedule([[task for task in route if task != dear] for route in random_schedule(instance, seed).routes])
    values = instance.values.clone()
    values[0, dear] = factor * (values * instance.task_mask).sum() + 1.0
    instance = replace(instance, values=values, must_serve=None)
    for found in (repair(instance, start), improve(instance, start, seed=seed)):
        assert any(dear in route for route in found.routes)


def test_a_far_group_is_worth_a_tour() -> None:
    """None of its tasks alone outweighs the tour that leaves for them; together they do."""
    near, far = [[0.1 * i, 0.1] for i in range(8)], [[-0.9, 0.05 * i] for i in range(-3, 4)]
    instance = Instances.from_arrays([0, 0], near + far, [1.0] * 8 + [4.0] * 7, 2.2, 1)
    assert rank(instance, repair(instance, Schedule([range(8)])))[0] == 28.0


def test_ordinary_tasks_count_beside_dear_ones() -> None:
    """Annealing that took its measure from two dear tasks would leave the others to chance."""
    gains, by_chance = 0, 0
    for seed in range(3):
        plain = UniformGenerator(150, n_uavs=4)(1, np.random.default_rng(seed))
        values = plain.values.clone()
        values[0, plain.reachable()[0].nonzero()[:2, 0]] = 1e6
        search = LocalSearch(replace(plain, values=values))
        start = search.repair(Schedule([]))
        gains += search.improve(start, seed=1, n_trials=20_000).n_visited - start.n_visited
        search._ordinary = np.inf
        by_chance += search.improve(start, seed=1, n_trials=20_000).n_visited - start.n_visited
    assert gains >= by_chance + 3


# ----------------------------------------------------------------------------------------------------- the paper's problem


def plain_instances() -> Iterator[tuple[str, Instances]]:
    for n_tasks, n_uavs, seed in [(20, 2, 0), (60, 3, 1), (120, 4, 2), (200, 6, 3)]:
        for kind in ("uniform", "clustered", "valued", "lattice", "short"):
            rng = np.random.default_rng(seed)
            if kind == "clustered":
                yield f"{kind}-{n_tasks}", ClusteredGenerator(n_tasks, n_uavs)(1, rng)
                continue
            points = rng.integers(0, 12, (n_tasks + 1, 2)) / 12 if kind == "lattice" else rng.random((n_tasks + 1, 2))
            values = rng.random(n_tasks) * 7 if kind == "valued" else None
            max_distance = 0.7 if kind == "short" else 2.0
            yield f"{kind}-{n_tasks}", Instances.from_arrays(points[0], points[1:], values, max_distance, n_uavs)


def test_schedules_of_the_paper_s_problem_stay_as_they_are() -> None:
    """They were written before local search knew the whole problem."""
    for name, instance in plain_instances():
        search = LocalSearch(instance)
        repaired = search.repair(Schedule([]))
        found = (
            search.repair(Schedule([]), max_string=0),
            repaired,
            search.improve(Schedule([]), seed=1, n_trials=300),
            search.improve(repaired, seed=2, n_trials=3000),
        )
        digests = [hashlib.sha256(json.dumps(schedule.routes).encode()).hexdigest()[:16] for schedule in found]
        assert digests == GOLDEN[name], name


@settings(max_examples=60)
@given(whole_batches(max_tasks=10, max_batch=1))
def test_nothing_fits_in_behind_an_insertion(instance: Instances) -> None:
    search = LocalSearch(instance)
    inserted = search.insertion()
    check_schedule(instance, 0, inserted)
    plan = search._load(inserted)
    assert kernels.fill_everywhere(plan) == 0 and search._unload(plan) == inserted


@pytest.mark.parametrize("n_tasks", [30, 100])
def test_insertion_is_that_of_the_solver(n_tasks: int) -> None:
    batch = UniformGenerator(n_tasks, 4)(8, np.random.default_rng(0))
    solved = [result.schedule for result in make_solver("greedy-insertion").solve(batch)]
    assert [LocalSearch(batch[row]).insertion() for row in range(8)] == solved

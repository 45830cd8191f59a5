"""The solvers on the whole problem: exact where they claim it, feasible everywhere, or a clear refusal."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch as th
from brute_force import best_score
from classical_helpers import ALL, HAS_PYVRP, needs_pyvrp, tight_instances
from conftest import instance_batches, seeds, whole_batches
from hypothesis import given, settings
from hypothesis import strategies as st
from solver_helpers import make_kmeans_am, make_pair

from sb3_uav import pretrained
from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.reduction import RESOLUTION, ReducedInstance
from sb3_uav.solvers import SOLVERS, Solver, make_solver
from sb3_uav.solvers.counting_tasks import CountingTasks
from sb3_uav.solvers.kmeans import clusters_of_uavs, kmeans
from sb3_uav.solvers.matching import cheapest_assignment
from sb3_uav.solvers.overlong_tours import with_feasible_tours
from sb3_uav.solvers.pyvrp_search import polish_schedule

pytestmark = pytest.mark.usefixtures("ticks")

CLASSICAL = (*ALL, "local-search:time_limit=0.05", "kmeans-vnd", "kmeans-nearest", "random-nearest")
# These find the best schedule of a handful of tasks by hand.
SEARCHES = ("milp", "ortools", "ortools-gls:time_limit=0.05", *(["pyvrp:time_limit=0.3"] if HAS_PYVRP else []))


def score(instances: Instances, row: int, schedule: Schedule) -> tuple[int, float]:
    """What the checker says: how many tasks are served that must be, and the total value."""
    report = check_schedule(instances, row, schedule)
    must = 0 if instances.must_serve is None else int((instances.must_serve & instances.task_mask)[row].sum())
    return must - len(report.unserved), report.objective


def found_by(spec: str | Solver, instance: Instances) -> tuple[int, float]:
    (result,) = (make_solver(spec) if isinstance(spec, str) else spec).solve(instance)
    return score(instance, 0, result.schedule)


# --------------------------------------------------------------------------------------------------------------- optimality


def check_against_brute_force(instance: Instances) -> None:
    """Brute force = MILP = its bound >= every other solver."""
    n_must, value = best_score(instance)
    (result,) = make_solver("milp").solve(instance)
    found = score(instance, 0, result.schedule)
    assert found[0] == n_must and found[1] == pytest.approx(value, rel=1e-7)
    if instance.must_serve is None:
        assert result.bound == pytest.approx(value, rel=1e-6) and result.bound is not None and result.bound >= found[1]
    for spec in CLASSICAL:
        assert found_by(spec, instance) <= (n_must, value * (1 + 1e-12)), spec


@settings(max_examples=40)
@given(whole_batches(max_tasks=5, max_batch=1))
def test_milp_is_optimal(instance: Instances) -> None:
    check_against_brute_force(instance)


@st.composite
def mixed_fleets(draw: st.DrawFn) -> Instances:
    """One instance in general position with UAVs of every kind, few of which can serve everything."""
    plain = draw(tight_instances(max_tasks=6))
    rng = np.random.default_rng(draw(seeds))
    n_uavs = draw(st.integers(1, 4))
    sites = rng.random((3, 2))
    given_fields: dict[str, Any] = {
        "start": sites[rng.integers(3, size=n_uavs)],
        "end": sites[rng.integers(3, size=n_uavs)],
        "max_distance": 2.0 * plain.max_distance.numpy()[0] * rng.choice([0.0, 0.3, 0.7, 1.0], n_uavs),
        "service": 0.1 * rng.random(plain.n_tasks) * (rng.random(plain.n_tasks) < 0.5),
        "must_serve": rng.random(plain.n_tasks) < draw(st.sampled_from([0.0, 0.4])),
    }
    given_fields["max_distance"][0] = 1.0
    if n_uavs == 1:
        given_fields["max_distance"] = 1.0
    return Instances.from_arrays(plain.depot[0], plain.tasks[0], plain.values[0], n_uavs=n_uavs, **given_fields)


@settings(max_examples=40)
@given(mixed_fleets())
def test_milp_is_optimal_in_general_position(instance: Instances) -> None:
    check_against_brute_force(instance)


@pytest.mark.parametrize("must", [False, True])
@pytest.mark.parametrize(
    "values",
    [[10**9, 1, 3, 2, 10**9, 2], [10**9 - 3, 10**9 - 1, 10**9, 10**9 - 7, 10**9 - 2, 0], [7, 10**4, 10**8, 3, 10**6, 11]],
)
def test_whole_values_up_to_a_billion_are_exact(values: list[int], must: bool) -> None:
    """Also beside tasks that must be served, which count as twice all values together."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        points = rng.random((7, 2))
        needed = np.array([must, False, False, False, False, must])
        instance = Instances.from_arrays(points[0], points[1:], values, rng.uniform(0.7, 1.2, 2), 2, must_serve=needed)
        best = best_score(instance)
        (result,) = make_solver("milp").solve(instance)
        assert score(instance, 0, result.schedule) == best
        assert must or result.bound == pytest.approx(best[1], rel=1e-15)


# ------------------------------------------------------------------------------------------------------------ fields by hand


def on_a_line(places: list[float], **changes: Any) -> Instances:
    """Tasks on a line, and a depot at 0."""
    return Instances.from_arrays([0.0, 0.0], [[place, 0.0] for place in places], **changes)


@pytest.mark.parametrize("spec", [*SEARCHES, "greedy-insertion", "kmeans-nearest"])
def test_starts_ends_and_ranges(spec: str) -> None:
    across = on_a_line([1, 4, 9], start=[[0, 0]], end=[[10, 0]], max_distance=10.0, n_uavs=1)
    assert found_by(spec, across)[1] == 3
    # From the depot and back it is 5 at most.
    assert found_by(spec, replace(across, start=None, end=None))[1] == 2
    # Tasks at 7 and 8 are in reach of the second UAV only, which starts beside them and comes home.
    afield = on_a_line([7, 8, 1], start=[[0, 0], [9, 0]], end=[[0, 0], [0, 0]], max_distance=9.0, n_uavs=2)
    assert found_by(spec, afield)[1] == 3
    unequal = on_a_line([1, 5, -5], max_distance=[2.0, 20.0], n_uavs=2)
    assert found_by(spec, unequal)[1] >= (3 if "nearest" not in spec else 2)
    assert found_by(spec, on_a_line([1, 5, -5], max_distance=[2.0, 19.0], n_uavs=2))[1] == 2


@pytest.mark.parametrize("spec", [*SEARCHES, "greedy-insertion", "kmeans-nearest"])
def test_service_costs_count_towards_the_distance(spec: str) -> None:
    """2 and 3 are on the way to 4; what serving them costs is not."""
    for free, served in ((0.0, 1), (0.4, 2), (1.0, 3)):
        instance = on_a_line([2, 3, 4], service=[0.6, 0.4, 0.0], max_distance=8.0 + free, n_uavs=1, values=[1, 1, 100])
        report = check_schedule(instance, 0, make_solver(spec).solve(instance)[0].schedule)
        assert report.objective >= (99 + served if "nearest" not in spec else 1)
        assert report.length <= 8.0 + free + 1e-9
    # A task where the UAV stands, which costs all that it can fly, and half of it.
    hovering = on_a_line([0, 0, 0], service=[2.0, 1.0, 1.0], values=[3.0, 1.0, 1.5], max_distance=2.0, n_uavs=1)
    assert found_by(spec, hovering)[1] >= (3.0 if "greedy" not in spec and "nearest" not in spec else 2.5)


@pytest.mark.parametrize("spec", [*SEARCHES, "greedy-insertion"])
def test_what_must_be_served_comes_first(spec: str) -> None:
    """Before any value, and of two such tasks the more valuable one."""
    for values, best in (([0, 1000, 1000, 0.5], 0.5), ([1, 1000, 1000, 0.5], 1), ([1, 1e9, 1e9, 0], 1)):
        instance = on_a_line(
            [5, -1, -2, 5.0], values=values, must_serve=[True, False, False, False], max_distance=10.0, n_uavs=1
        )
        assert found_by(spec, instance) == (1, best + (values[3] if best == 1 else 0))
    two = on_a_line([5, -5], values=[1, 2], must_serve=[True, True], max_distance=10.0, n_uavs=1)
    assert found_by(spec, two) == (1, 2)


@pytest.mark.parametrize("spec", [*CLASSICAL])
def test_uavs_that_cannot_fly_stay(spec: str) -> None:
    """One whose end is out of its reach, and one that can fly no distance at all."""
    instance = on_a_line(
        [1, 2, 3], n_uavs=3, start=[[0, 0], [0, 0], [0, 0.5]], end=[[0, 0], [30, 0], [0, 0.5]], max_distance=[10.0, 10.0, 0.0]
    )
    (result,) = make_solver(spec).solve(instance)
    report = check_schedule(instance, 0, result.schedule)
    assert len(result.schedule.routes) == 3 and result.schedule.routes[1:] == ((), ())
    assert report.lengths[1:] == (0.0, 0.0)
    assert report.objective == 3 or spec == "random-nearest"
    grounded = on_a_line([1, 2], n_uavs=2, end=[[30, 0], [40, 0]], max_distance=10.0)
    assert make_solver(spec).solve(grounded)[0].schedule == Schedule([(), ()])


# -------------------------------------------------------------------------------------------------------------- all solvers


@cache
def of_every_kind(n_uavs: int) -> dict[str, Solver]:
    """A solver of every name in the registry."""
    pair = make_pair(n_uavs)
    made: dict[str, Solver] = {"dl-drl": pair, "dl-drl-i": pair, "kmeans-am": make_kmeans_am()}
    specs = {"sb3": f"sb3:zip={pretrained.files()[0]}", "ortools-gls": "ortools-gls:time_limit=0.02"}
    specs["pyvrp"] = "pyvrp:time_limit=0.02"
    names = [name for name in SOLVERS if name not in made and (name != "pyvrp" or HAS_PYVRP)]
    return {**made, **{name: make_solver(specs.get(name, name)) for name in names}}


@settings(max_examples=20)
@given(whole_batches(max_tasks=5, max_batch=2))
def test_every_solver_solves_the_whole_problem_or_says_that_it_does_not(batch: Instances) -> None:
    """What must be served, all can do: it is a matter of values for them."""
    solvers = of_every_kind(batch.n_uavs)
    assert len(solvers) >= len(SOLVERS) - 1
    needs_more = batch.beyond_the_paper
    for solver in set(solvers.values()):
        if solver.solves_whole_problem or not needs_more:
            solver.check(batch)
            results = solver.solve(batch)
            assert len(results) == len(batch)
            for row, result in enumerate(results):
                assert len(result.schedule.routes) == batch.n_uavs
                worth = batch.reachable()[row] & (batch.prizes[row] > 0)
                assert (result.schedule.n_visited > 0) == bool(worth.any()), solver.name
                score(batch, row, result.schedule)
        else:
            message = (
                f"^{re.escape(solver.name)} solves only .* these have {', '.join(needs_more)}; {re.escape(solver.remedy)}\\.$"
            )
            for action in (solver.check, solver.solve):
                with pytest.raises(ValueError, match=message):
                    action(batch)


# ----------------------------------------------------------------------------------------------------------------- reduction


@settings(max_examples=60)
@given(whole_batches(max_batch=1), st.data())
def test_lengths_are_the_checkers(instance: Instances, data: st.DataObject) -> None:
    """Whatever a UAV flies, in units of what the one that flies farthest can fly; so is whether it can."""
    reduced = ReducedInstance.of(instance)
    if reduced.n_tasks == 0:
        return
    unit = float(instance.unit[0])
    numbers = [number for kind in reduced.kinds for number in kind.members[: reduced.n_tasks]]
    for uav in range(reduced.n_uavs):
        nodes = data.draw(st.permutations(range(reduced.n_sites, len(reduced.distances))))
        route = nodes[: data.draw(st.integers(1, len(nodes)))]
        schedule = reduced.schedule([[] for _ in range(uav)] + [route])
        assert schedule.routes[numbers[uav]] == tuple(reduced.tasks[node - reduced.n_sites] for node in route)
        generous = replace(instance, max_distance=instance.uav_distance * 1e6 + 1e9 * unit)
        length = check_schedule(generous, 0, schedule).lengths[numbers[uav]]
        assert reduced.tour_length(route, uav) == pytest.approx(length / unit, rel=1e-8, abs=1e-12)
        if reduced.fits(route, uav):
            check_schedule(instance, 0, schedule)
        fine = sum(int(reduced.fine_distances()[a, b]) for a, b in itertools.pairwise(reduced.tour(route, uav)))
        if fine <= reduced.fine_limits()[uav]:
            check_schedule(instance, 0, schedule)
        coarse = sum(int(reduced.coarse_distances()[a, b]) for a, b in itertools.pairwise(reduced.tour(route, uav)))
        assert coarse <= reduced.coarse_limit(reduced.uavs[uav]) or not reduced.fits(route, uav)
    assert not np.triu(reduced.distances - reduced.distances.T).any()


@settings(max_examples=60)
@given(whole_batches(max_batch=1), seeds)
def test_routes_return_to_uavs_of_their_kind(instance: Instances, seed: int) -> None:
    """A schedule as nodes and back keeps what it serves, and stays feasible."""
    reduced = ReducedInstance.of(instance)
    (result,) = make_solver("random-nearest").solve(instance, seed=seed)
    if reduced.n_tasks == 0:
        return
    back = reduced.schedule(with_feasible_tours(reduced, reduced.routes(result.schedule)))
    assert score(instance, 0, back) >= score(instance, 0, result.schedule)


@settings(max_examples=40)
@given(instance_batches(max_batch=1), seeds)
def test_prizes_keep_what_must_be_served_first(plain: Instances, seed: int) -> None:
    """In the integers of PyVRP and of OR-Tools: one such task more outweighs all values, and no sum overflows."""
    needed = th.from_numpy(np.random.default_rng(seed).random(tuple(plain.task_mask.shape)) < 0.3)
    instance = replace(plain, must_serve=needed)
    counting = CountingTasks.of(instance)
    reduced = ReducedInstance.of(counting.instances)
    if reduced.n_tasks == 0:
        return
    must = needed[0][counting.index[0, reduced.tasks]].numpy()
    for finest, largest in ((10**6, 2**60), (10**5, 2**61 // 1000)):
        prizes = reduced.integer_prizes(finest, largest).astype(object)
        assert prizes.sum() <= largest
        if must.any():
            lead = prizes[must].min() * int(must.sum()) - prizes[must].max() * (int(must.sum()) - 1)
            assert lead > prizes[~must].sum() + reduced.n_uavs * RESOLUTION


def test_prizes_of_values_up_to_a_billion() -> None:
    """Exact for OR-Tools; beside tasks that must be served, other values stay as fine as they are without them."""
    tasks = np.random.default_rng(0).random((40, 2)) * 0.1
    values = np.random.default_rng(1).integers(0, 10**9, 40).astype(float)
    exact = ReducedInstance.of(Instances.from_arrays([0.0, 0.0], tasks, values, 2.0, 4)).integer_prizes(10**6, 2**60)
    assert (exact == exact.max() / values.max() * values).all()
    needed = np.arange(40) < 5
    both = Instances.from_arrays([0.0, 0.0], tasks, np.random.default_rng(1).random(40), 2.0, 4, must_serve=needed)
    reduced = ReducedInstance.of(CountingTasks.of(both).instances)
    prizes = reduced.integer_prizes(10**5, 2**61 // 1000)
    unit = 4 * RESOLUTION + 1
    ordinary = both.values[0].numpy()[~needed]
    # In 100,000ths of the greatest value, not of what must be served.
    assert np.abs(prizes[~needed] / unit - ordinary / ordinary.max() * 1e5).max() <= 0.5


@needs_pyvrp
@settings(max_examples=20)
@given(whole_batches(max_tasks=8, max_batch=1), seeds)
def test_polish_is_never_worse(instance: Instances, seed: int) -> None:
    for start in (make_solver("kmeans-nearest").solve(instance, seed=seed)[0].schedule, Schedule([])):
        polished = polish_schedule(instance, start, 0.01, seed)
        assert score(instance, 0, polished) >= score(instance, 0, start)


# ------------------------------------------------------------------------------------------------------------------ clusters


@settings(max_examples=60)
@given(st.integers(1, 6), seeds, st.booleans())
def test_the_cheapest_assignment(n: int, seed: int, are_whole: bool) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.integers(0, 4, (n, n)).astype(float) if are_whole else rng.random((n, n))
    found = cheapest_assignment(costs)
    assert sorted(found) == list(range(n))
    cheapest = min(costs[range(n), order].sum() for order in itertools.permutations(range(n)))
    assert costs[range(n), found].sum() == pytest.approx(cheapest)


def test_clusters_go_to_the_uavs_that_are_near_or_fly_far() -> None:
    rng = np.random.default_rng(0)
    centers = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])
    tasks = (centers[:, None] + rng.random((3, 4, 2))).reshape(-1, 2)
    group = np.repeat(np.arange(3), 4)
    for order in itertools.permutations(range(3)):
        starts = centers[list(order)]
        instance = Instances.from_arrays([4.0, 4.0], tasks, None, 20.0, 3, start=starts, end=starts)
        assert (np.array(order)[clusters_of_uavs(instance, np.random.default_rng(1))] == group).all()
    # From one depot, the cluster that is far goes to the UAV that flies farther; a grounded one gets none.
    for near, far in ((0, 2), (2, 0)):
        distance = np.zeros(3)
        distance[[near, far]] = 4.0, 40.0
        instance = Instances.from_arrays([0.5, 0.5], tasks[:8], None, distance, 3)
        assert clusters_of_uavs(instance, np.random.default_rng(1)).tolist() == [near] * 4 + [far] * 4


def test_equal_uavs_get_clusters_as_before() -> None:
    batch = UniformGenerator(30, 4)(1, np.random.default_rng(0))
    expected = kmeans(batch.tasks[0].numpy(), 4, np.random.default_rng(5), 3)
    assert (clusters_of_uavs(batch, np.random.default_rng(5), 3) == expected).all()

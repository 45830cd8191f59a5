"""Tasks that cannot count, and UAVs that can be of no use, change no schedule and cost no memory, in any solver."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from classical_helpers import HAS_PYVRP, Ticks
from conftest import instance_batches, seeds
from hypothesis import given, settings
from solver_helpers import MANY, make_kmeans_am, make_pair, make_policy, objectives, routes

from sb3_uav import pretrained
from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.solvers import DLDRL, SOLVERS, Solver, make_solver
from sb3_uav.solvers.counting_tasks import CountingTasks

# Guided local search depends on the time it has, as PyVRP would without the clock of these tests.
SPECS = ["kmeans-nearest", "kmeans-vnd", "random-nearest", "greedy-insertion", "milp", "ortools"]
SPECS += [f"sb3:zip={pretrained.files()[0]}"]
SPECS += ["pyvrp:time_limit=0.05"] if HAS_PYVRP else []
NETWORKS = ("kmeans-am", "greedy", "sampling", "augment", "repair", "paper")


def make(spec: str, n_uavs: int) -> Solver:
    if spec == "kmeans-am":
        return make_kmeans_am()
    if spec == "repair":
        return make_pair(n_uavs, decode="sampling", samples=3, repair=True)
    if spec == "paper":
        return DLDRL(make_policy(AllocatorPolicy, n_uavs, preset="paper"), make_policy(RouterPolicy, preset="paper"))
    return make_pair(n_uavs, decode=spec, samples=MANY) if spec in NETWORKS else make_solver(spec)


def test_every_solver_is_tested() -> None:
    tested = {spec.partition(":")[0] for spec in SPECS}
    assert set(SOLVERS) - tested <= {"dl-drl", "dl-drl-i", "kmeans-am", "local-search", "ortools-gls", "pyvrp"}


def with_worthless(instances: Instances, rng: np.random.Generator) -> tuple[Instances, list[list[int]]]:
    """
    :return: The instances with tasks among theirs that are out of reach, far out of reach, or worth nothing, however near; and
        of each row the places of the tasks that were there before
    """
    batch_size, n_tasks = instances.task_mask.shape
    n_more = 7
    depot, reach = instances.depot.numpy(), instances.max_distance.numpy()
    tasks = np.concatenate([instances.tasks.numpy(), np.empty((batch_size, n_more, 2))], axis=1)
    values = np.concatenate([instances.values.numpy(), np.ones((batch_size, n_more))], axis=1)
    angle = rng.uniform(0, 2 * np.pi, (batch_size, n_more))
    distance = reach[:, None] * rng.choice([0.0, 0.1, 0.5, 0.51, 3.0, 1e6], (batch_size, n_more))
    tasks[:, n_tasks:] = depot[:, None] + distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    values[:, n_tasks:] = np.where(distance <= 0.505 * reach[:, None], 0.0, 9.0)
    order = np.stack([rng.permutation(n_tasks + n_more) for _ in range(batch_size)])
    # What was there before keeps its order.
    before = order < n_tasks
    for row, old in zip(order, before, strict=True):
        row[old] = np.arange(n_tasks)
    tasks = np.take_along_axis(tasks, order[..., None], 1)
    values = np.take_along_axis(values, order, 1)
    mixed = Instances.from_arrays(depot, tasks, values, reach, instances.n_uavs)
    return mixed, [np.flatnonzero(old).tolist() for old in before]


@pytest.mark.usefixtures("ticks")
@pytest.mark.parametrize("spec", [*SPECS, *NETWORKS])
def test_tasks_that_cannot_count_change_nothing(spec: str, ticks: Ticks) -> None:
    """The same tasks are visited in the same order by the same UAVs."""
    rng = np.random.default_rng(0)
    n_tasks = 6 if spec == "milp" else 15
    for n_uavs, valued in ((2, False), (3, True)):
        batch = UniformGenerator(n_tasks, n_uavs, 3.0)(3, rng)
        values = rng.random((3, n_tasks)) + 0.5 if valued else None
        batch = Instances.from_arrays(0.4 + 0.2 * batch.depot, batch.tasks, values, 2.0, n_uavs)
        assert bool(batch.reachable().all())
        mixed, places = with_worthless(batch, rng)
        solver = make(spec, n_uavs)
        ticks.looks = 0
        expected = [
            tuple(tuple(places[row][task] for task in route) for route in found)
            for row, found in enumerate(routes(solver, batch, 5))
        ]
        ticks.looks = 0
        assert routes(solver, mixed, 5) == expected


def test_rows_that_lose_tasks_beside_rows_that_do_not() -> None:
    batch = Instances.concatenate([UniformGenerator(n, 2)(2, np.random.default_rng(n)) for n in (4, 9)])
    worth = replace(batch, values=batch.values * th.tensor([1.0, 0.0, 1.0, 1.0]).double()[:, None])
    for solver in (make_pair(2), make_kmeans_am(), make_solver("kmeans-nearest")):
        together = routes(solver, worth)
        assert together[1] == ((), ()) and together[3] == routes(solver, batch)[3]
        for row in (0, 2, 3):
            alone = [result.schedule.routes for _, result in solver.solve_rows(worth, [row])]
            assert alone == [together[row]]


@settings(max_examples=60)
@given(instance_batches(), seeds)
def test_mapping_back(batch: Instances, seed: int) -> None:
    """Tasks keep their order, coordinates and values; nothing that counts is lost; what is left over is padding."""
    counting = CountingTasks.of(batch)
    for row in range(len(batch)):
        counts = [task for task in range(batch.n_tasks) if batch.reachable()[row, task] and batch.values[row, task] > 0]
        n_tasks = int(counting.instances.task_mask[row].sum())
        assert counting.index[row, :n_tasks].tolist() == counts
        assert th.equal(counting.instances.tasks[row, :n_tasks], batch.tasks[row, counts])
        assert th.equal(counting.instances.values[row, :n_tasks], batch.values[row, counts])
        schedule = counting.schedule(row, Schedule([range(n_tasks)]))
        assert [task for route in schedule.routes for task in route] == counts
        assert len(schedule.routes) == batch.n_uavs
    counting.instances.validate()


def test_nothing_changes_where_all_tasks_count() -> None:
    batch = UniformGenerator(5, 3, 9.0)(4, np.random.default_rng(0)).pad(7)
    assert CountingTasks.of(batch).instances is batch


@pytest.mark.parametrize("n_uavs", [10**6, 10**9])
@pytest.mark.parametrize("spec", [*SPECS, *NETWORKS[:-1]])
def test_absurd_fleets_cost_no_memory(spec: str, n_uavs: int, ticks: Ticks) -> None:
    """At most one UAV per task can be of use, so that all solvers see all the tasks visited, each by a UAV of its own."""
    batch = UniformGenerator(5, n_uavs, 3.0)(2, np.random.default_rng(0))
    solver = make(spec, 3)
    tracemalloc.start()
    results = solver.solve(batch)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    for row, result in enumerate(results):
        assert len(result.schedule.routes) == 1000
        assert check_schedule(batch, row, result.schedule).objective >= (3 if spec == "random-nearest" else 5)


def test_a_fleet_that_is_larger_than_the_number_of_tasks_depends_on_no_other_row() -> None:
    """Rows with fewer tasks get smaller fleets, whatever stands beside them."""
    batch = Instances.concatenate([UniformGenerator(n, 6, 9.0)(2, np.random.default_rng(n)) for n in (2, 9, 4)])
    for solver in (make_pair(6), make_pair(6, decode="sampling", samples=4, batch_size=1), make_kmeans_am()):
        together = routes(solver, batch)
        assert all(len(found) == 6 for found in together)
        assert [routes(solver, batch[row : row + 1])[0] for row in range(2)] == together[:2]
        found = dict(solver.solve_rows(batch, [5, 2, 0]))
        assert {row: result.schedule.routes for row, result in found.items()} == {row: together[row] for row in (5, 2, 0)}


def test_an_allocator_that_is_bound_to_a_fleet_keeps_it() -> None:
    """The paper's networks judge all UAVs at once, even if there are more than tasks."""
    batch = UniformGenerator(3, 5, 9.0)(2, np.random.default_rng(0))
    assert (objectives(make("paper", 5), batch) > 0).all()
    with pytest.raises(ValueError, match="trained for 4 UAVs, the instances have 5"):
        make("paper", 4).solve(batch)
    with pytest.raises(ValueError, match="trained for 4 UAVs, the instances have 1000000000"):
        make("paper", 4).solve(replace(batch, n_uavs=10**9))

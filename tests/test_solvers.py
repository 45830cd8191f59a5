"""Solvers: what they return is feasible, follows from the seed, and is as good as it must be."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from conftest import instance_batches
from hypothesis import given, settings
from solver_helpers import MANY, make_kmeans_am, make_pair, objectives, routes

from sb3_uav.envs import ClusteredGenerator, InstanceGenerator, Instances, UniformGenerator
from sb3_uav.solvers import Solver, make_solver
from sb3_uav.solvers.kmeans import kmeans
from sb3_uav.solvers.network_solver import parameters_hash

HEURISTICS = ("kmeans-nearest", "random-nearest")


@pytest.fixture(scope="module")
def instances() -> Instances:
    """All tasks are in reach, so that solvers see the instances as they are."""
    batch = UniformGenerator(20, n_uavs=3)(12, np.random.default_rng(0))
    return batch[batch.reachable().all(1)][:9]


# ------------------------------------------------------------------------------------------------------------- all solvers


@settings(max_examples=40)
@given(instance_batches())
def test_schedules_of_any_instance_are_feasible(batch: Instances) -> None:
    """Of any instance that is allowed; and as every task has a UAV, some task is visited if any counts."""
    counts = (batch.reachable() & (batch.values > 0)).any(1).tolist()
    pair = make_pair(batch.n_uavs, decode="sampling", samples=3)
    augmented = make_pair(batch.n_uavs, decode="augment", samples=MANY)
    pairs = (pair, augmented, make_pair(batch.n_uavs), make_kmeans_am())
    for solver in (*map(make_solver, HEURISTICS), *pairs):
        objectives(solver, batch)
        visited = [result.schedule.n_visited > 0 for result in solver.solve(batch)]
        assert visited == counts, solver.name


@pytest.mark.parametrize("spec", [*HEURISTICS, "kmeans-am", "sampling", "augment"])
def test_the_seed_decides(spec: str, instances: Instances) -> None:
    """Same seed, same schedules; the row of an instance, not the batch it comes in, decides what happens to it."""
    networks: dict[str, Solver] = {"kmeans-am": make_kmeans_am(), "sampling": make_pair(decode="sampling", samples=3)}
    networks["augment"] = make_pair(decode="augment", samples=MANY)
    solver = networks[spec] if spec in networks else make_solver(spec)
    for rows in ([5, 2], [0], []):
        expected = [(row, routes(solver, instances, 3)[row]) for row in rows]
        found = [(row, result.schedule.routes) for row, result in solver.solve_rows(instances, rows, seed=3)]
        assert found == expected
    assert routes(solver, instances, 3) == routes(solver, instances, 3)
    assert routes(solver, instances[:4], 3) == routes(solver, instances, 3)[:4]
    assert routes(make_solver("random-nearest"), instances, 3) != routes(make_solver("random-nearest"), instances, 4)


def test_padding_changes_nothing(instances: Instances) -> None:
    for solver in (*map(make_solver, HEURISTICS), make_pair(), make_kmeans_am()):
        assert routes(solver, instances.pad(31)) == routes(solver, instances), solver.name


# -------------------------------------------------------------------------------------------------------------- heuristics


def test_kmeans_finds_separate_clusters() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(4, size=60)
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])[truth] + rng.normal(0, 0.02, (60, 2))
    labels = kmeans(points * 1e-150, 4, rng)
    assert len({(a, b) for a, b in zip(truth.tolist(), labels.tolist(), strict=True)}) == 4
    assert len(set(labels.tolist())) == 4


@pytest.mark.parametrize("n_points, n_clusters", [(1, 1), (1, 4), (3, 5), (6, 2)])
def test_kmeans_of_coincident_points(n_points: int, n_clusters: int) -> None:
    labels = kmeans(np.full((n_points, 2), 0.3), n_clusters, np.random.default_rng(0))
    assert set(labels.tolist()) == {0}


def test_kmeans_gives_every_point_its_own_cluster_if_it_can() -> None:
    points = np.random.default_rng(1).random((5, 2))
    assert sorted(kmeans(points, 5, np.random.default_rng(0)).tolist()) == [0, 1, 2, 3, 4]


def test_kmeans_centers_are_nearest() -> None:
    """At the end no point is nearer to another cluster's center, and more restarts never give a larger inertia."""
    points = np.random.default_rng(2).random((80, 2))

    def inertia(labels: np.ndarray) -> float:
        return sum(np.square(points[labels == k] - points[labels == k].mean(0)).sum() for k in set(labels.tolist()))

    few, many = kmeans(points, 6, np.random.default_rng(0), 1), kmeans(points, 6, np.random.default_rng(0), 30)
    assert inertia(many) <= inertia(few)
    centers = np.stack([points[many == k].mean(0) for k in range(6)])
    np.testing.assert_array_equal(np.square(points[:, None] - centers).sum(-1).argmin(1), many)


@pytest.mark.parametrize("generator", [UniformGenerator(80), ClusteredGenerator(80)])
def test_kmeans_beats_a_random_split(generator: InstanceGenerator) -> None:
    batch = generator(30, np.random.default_rng(5))
    gain = objectives(make_solver("kmeans-nearest"), batch) - objectives(make_solver("random-nearest"), batch)
    assert gain.mean() > 10 and (gain > 0).mean() > 0.9


# -------------------------------------------------------------------------------------------------------------- K-means+AM


def test_kmeans_am_routes_the_clusters_of_kmeans(instances: Instances) -> None:
    """Every tour is the router's own plan for one cluster, and the clusters are those of kmeans-nearest."""
    solver = make_kmeans_am(batch_size=4)
    for row, schedule in enumerate(routes(solver, instances, 7)):
        clusters = kmeans(instances.tasks[row].numpy(), 3, np.random.default_rng([7, row]))
        for uav, route in enumerate(schedule):
            mine = np.nonzero(clusters == uav)[0].tolist()
            subset = Instances.from_arrays(instances.depot[row], instances.tasks[row, mine])
            assert list(route) == [mine[node - 1] for node in solver.router.plan(subset)[0].tolist() if node > 0]
    assert [result.batch_size for result in solver.solve(instances)] == [4] * 8 + [1]


def test_any_fleet_suits_kmeans_am() -> None:
    batch = Instances.concatenate([UniformGenerator(n, n_uavs=7)(2, np.random.default_rng(n)) for n in (1, 5, 12)])
    assert (objectives(make_kmeans_am(), batch) > 0).any()


def test_wrong_arguments_of_kmeans_am() -> None:
    with pytest.raises(ValueError, match="restarts of kmeans-am is 0; K-means needs at least 1 start"):
        make_kmeans_am(restarts=0)
    with pytest.raises(ValueError, match="batch_size is 0; give at least 1"):
        make_kmeans_am(batch_size=0)


# ---------------------------------------------------------------------------------------------------------------- settings


def test_settings_tell_solvers_apart() -> None:
    """What may change the schedules is in the settings; the batch size, the name and the device are not."""
    pair = make_pair()
    assert pair.settings() == make_pair(batch_size=3, name="other").settings() == make_pair(samples=3).settings()
    sampling = [make_pair(decode="sampling", samples=samples) for samples in (3, 128)]
    kmeans_am = make_kmeans_am()
    different: list[Solver] = [pair, make_pair(4), *sampling, pair.untrained(), kmeans_am, make_kmeans_am(restarts=3)]
    every = [solver.settings() for solver in different]
    assert all(first != second for i, first in enumerate(every) for second in every[:i])
    assert kmeans_am.settings()["router"] == parameters_hash(pair.router) == pair.settings()["router"]
    with th.no_grad():
        next(pair.router.parameters()).view(-1)[0] += 1e-6
    assert parameters_hash(pair.router) != kmeans_am.settings()["router"]
    assert make_solver("kmeans-nearest:restarts=3").settings() == {"spec": "kmeans-nearest:restarts=3"}

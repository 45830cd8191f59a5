"""Distances and related features of the networks, against plain Python."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.fleet_geometry import _FULL, _N_NEIGHBORS, FleetFeature, FleetGeometry
from sb3_uav.policies.geometry import FARTHEST, NEAR, NodeFeature, node_features, scaled_coordinates
from sb3_uav.policies.move_geometry import N_NEXT, MoveFeature, MoveGeometry
from sb3_uav.policies.static_observation import StaticObservation


def static_of(instances: Instances) -> StaticObservation:
    return StaticObservation.from_instances(instances)


@settings(max_examples=50)
@given(instances=instance_batches())
def test_features_are_finite_for_instances_of_any_magnitude(instances: Instances) -> None:
    static = static_of(instances)
    coordinates = scaled_coordinates(static)
    assert coordinates.abs().max() <= FARTHEST and (coordinates[:, 0] == 0).all()
    assert node_features(coordinates, static.task_mask).isfinite().all()
    geometry = FleetGeometry.of(static)
    task = th.zeros(len(instances), 1, dtype=th.int64)
    nobody = th.full((len(instances), 1, instances.n_tasks), -1)
    features = geometry.features(geometry.initial(1, 3), task, geometry.owners(task, nobody))
    assert features.isfinite().all()


@pytest.mark.parametrize("offset", [7.0, 1e7])
def test_scaled_instances_have_the_same_features(offset: float) -> None:
    """Moved, far from the origin too, and in another unit: differences of coordinates are taken in float64."""
    instances = UniformGenerator(9, 2)(4, np.random.default_rng(0))
    points = offset + 3 * instances.depot.numpy(), offset + 3 * instances.tasks.numpy()
    moved = Instances.from_arrays(*points, max_distance=6.0, n_uavs=2)
    for geometry in (FleetGeometry, MoveGeometry):
        for one, two in zip(geometry.of(static_of(instances)), geometry.of(static_of(moved)), strict=True):
            th.testing.assert_close(one, two, atol=1e-5, rtol=0)


def test_features_of_a_move() -> None:
    """D = 4; the UAV has flown 1.5 to (0, 1.5) and may go to (2, 1.5), home 2.5 from there, but no longer to (0, -1)."""
    instances = Instances.from_arrays(
        np.zeros(2), np.array([[0.0, 1.5], [2.0, 1.5], [0.0, -1.0], [0.5, 1.5]]), max_distance=4.0
    )
    mask = th.tensor([[[False, False, True, False, True]]])
    geometry = MoveGeometry.of(static_of(instances))
    features = geometry.features(th.tensor([[1]]), th.tensor([[2.5 / 4]]), mask)[0, 0]
    slack, detour, left = 2.5 - 2.0 - 2.5, 2.0 + 2.5 - 1.5, 2.5 / 4
    ratio, onward = math.log((0.5 + NEAR) / (0.125 + NEAR)), math.log((FARTHEST + NEAR) / (0.5 + NEAR))
    # After it nothing more can be visited; both feasible tasks lie on the same side; cos 0.6 = 2.25 / (1.5 * 2.5).
    expected = [8 * 0.5, ratio, 2.5, slack, detour, left, 1.5, 2.0, onward, 2.0, 0, 0, math.log(3) / 3, 1.0, 0.6]
    assert features[2].tolist() == pytest.approx(expected, abs=1e-5)
    assert features[4, MoveFeature.RELATIVE_DISTANCE] == 0


@settings(max_examples=50)
@given(instances=instance_batches(max_tasks=6), left=st.floats(0.05, 1.0))
def test_what_a_move_leads_on_to(instances: Instances, left: float) -> None:
    """From the depot, with part of the maximum flight distance, against plain Python."""
    static = static_of(instances)
    geometry = MoveGeometry.of(static)
    home = geometry.home
    mask = (2 * home <= left) & th.cat([th.zeros(len(home), 1, dtype=th.bool), static.task_mask], dim=1)
    start = th.zeros(len(instances), 1, dtype=th.int64)
    features = geometry.features(start, th.full((len(instances), 1), left), mask[:, None])[:, 0]
    for row, points in enumerate(geometry.coordinates.tolist()):
        for j in range(1, len(points)):
            if not mask[row, j]:
                continue
            near = sorted(
                (math.dist(points[j], points[k]), k) for k in range(1, len(points)) if k != j and static.task_mask[row, k - 1]
            )
            rest = [left - home[row, j].item() - distance - home[row, k].item() for distance, k in near]
            is_open = [slack >= 0 and bool(mask[row, k]) for slack, (_, k) in zip(rest, near, strict=True)]
            if any(abs(slack) < 1e-6 for slack in rest) or len({round(distance, 6) for distance, _ in near}) < len(near):
                # Rounding decides, or which of two is the nearer one.
                continue
            onwards = [distance for (distance, _), free in zip(near, is_open, strict=True) if free] + 3 * [FARTHEST]
            cluster = sum(min(distance, 0.25) for distance in onwards[:3]) / 3
            assert features[row, j, MoveFeature.ONWARD].item() == pytest.approx(8 * min(onwards[0], 0.25), abs=1e-4)
            assert features[row, j, MoveFeature.CLUSTER].item() == pytest.approx(8 * cluster, abs=1e-4)
            assert features[row, j, MoveFeature.OPEN_FEW].item() == pytest.approx(sum(is_open[:4]) / 4)
            assert features[row, j, MoveFeature.OPEN_MANY].item() == pytest.approx(sum(is_open) / N_NEXT)


def test_features_of_a_fleet() -> None:
    """Two UAVs, D = 4 and four tasks; the first UAV has tasks 0 and 1, the second none, and task 2 is next."""
    points = np.array([[1.0, 0.0], [1.0, 0.8], [0.6, 0.8], [-1.0, 0.0]])
    instances = Instances.from_arrays(np.zeros(2), points, max_distance=4.0, n_uavs=2)
    geometry = FleetGeometry.of(static_of(instances))
    fleet = geometry.initial(1, 2)
    first = th.tensor([[[True, False]]])
    for own in (0, 1):
        fleet = geometry.add(fleet, own, first)
    task = th.tensor([[2]])
    features = geometry.features(fleet, task, geometry.owners(task, th.tensor([[[0, 0, -1, -1]]])))[0, 0]
    f = FleetFeature
    found = [features[0, feature].item() for feature in (f.LOAD, f.OVERLOAD, f.EMPTY, f.VOTES)]
    assert found == pytest.approx([1.5, 1.5 - _FULL, 0.0, 1.0])
    named = (f.NEAREST, f.CENTROID, f.LAST, f.PERIMETER, f.GROWTH)
    nearest, to_centroid, to_last, perimeter, grown = (features[0, feature].item() for feature in named)
    assert nearest == pytest.approx(0.4) and to_last == pytest.approx(0.4)
    assert to_centroid == pytest.approx(math.hypot(0.4, 0.4))
    assert perimeter == pytest.approx(1.8) and grown == pytest.approx(0.0, abs=1e-6)
    assert features[1, f.LOAD].item() == 0.5 and features[1, f.EMPTY].item() == 1.0 and features[1, f.VOTES].item() == 0.0
    assert features[1, f.GROWTH].item() == pytest.approx(1.4)


def test_the_order_of_features_is_that_of_existing_weights() -> None:
    """A new order would shuffle the inputs of every trained network."""
    assert " ".join(feature.name for feature in NodeFeature) == (
        "X Y HOME HOME_SQUARED DIRECTION_X DIRECTION_Y NEAREST DENSITY"
    )
    assert " ".join(feature.name for feature in MoveFeature) == (
        "DISTANCE RELATIVE_DISTANCE HOME SLACK DETOUR REMAINING HOME_HERE ONWARD RELATIVE_ONWARD CLUSTER OPEN_FEW OPEN_MANY "
        "N_FEASIBLE ON_SIDE ANGLE"
    )
    assert " ".join(feature.name for feature in FleetFeature) == (
        "LOAD OVERLOAD EMPTY VOTES RELATIVE_DISTANCE NEAREST CENTROID LAST PERIMETER GROWTH TOWARDS HOME PROGRESS "
        "TASKS_PER_UAV FLEET_SIZE N_EMPTY"
    )
    for kind in (NodeFeature, MoveFeature, FleetFeature):
        assert [int(feature) for feature in kind] == list(range(len(kind)))


def test_initial_weights_belong_to_their_features() -> None:
    """Overload, votes and distance for the allocator, the distance of the move for the router's compatibilities."""
    settings: dict[str, Any] = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
    allocator = AllocatorPolicy(*AllocatorPolicy.placeholder_spaces(None), lambda _: 0.0, **settings)
    router = RouterPolicy(*RouterPolicy.placeholder_spaces(None), lambda _: 0.0, **settings)
    direct: Any = allocator.features_extractor.scorer.direct
    weights = dict(zip(FleetFeature, direct.weight[0].tolist(), strict=True))
    assert {feature: weight for feature, weight in weights.items() if weight != 0} == {
        FleetFeature.OVERLOAD: -60.0,
        FleetFeature.VOTES: 4.0,
        FleetFeature.RELATIVE_DISTANCE: -0.5,
    }
    bias: Any = router.features_extractor.move_bias
    assert bias.linear.weight.nonzero().tolist() == [[2, MoveFeature.RELATIVE_DISTANCE]]
    assert bias.linear.weight[-1, MoveFeature.RELATIVE_DISTANCE] == -4.0


@settings(max_examples=50)
@given(instances=instance_batches())
def test_neighbors_come_before_the_task_and_are_nearest(instances: Instances) -> None:
    geometry = FleetGeometry.of(static_of(instances))
    for row in range(len(instances)):
        points = geometry.tasks[row].tolist()
        for task in range(int(instances.task_mask[row].sum())):
            known = geometry.neighbor_distance[row, task] < FARTHEST
            assert (geometry.neighbors[row, task][known] < task).all()
            all_before = sorted(min(math.dist(points[task], points[other]), FARTHEST) for other in range(task))
            expected = [distance for distance in all_before[:_N_NEIGHBORS] if distance < FARTHEST - 1e-6]
            found = [distance for distance in geometry.neighbor_distance[row, task].tolist() if distance < FARTHEST - 1e-6]
            assert found == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("n_tasks", [1, 2, 3, 5, 20])
def test_padding_changes_nothing(n_tasks: int) -> None:
    instances = UniformGenerator(n_tasks, 2)(4, np.random.default_rng(n_tasks))
    few, many = static_of(instances), static_of(instances.pad(n_tasks + 9))
    features = [node_features(scaled_coordinates(static), static.task_mask)[:, :n_tasks] for static in (few, many)]
    th.testing.assert_close(*features)
    moves = []
    for static in (few, many):
        geometry = MoveGeometry.of(static)
        mask = th.cat([th.zeros(4, 1, dtype=th.bool), static.task_mask], dim=1) & (2 * geometry.home <= 1.0)
        position, left = th.zeros(4, 1, dtype=th.int64), th.ones(4, 1)
        moves.append(geometry.features(position, left, mask[:, None])[:, :, : n_tasks + 1])
    th.testing.assert_close(*moves)

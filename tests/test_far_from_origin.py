"""Fields far from the origin, as in map projections: the same plans as at the origin."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from env_helpers import both_levels, make
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances, UniformGenerator, check_schedule
from sb3_uav.envs.instances import _FAR_FROM_ORIGIN
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.solvers import make_solver

OFFSETS = [(1e6, 1e6), (1e7, 1e7), (-2e7, 5e6), (0.0, 1e9)]


def field(offset: tuple[float, float], n_tasks: int = 60, batch_size: int = 6) -> Instances:
    """Fields of 20 by 20 m, with batteries for 40 m."""
    rng = np.random.default_rng(1)
    depot, tasks = 20 * rng.random((batch_size, 2)), 20 * rng.random((batch_size, n_tasks, 2))
    return Instances.from_arrays(depot + np.array(offset), tasks + np.array(offset), max_distance=40.0)


@pytest.mark.parametrize("offset", OFFSETS)
def test_networks_plan_as_well_far_from_the_origin(offset: tuple[float, float]) -> None:
    """Subtracting the depot in float32 instead of float64 lost 2 to 40 % there."""
    solver = make_solver("dl-drl")
    objectives = []
    for instances in (field((0.0, 0.0)), field(offset)):
        schedules = [solution.schedule for solution in solver.solve(instances)]
        objectives.append([check_schedule(instances, row, schedule).objective for row, schedule in enumerate(schedules)])
    assert objectives[0] == objectives[1]


@both_levels
@settings(max_examples=30)
@given(
    offset=st.sampled_from([0.0, 1.0, -1000.0, 1e5, 1e7, -1e9]),
    scale=st.sampled_from([1e-3, 1.0, 20.0, 1e4]),
    seed=st.integers(0, 1000),
)
def test_both_drivers_see_the_same_numbers(level: str, offset: float, scale: float, seed: int) -> None:
    """The step loop's observation equals the fused driver's input."""
    rng = np.random.default_rng(seed)
    points = offset + scale * rng.random((7, 2))
    instance = Instances.from_arrays(points[0], points[1:], max_distance=2 * scale)
    observation, _ = make(level, n_tasks=6).reset(options={"instance": instance})
    fused = StaticObservation.from_instances(instance)
    assert np.array_equal(observation["depot"], fused.depot[0].numpy())
    assert np.array_equal(observation["tasks"], fused.tasks[0].flatten().numpy())
    # Positions relative to the depot, to within the float64 resolution at that offset.
    seen = observation["tasks"].reshape(-1, 2).astype(float) - observation["depot"]
    assert np.allclose(seen, points[1:] - points[0], atol=1e-5 * 2 * scale, rtol=0)


def test_instances_near_the_origin_are_seen_as_they_are() -> None:
    """Bit by bit, so that networks trained on absolute coordinates see what they were trained on."""
    instances = UniformGenerator(9, 2)(5, np.random.default_rng(0))
    observation = make("allocation", n_tasks=9, n_uavs=2).problem.observe_static(instances)
    assert th.equal(observation["depot"], instances.depot.float())
    assert th.equal(observation["tasks"], instances.tasks.float().flatten(1))
    limit = 2 * _FAR_FROM_ORIGIN
    border = Instances.from_arrays([[limit, -limit], [-limit - 1e-9, 0.0]], [[[limit, 3.0]], [[1.0, 3.0]]], max_distance=2.0)
    assert border.near_origin().depot.tolist() == [[limit, -limit], [0.0, 0.0]]
    assert border.near_origin().tasks.tolist() == [[[limit, 3.0]], [[1.0 + limit + 1e-9, 3.0]]]


def test_padding_is_no_task_far_from_the_origin() -> None:
    """Padded slots remain at the depot."""
    shown = field((1e7, 1e7), n_tasks=3).pad(5).near_origin()
    assert (shown.depot == 0).all() and (shown.tasks[:, 3:] == 0).all() and not shown.task_mask[:, 3:].any()


def test_the_depot_means_nothing_where_uavs_have_places_of_their_own() -> None:
    """Networks see as much of the field wherever that lies."""
    rng = np.random.default_rng(0)
    tasks, start, end = rng.random((9, 2)), rng.random((2, 2)), rng.random((2, 2))
    shown = []
    for offset in (0.0, 2.0**23):
        moved = Instances.from_arrays([0, 0], tasks + offset, None, 1.0, 2, start=start + offset, end=end + offset)
        static = StaticObservation.from_instances(moved)
        shown.append(static.tasks - static.home[:, None])
    assert th.allclose(shown[0], shown[1], atol=1e-6)

"""Fleets of a million UAVs and more: at most one UAV per task is useful, and the others take no memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, random_assignment, seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from instance_helpers import arrays, assert_equal

from sb3_uav.envs import Instances, RoutePlanningEnv, Schedule, TaskAllocationEnv, UniformGenerator, check_schedule
from sb3_uav.envs.allocation import AllocationProblem, _useful_allocation, plan_tours, split_tasks
from sb3_uav.envs.routing import nearest_feasible

absurd = pytest.mark.parametrize("n_uavs", [10**6, 10**9])


@contextmanager
def little_memory(limit: int = 2**20) -> Iterator[None]:
    """Python and numpy allocate less than ``limit`` bytes at any moment."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


def save(instances: Instances, path: Path) -> Path:
    instances.save(path)
    return path


@absurd
def test_instances_files_and_checker_take_an_absurd_fleet(n_uavs: int, tmp_path: Path) -> None:
    # So that modules imported on first use do not count.
    Instances.load(save(Instances.from_arrays(**arrays()), tmp_path / "few.npz"))
    with little_memory():
        instances = Instances.from_arrays(**arrays(n_uavs=n_uavs))
        loaded = Instances.load(save(instances, tmp_path / "many.npz"))
        assert_equal(loaded, instances)
        assert loaded.n_uavs == n_uavs and loaded.useful_fleet == 3
        assert len(Instances.concatenate([loaded, loaded[0]])) == 3
        # UAVs without a route stay in the depot.
        assert check_schedule(loaded, 0, Schedule([[], []])).lengths == (0.0, 0.0)


@absurd
def test_dynamics_take_an_absurd_fleet(n_uavs: int) -> None:
    """Masks are views of a single number, and tours are planned only for UAVs with tasks."""
    problem = AllocationProblem(UniformGenerator(5, n_uavs))
    instances = problem.generator(3, np.random.default_rng(0))
    dynamics = problem.dynamics(instances)
    state = dynamics.reset(4)
    assert state.action_mask.shape == (3, 4, n_uavs) and state.action_mask.untyped_storage().nbytes() == 1
    actions = th.from_numpy(np.random.default_rng(1).integers(0, n_uavs, (3, 4, 5)))
    for step in range(5):
        state, rewards = dynamics.step(state, actions[..., step])
    assert th.equal(problem.returns(instances, actions), rewards)
    # With a UAV each, all reachable tasks are visited.
    assert th.equal(rewards, instances.reachable().sum(1, keepdim=True).double().expand(3, 4))
    routing = RoutePlanningEnv(instances=instances)
    with little_memory():
        routing.reset(seed=0)
        assert routing.action_space.n == 6  # type: ignore[attr-defined]


def test_an_environment_and_its_picture_with_a_million_uavs() -> None:
    env = TaskAllocationEnv(4, 10**6, max_distance=9.0, render_mode="rgb_array")
    env.reset(seed=0)
    for action in (999_999, 5, 999_999, 0):
        assert len(env.episodes.routes(0)) <= 4
        env.render()
        _, reward, terminated, _, _ = env.step(action)
    assert terminated and reward == 4.0
    # The UAVs in use, in their order.
    assert [sorted(route) for route in env.episodes.routes(0)] == [[3], [1], [0, 2], []]
    assert check_schedule(env.instance, 0, Schedule(env.episodes.routes(0))).objective == 4.0


@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 3), partial=st.booleans())
def test_leaving_out_useless_uavs_changes_no_tour(instances: Instances, seed: int, n_samples: int, partial: bool) -> None:
    assignment = random_assignment(instances, n_samples, np.random.default_rng(seed), partial)
    fewer, numbered = _useful_allocation(instances, assignment)
    assert fewer.n_uavs == instances.useful_fleet == min(instances.n_uavs, instances.n_tasks)
    assert th.equal(
        plan_tours(fewer, numbered, nearest_feasible).value, plan_tours(instances, assignment, nearest_feasible).value
    )

    def subsets(instances: Instances, assignment: th.Tensor) -> list[list[int]]:
        split = split_tasks(instances, assignment)
        rows = zip(split.task_index.tolist(), split.instances.task_mask.tolist(), strict=True)
        found = [[task for task, real in zip(*row, strict=True) if real] for row in rows]
        return [tasks for tasks in found if tasks]

    assert subsets(fewer, numbered) == subsets(instances, assignment)


@pytest.mark.parametrize("n_uavs", [2**31, 2**60, 1e300])
def test_fleets_beyond_all_integers_are_refused(n_uavs: float) -> None:
    with pytest.raises(ValueError, match=r"field 'n_uavs' is .*, at least 1, and 2147483647 at most"):
        Instances.from_arrays(**arrays(n_uavs=n_uavs))
    with pytest.raises(ValueError, match=r"n_uavs is .* and 2147483647 at most"):
        UniformGenerator(5, int(n_uavs))

"""The transitions of task allocation, as properties of random instances of every kind, checked against plain Python."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, play_randomly, random_assignment, random_legal, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import (
    Instances,
    Router,
    Schedule,
    UniformGenerator,
    check_schedule,
    nearest_feasible,
    plan_tours,
    schedules,
    split_tasks,
)
from sb3_uav.envs.allocation import UNASSIGNED, AllocationDynamics
from sb3_uav.envs.routing import DEPOT, RoutingDynamics


def random_router(generator: np.random.Generator) -> Router:
    """Flies to random feasible tasks."""
    return lambda instances: play_randomly(RoutingDynamics(instances), 1, generator)[0][:, 0]


@settings(max_examples=80)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 3), partial=st.booleans())
def test_split_gives_every_task_to_one_uav(instances: Instances, seed: int, n_samples: int, partial: bool) -> None:
    """Each UAV's tasks, in their order, at the front of its row, with the data of the original; then padding."""
    assignment = random_assignment(instances, n_samples, np.random.default_rng(seed), partial)
    subsets = split_tasks(instances, assignment)
    subsets.instances.validate()
    assert len(subsets.instances) == len(subsets.task_index) == len(instances) * n_samples * instances.n_uavs
    assert subsets.instances.n_uavs == 1
    sizes = []
    for i, (row, sample, uav) in enumerate(
        itertools.product(range(len(instances)), range(n_samples), range(instances.n_uavs))
    ):
        real = int(instances.task_mask[row].sum())
        expected = [task for task in range(real) if assignment[row, sample, task] == uav]
        sizes.append(len(expected))
        assert subsets.task_index[i][subsets.instances.task_mask[i]].tolist() == expected
        assert subsets.instances.task_mask[i].sum() == len(expected)
        assert th.equal(subsets.instances.tasks[i, : len(expected)], instances.tasks[row, expected])
        assert th.equal(subsets.instances.values[i, : len(expected)], instances.values[row, expected])
        assert th.equal(subsets.instances.depot[i], instances.depot[row])
        assert subsets.instances.max_distance[i] == instances.max_distance[row]
    assert subsets.instances.n_tasks == max(*sizes, 1)


@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 3), greedy=st.booleans())
def test_planned_tours_pass_the_checker(instances: Instances, seed: int, n_samples: int, greedy: bool) -> None:
    """Their value is the checker's objective, and every UAV visits only its own tasks."""
    rng = np.random.default_rng(seed)
    assignment = random_assignment(instances, n_samples, rng)
    planned = plan_tours(instances, assignment, nearest_feasible if greedy else random_router(rng))
    assert planned.tours.shape[:3] == (len(instances), n_samples, instances.n_uavs)
    assert planned.value.shape == (len(instances), n_samples) and planned.value.dtype == th.float64
    for sample in range(n_samples):
        for row, schedule in enumerate(schedules(planned.tours[:, sample])):
            report = check_schedule(instances, row, schedule)
            assert report.objective == pytest.approx(planned.value[row, sample].item(), rel=1e-12, abs=0)
            for uav, route in enumerate(schedule.routes):
                assert {assignment[row, sample, task].item() for task in route} <= {uav}


@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds)
def test_allocation_rewards_only_the_end(instances: Instances, seed: int) -> None:
    """One task per step in input order; the value of the router's tours when the last real task is assigned."""
    rng = np.random.default_rng(seed)
    dynamics = AllocationDynamics(instances, nearest_feasible)
    state = dynamics.reset(2)
    n_real = instances.task_mask.sum(1)[:, None].expand(-1, 2)
    assignment = th.full((len(instances), 2, instances.n_tasks), UNASSIGNED)
    for step in range(instances.n_tasks):
        assert th.equal(state.assignment, assignment)
        assert th.equal(state.task, n_real.clamp(max=step)) and th.equal(state.done, n_real <= step)
        assert state.action_mask.all()
        actions = random_legal(state.action_mask, rng)
        assignment[..., step] = actions.where(step < n_real, UNASSIGNED)
        state, rewards = dynamics.step(state, actions)
        value = plan_tours(instances, assignment, nearest_feasible).value
        assert th.equal(rewards, value.where(n_real == step + 1, 0.0))
    assert state.done.all()


@pytest.mark.parametrize("n_uavs", [1, 2, 3, 5, 20])
def test_more_uavs_than_tasks(n_uavs: int) -> None:
    """Idle UAVs stay at the depot; with one UAV per task, all reachable tasks are visited."""
    instances = UniformGenerator(n_tasks=3, n_uavs=n_uavs, max_distance=9.0)(4, np.random.default_rng(0))
    assignment = (th.arange(3) % n_uavs).expand(4, 1, 3)
    planned = plan_tours(instances, assignment, nearest_feasible)
    assert planned.value.tolist() == [[3.0]] * 4
    for schedule in schedules(planned.tours[:, 0]):
        assert [len(route) for route in schedule.routes] == [len(range(uav, 3, n_uavs)) for uav in range(n_uavs)]


def test_distance_too_short_for_anything() -> None:
    """The only legal action is to stay at the depot, and the value is 0."""
    instances = Instances.from_arrays([0, 0], [[1, 0], [0, 1]], max_distance=1.0, n_uavs=2)
    assert nearest_feasible(instances).tolist() == [[DEPOT]]
    planned = plan_tours(instances, th.tensor([[[0, 1]]]), nearest_feasible)
    assert planned.value.tolist() == [[0.0]] and schedules(planned.tours[:, 0]) == [Schedule([[], []])]

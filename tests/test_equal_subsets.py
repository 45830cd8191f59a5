"""Equal subsets are planned once, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, random_assignment, seeds, whole_batches
from hypothesis import given, settings
from hypothesis import strategies as st
from solver_helpers import make_policy

from sb3_uav.common.equal_rows import equal_rows
from sb3_uav.envs import AllocationProblem, Instances, UniformGenerator, nearest_feasible, plan_tours
from sb3_uav.envs.routing import deterministic, is_deterministic
from sb3_uav.policies import RouterPolicy


class Counting:
    """A router that notes how many rows it plans."""

    def __init__(self, router: Any = nearest_feasible, is_deterministic: bool = True) -> None:
        self.router = router
        self.is_deterministic = is_deterministic
        self.rows: list[int] = []

    def __call__(self, subsets: Instances) -> th.Tensor:
        self.rows.append(len(subsets))
        return self.router(subsets)


@given(st.lists(st.lists(st.integers(-1, 1), min_size=3, max_size=3), max_size=12))
def test_equal_rows_are_found(rows: list[list[int]]) -> None:
    table = th.tensor(rows, dtype=th.int64).view(-1, 3)
    first, kind = equal_rows(table)
    assert th.equal(table[first][kind], table)
    assert first.tolist() == sorted({rows.index(row) for row in rows})


@settings(max_examples=60)
@given(st.one_of(instance_batches(), whole_batches()), seeds, st.booleans())
def test_tours_are_those_of_each_subset(instances: Instances, seed: int, partial: bool) -> None:
    """With few tasks, many of the samples give a UAV the same ones; UAVs that differ are not mixed up."""
    assignment = random_assignment(instances, 6, np.random.default_rng(seed), partial)
    once, every = Counting(), Counting(is_deterministic=False)
    found, expected = plan_tours(instances, assignment, once), plan_tours(instances, assignment, every)
    assert th.equal(found.tours, expected.tours) and th.equal(found.value, expected.value)
    assert once.rows[0] <= every.rows[0] == assignment.shape[0] * 6 * instances.n_uavs


def test_only_different_subsets_are_planned() -> None:
    instances = UniformGenerator(3, 2)(2, np.random.default_rng(0))
    # Of each instance: {0}, {1, 2}, {0, 2}, {1}, and nothing, for either UAV.
    assignment = th.tensor([[0, 1, 1], [1, 0, 0], [0, 1, 0], [0, 1, 1], [-1, -1, -1]]).expand(2, -1, -1)
    router = Counting()
    plan_tours(instances, assignment, router)
    assert router.rows == [2 * 5]
    # Copies of one instance share the subsets.
    copies = instances[th.tensor([0, 0])]
    plan_tours(copies, assignment, router, copy_of=th.zeros(2, dtype=th.int64))
    assert router.rows[1:] == [5]
    # UAVs that fly equally far, but from different places, do not.
    apart = replace(instances, start=instances.tasks[:, :2])
    plan_tours(apart, assignment, router)
    assert router.rows[2:] == [2 * (4 + 4)]


def test_a_router_that_may_sample_sees_every_subset() -> None:
    instances = UniformGenerator(3, 2)(2, np.random.default_rng(0))
    assignment = th.zeros(2, 5, 3, dtype=th.int64)
    router = Counting(is_deterministic=False)
    plan_tours(instances, assignment, router)
    assert router.rows == [2 * 5 * 2]
    policy = make_policy(RouterPolicy)
    assert is_deterministic(policy.plan) and is_deterministic(nearest_feasible)
    assert not is_deterministic(lambda subsets: policy.plan(subsets, None, 4))


@pytest.mark.parametrize("is_marked", [True, False])
def test_rewards_plan_equal_subsets_once(is_marked: bool) -> None:
    """Also in the step loop, with a router that is set during an episode."""
    problem = AllocationProblem(UniformGenerator(4, 2))
    instances = problem.generator(3, np.random.default_rng(0))
    actions = th.zeros(3, 6, 4, dtype=th.int64)
    dynamics = problem.dynamics(instances)
    router = problem.router = Counting(is_deterministic=is_marked)
    expected = 2 * 3 if is_marked else 2 * 3 * 6
    assert problem.returns(instances, actions).shape == (3, 6) and router.rows == [expected]
    state = dynamics.reset(6)
    for _ in range(4):
        state, _ = dynamics.step(state, actions[..., 0])
    assert router.rows == [expected] * 2


def test_networks_plan_the_same_tours() -> None:
    """But for rounding, which depends on the batch."""
    policy = make_policy(RouterPolicy)
    instances = UniformGenerator(20, 3)(4, np.random.default_rng(0))
    assignment = random_assignment(instances, 5, np.random.default_rng(1))
    assignment = assignment.repeat(1, 3, 1)
    found = plan_tours(instances, assignment, policy.plan)
    expected = plan_tours(instances, assignment, lambda subsets: policy.plan(subsets))
    assert th.equal(found.tours, expected.tours) and th.equal(found.value, expected.value)


def test_the_mark_changes_nothing_else() -> None:
    @deterministic
    def router(subsets: Instances) -> th.Tensor:
        return nearest_feasible(subsets)

    assert is_deterministic(router) and not is_deterministic(lambda subsets: router(subsets))

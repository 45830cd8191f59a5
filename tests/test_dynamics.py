"""The transitions of both levels, as properties of random instances of every kind."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, play_randomly, random_legal, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import (
    AllocationProblem,
    Instances,
    RoutingProblem,
    UniformGenerator,
    nearest_feasible,
)
from sb3_uav.envs.allocation import AllocationDynamics
from sb3_uav.envs.episodes import Episodes
from sb3_uav.envs.problem import Dynamics, Problem
from sb3_uav.envs.routing import RoutingDynamics


def dynamics_of(level: str, instances: Instances) -> Dynamics:
    return RoutingDynamics(instances) if level == "routing" else AllocationDynamics(instances, nearest_feasible)


def start(level: str, instances: Instances, seed: int, n_samples: int) -> tuple[np.random.Generator, Dynamics, Any]:
    """A random generator, the dynamics, and their initial state."""
    dynamics = dynamics_of(level, instances)
    return np.random.default_rng(seed), dynamics, dynamics.reset(n_samples)


def problem_of(level: str, instances: Instances) -> Problem:
    """A problem of the size of the instances."""
    generator = UniformGenerator(instances.n_tasks, instances.n_uavs)
    return RoutingProblem(generator) if level == "routing" else AllocationProblem(generator)


both_levels = pytest.mark.parametrize("level", ["routing", "allocation"])


# Both levels


@both_levels
@settings(max_examples=100)
@given(instances=instance_batches(), seed=seeds, recklessness=st.sampled_from([0.0, 0.1, 1.0]))
def test_some_action_is_always_legal(level: str, instances: Instances, seed: int, recklessness: float) -> None:
    """In every state that any actions can reach; and every episode ends in time."""
    rng, dynamics, state = start(level, instances, seed, 2)
    for _ in range(instances.n_tasks + 1):
        assert state.action_mask.any(-1).all()
        n_actions = state.action_mask.shape[-1]
        careless = th.from_numpy(rng.random(state.done.shape) < recklessness)
        anything = th.from_numpy(rng.integers(0, n_actions, state.done.shape))
        state, _ = dynamics.step(state, anything.where(careless, random_legal(state.action_mask, rng)))
    assert state.done.all() and state.action_mask.any(-1).all()


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds)
def test_finished_episodes_stay_as_they_are(level: str, instances: Instances, seed: int) -> None:
    """Whatever the action and however they ended, while other episodes continue; and they earn no reward."""
    rng, dynamics, state = start(level, instances, seed, 3)
    for _ in range(instances.n_tasks + 3):
        done = state.done
        legal = random_legal(state.action_mask, rng)
        anything = th.from_numpy(rng.integers(0, state.action_mask.shape[-1], done.shape))
        careless = th.from_numpy(rng.random(done.shape) < 0.2)
        new, rewards = dynamics.step(state, anything.where(done | careless, legal))
        for name, before, after in zip(type(state)._fields, state, new, strict=True):
            assert th.equal(before[done], after[done]), name
        assert (rewards[done] == 0).all()
        state = new
    assert state.done.all()


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 4))
def test_samples_are_separate_episodes(level: str, instances: Instances, seed: int, n_samples: int) -> None:
    """S samples of B instances in one state evolve bit-equally to B times S batches of one."""
    actions, rewards = play_randomly(dynamics_of(level, instances), n_samples, np.random.default_rng(seed))
    dynamics = dynamics_of(level, instances)
    together = [dynamics.reset(n_samples)]
    for action in actions.unbind(-1):
        together.append(dynamics.step(together[-1], action)[0])
    for row, sample in itertools.product(range(len(instances)), range(n_samples)):
        alone = dynamics_of(level, instances[row])
        state = alone.reset()
        for step, both in enumerate(together):
            for name, single, batched in zip(type(state)._fields, state, both, strict=True):
                assert th.equal(single[0, 0], batched[row, sample]), (name, step)
            if step < actions.shape[-1]:
                state, reward = alone.step(state, actions[row : row + 1, sample : sample + 1, step])
                assert reward.item() == rewards[row, sample, step]


@both_levels
@settings(max_examples=20)
@given(instances=instance_batches(), seed=seeds)
def test_step_does_not_modify_the_state(level: str, instances: Instances, seed: int) -> None:
    rng, dynamics, state = start(level, instances, seed, 2)
    while not state.done.all():
        before = [field.clone() for field in state]
        new, _ = dynamics.step(state, random_legal(state.action_mask, rng))
        assert all(th.equal(field, old) for field, old in zip(state, before, strict=True))
        state = new


@both_levels
@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds)
def test_returns_rewards_and_lengths_of_whole_episodes(level: str, instances: Instances, seed: int) -> None:
    """The results for complete episodes equal those of the steps."""
    problem = problem_of(level, instances)
    # Allocations have a UAV for padded tasks, too.
    n_steps = instances.n_tasks if level == "allocation" else 1
    actions, rewards = play_randomly(problem.dynamics(instances), 3, np.random.default_rng(seed), n_steps)
    returns = problem.returns(instances, actions)
    assert returns.dtype == th.float64 and returns.shape == actions.shape[:2]
    assert th.allclose(returns, rewards.sum(-1), rtol=1e-12, atol=0)
    step_rewards = problem.step_rewards(instances, actions, returns)
    assert th.allclose(step_rewards, rewards, rtol=1e-12, atol=0)
    lengths = problem.lengths(instances, actions)
    assert lengths.shape == actions.shape[:2] and lengths.dtype == th.int64
    for row, sample in itertools.product(range(len(instances)), range(3)):
        assert lengths[row, sample] == steps_until_done(problem, instances[row], actions[row, sample].tolist())


def steps_until_done(problem: Problem, instance: Instances, actions: list[int]) -> int:
    """Number of steps, counted by stepping."""
    episodes = Episodes(problem, 1)
    episodes.reset(given={0: instance})
    for n_steps, action in enumerate(actions, start=1):
        if episodes.step(np.array([action])).dones[0]:
            return n_steps
    raise AssertionError("The episode did not end.")


@both_levels
def test_instance_without_any_task(level: str, small: Instances) -> None:
    """A row with only padding, such as a UAV without tasks: one step without effect."""
    instances = replace(small, task_mask=th.zeros_like(small.task_mask))
    problem = problem_of(level, instances)
    state = problem.dynamics(instances).reset()
    assert state.action_mask.any(-1).all()
    actions, rewards = play_randomly(problem.dynamics(instances), 1, np.random.default_rng(0), instances.n_tasks)
    returns = problem.returns(instances, actions)
    assert returns.tolist() == [[0.0]] * 3 and rewards.sum() == 0
    assert problem.lengths(instances, actions).tolist() == [[1]] * 3
    assert problem.step_rewards(instances, actions, returns).tolist() == rewards.tolist()
    assert steps_until_done(problem, instances[0], actions[0, 0].tolist()) == 1


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds, exponent=st.integers(-60, 60))
def test_unit_of_length_does_not_matter(level: str, instances: Instances, seed: int, exponent: int) -> None:
    """Multiplying coordinates and D by a power of two, which is exact, changes no mask and no reward."""
    factor = 2.0**exponent
    scaled = replace(
        instances,
        depot=instances.depot * factor,
        tasks=instances.tasks * factor,
        max_distance=instances.max_distance * factor,
    )
    actions, rewards = play_randomly(dynamics_of(level, instances), 2, np.random.default_rng(seed))
    one, other = dynamics_of(level, instances), dynamics_of(level, scaled)
    state, state_scaled = one.reset(2), other.reset(2)
    for step in range(actions.shape[-1]):
        assert th.equal(state.action_mask, state_scaled.action_mask)
        state, _ = one.step(state, actions[..., step])
        state_scaled, reward = other.step(state_scaled, actions[..., step])
        assert th.equal(reward, rewards[..., step])


@both_levels
@settings(max_examples=30)
@given(instances=instance_batches(), seed=seeds, extra=st.integers(1, 4))
def test_padding_changes_nothing(level: str, instances: Instances, seed: int, extra: int) -> None:
    """The same actions earn the same rewards at the same steps, and no padded task is ever legal."""
    padded = instances.pad(instances.n_tasks + extra)
    actions, rewards = play_randomly(dynamics_of(level, instances), 2, np.random.default_rng(seed))
    dynamics = dynamics_of(level, padded)
    state = dynamics.reset(2)
    for step in range(actions.shape[-1]):
        assert state.action_mask.gather(-1, actions[..., step, None])[~state.done].all()
        if level == "routing":
            assert not state.action_mask[..., instances.n_tasks + 1 :].any()
        state, reward = dynamics.step(state, actions[..., step])
        assert th.equal(reward, rewards[..., step])
    assert state.done.all()

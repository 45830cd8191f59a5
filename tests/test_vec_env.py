"""``BatchedVecEnv``, against SB3's ``DummyVecEnv``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import instance_batches, random_legal, seeds
from env_helpers import (
    LEVELS,
    assert_same_arrays,
    assert_same_run,
    batched_env,
    both_levels,
    env_fns,
    legal_actions,
    overwrite,
    reset,
    step,
)
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit, TransformReward
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.envs import (
    BatchedVecEnv,
    FixedGenerator,
    Instances,
    RoutePlanningEnv,
    UniformGenerator,
    nearest_feasible,
)

# The same as DummyVecEnv


@both_levels
@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    n_envs=st.integers(1, 5),
    n_tasks=st.integers(1, 7),
    max_distance=st.sampled_from([0.05, 1.0, 2.0]),
    distribution=st.sampled_from(["uniform", "clustered"]),
    recklessness=st.sampled_from([0.0, 0.2]),
)
def test_plays_the_episodes_of_dummy_vec_env(
    level: str, seed: int, n_envs: int, n_tasks: int, max_distance: float, distribution: str, recklessness: float
) -> None:
    """With the same seed, step by step, over several episodes of unequal lengths, with and without illegal actions."""
    fns = env_fns(level, n_envs, n_tasks=n_tasks, max_distance=max_distance, distribution=distribution)
    ours, theirs = BatchedVecEnv(fns), DummyVecEnv(fns)
    assert ours.seed(seed) == theirs.seed(seed)
    assert_same_arrays(reset(ours), reset(theirs))
    rng = np.random.default_rng(seed)
    assert assert_same_run(ours, theirs, rng, 3 * n_tasks + 3, recklessness) >= 3 * n_envs
    # A reset during episodes continues with the same random numbers.
    assert_same_arrays(reset(ours), reset(theirs))
    assert_same_run(ours, theirs, rng, n_tasks, recklessness)
    assert ours.reset_infos == theirs.reset_infos
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space


@both_levels
@settings(max_examples=25)
@given(instances=instance_batches(), seed=seeds, n_envs=st.integers(1, 4))
def test_plays_given_instances_like_dummy_vec_env(level: str, instances: Instances, seed: int, n_envs: int) -> None:
    """Instances of every kind, padded ones too, whose episodes end at different times."""
    fns = env_fns(level, n_envs, instances=instances)
    ours, theirs = BatchedVecEnv(fns), DummyVecEnv(fns)
    ours.seed(seed)
    theirs.seed(seed)
    assert_same_arrays(reset(ours), reset(theirs))
    assert_same_run(ours, theirs, np.random.default_rng(seed), 2 * instances.n_tasks + 2, 0.1)


@both_levels
@settings(max_examples=15)
@given(instances=instance_batches(uniform_size=True), seed=st.integers(0, 1000), n_envs=st.integers(2, 4))
def test_options_and_seeds_are_used_once(level: str, instances: Instances, seed: int, n_envs: int) -> None:
    """Row by row, at the next reset only."""
    fns = (
        env_fns(level, n_envs, n_tasks=10, n_uavs=instances.n_uavs)
        if level == "allocation"
        else env_fns(level, n_envs, n_tasks=10)
    )
    ours, theirs = BatchedVecEnv(fns), DummyVecEnv(fns)
    options = [{"instance": instances[row % len(instances)]} if row != 1 else {} for row in range(n_envs)]
    for env in (ours, theirs):
        env.seed(seed)
        env.set_options(options)
    first = reset(ours)
    assert_same_arrays(first, reset(theirs))
    n_tasks = instances.n_tasks
    assert first["task_mask"].sum(1).tolist() == [n_tasks if row != 1 else 10 for row in range(n_envs)]
    assert np.array_equal(first["tasks"][0, : 2 * n_tasks], instances.near_origin().tasks[0].float().flatten().numpy())
    assert_same_run(ours, theirs, np.random.default_rng(seed), n_tasks + 2, 0.0)
    again = reset(ours)
    assert_same_arrays(again, reset(theirs))
    assert again["task_mask"].all()
    # A single dict applies to all rows.
    ours.set_options({"instance": instances[0]})
    assert (reset(ours)["task_mask"].sum(1) == n_tasks).all()


@both_levels
def test_bad_options_are_refused(level: str) -> None:
    env = batched_env(level, 2, n_tasks=4)
    cases: list[tuple[list[dict[str, Any]], str]] = [
        ([{}, {"instances": None}], r"Unknown reset options \['instances'\]"),
        ([{"instance": UniformGenerator(4)(2, np.random.default_rng(0))}, {}], "must be Instances with batch size 1"),
        ([{"instance": UniformGenerator(5)(1, np.random.default_rng(0))}, {}], "The instance has 5 tasks, but .* holds 4"),
    ]
    for options, message in cases:
        env.set_options(options)
        with pytest.raises(ValueError, match=message):
            reset(env)


def test_fleet_of_a_given_instance() -> None:
    """Allocation refuses a number of UAVs other than that of its actions; routing accepts any, in every row."""
    other_fleet: dict[str, Any] = {"instance": UniformGenerator(4, n_uavs=6)(1, np.random.default_rng(0))}
    allocation, routing = batched_env("allocation", 2, n_tasks=4), batched_env("routing", 2, n_tasks=4)
    for env in (allocation, routing):
        env.set_options([{}, other_fleet])
    with pytest.raises(ValueError, match="The instance has 6 UAVs, but the environment was made for 4"):
        reset(allocation)
    expected = other_fleet["instance"].tasks.float().numpy().ravel()
    assert np.array_equal(reset(routing)["tasks"][1], expected)


@both_levels
def test_rows_and_seeds(level: str) -> None:
    """Row i plays what a single environment seeded with seed + i plays; unseeded rows all differ."""
    env = batched_env(level, 3, n_tasks=5)
    env.seed(20)
    tasks = reset(env)["tasks"]
    for row in range(3):
        assert np.array_equal(LEVELS[level](n_tasks=5).reset(seed=20 + row)[0]["tasks"], tasks[row])
    unseeded = np.concatenate([reset(batched_env(level, 3, n_tasks=5))["tasks"] for _ in range(2)])
    assert len(np.unique(unseeded, axis=0)) == 6


@both_levels
def test_nothing_returned_shares_memory(level: str) -> None:
    """Overwriting all returned arrays changes neither the episodes nor later results."""
    runs = []
    for vandal in (False, True):
        env = batched_env(level, 3, n_tasks=4)
        env.seed(0)
        observation = reset(env)
        rng = np.random.default_rng(0)
        run = []
        for _ in range(10):
            actions = legal_actions(env, rng)
            masks = env.action_masks()
            if vandal:
                overwrite(masks, *observation.values())
            before = {key: array.copy() for key, array in observation.items()}
            new, rewards, dones, infos = step(env, actions)
            assert_same_arrays(observation, before)
            run.append([{key: array.tolist() for key, array in new.items()}, rewards.tolist(), dones.tolist()])
            for info in infos:
                if "terminal_observation" in info:
                    run.append([{key: array.tolist() for key, array in info["terminal_observation"].items()}])
                    if vandal:
                        for array in info["terminal_observation"].values():
                            array[...] = 1
            if vandal:
                rewards[:], dones[:] = 9, True
            observation = new
        runs.append(run)
    assert runs[0] == runs[1]


@pytest.mark.parametrize("actions", [[0, 4], [0, -1], [0, 0.5], [0, np.nan], [0], [0, 0, 0]])
def test_impossible_actions_are_refused(actions: list[float]) -> None:
    env = batched_env("allocation", 2, n_tasks=3, n_uavs=4)
    reset(env)
    with pytest.raises(ValueError, match="Give 2 whole numbers between 0 and 3 as actions; found"):
        env.step(np.array(actions))


@both_levels
def test_step_before_reset(level: str) -> None:
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        batched_env(level, 2).step(np.array([0, 0]))


@both_levels
def test_thousands_of_rows(level: str) -> None:
    """2048 rows play whole episodes, and row 1000 equals a single environment."""
    env = batched_env(level, 2048, n_tasks=20)
    env.seed(0)
    observation = reset(env)
    assert observation["tasks"].shape == (2048, 40) and len(np.unique(observation["tasks"], axis=0)) == 2048
    rng = np.random.default_rng(0)
    alone = LEVELS[level](n_tasks=20)
    alone.reset(seed=1000)
    n_episodes = 0
    for _ in range(21):
        actions = random_legal(th.from_numpy(env.action_masks()), rng).numpy()
        single, _, terminated, _, _ = alone.step(actions[1000])
        observation, _, dones, infos = step(env, actions)
        assert dones[1000] == terminated
        if terminated:
            assert_same_arrays(infos[1000]["terminal_observation"], single)
            single, _ = alone.reset()
        assert_same_arrays({key: array[1000] for key, array in observation.items()}, single)
        n_episodes += int(dones.sum())
    assert n_episodes >= 2048


# What it accepts


class Halved(TransformReward):
    def __init__(self, env: gym.Env) -> None:
        super().__init__(env, lambda reward: float(reward) / 2)


class Shaped(RoutePlanningEnv):
    """Overrides a method that BatchedVecEnv does not call."""

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward - 1.0, *rest


class Sly(Monitor):
    """A Monitor that also changes rewards."""

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, float(reward) / 2, *rest


@pytest.mark.parametrize(
    "make",
    [
        partial(gym.make, "CartPole-v1"),
        lambda: Halved(RoutePlanningEnv()),
        lambda: Monitor(Halved(RoutePlanningEnv())),
        Shaped,
        lambda: Monitor(Shaped()),
        lambda: Sly(RoutePlanningEnv()),
    ],
    ids=["foreign", "wrapped", "wrapped inside", "subclass", "subclass inside", "subclass of Monitor"],
)
def test_refuses_what_it_would_not_play(make: Callable[[], gym.Env]) -> None:
    """Foreign environments, and wrappers and subclasses that change behavior."""
    with pytest.raises(ValueError, match=r"BatchedVecEnv cannot batch <.*; use stable_baselines3's DummyVecEnv for it"):
        BatchedVecEnv([make])


def test_accepts_transparent_wrappers() -> None:
    """The wrappers of ``gym.make`` and ``make_vec_env``."""
    for env in (
        gym.make("RoutePlanning-N20-v0"),
        OrderEnforcing(PassiveEnvChecker(RoutePlanningEnv())),
    ):
        assert BatchedVecEnv([partial(Monitor, env)]).template is env.unwrapped
    # A limit may truncate episodes.
    with pytest.raises(ValueError, match="cannot batch"):
        BatchedVecEnv([lambda: TimeLimit(RoutePlanningEnv(), max_episode_steps=5)])
    made = make_vec_env("TaskAllocation-U3-N20-v0", n_envs=2, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
    assert isinstance(made, BatchedVecEnv) and reset(made)["tasks"].shape == (2, 40)


# Attributes and methods


@both_levels
def test_attributes_are_those_of_one_shared_environment(level: str) -> None:
    env = batched_env(level, 3, n_tasks=4, render_mode="rgb_array")
    reset(env)
    assert env.get_attr("render_mode") == ["rgb_array"] * 3 and env.render_mode == "rgb_array"
    assert len(env.get_attr("problem", indices=[0, 2])) == 2 and len(env.get_attr("problem", indices=1)) == 1
    assert env.has_attr("problem") and not env.has_attr("wings")
    with pytest.raises(AttributeError, match="wings"):
        env.get_attr("wings")
    env.set_attr("wings", 4)
    assert env.get_attr("wings") == [4, 4, 4]
    env.set_attr("wings", 6, indices=[2, 0, 1])
    assert env.has_attr("wings") and env.get_attr("wings", indices=-1) == [6]
    with pytest.raises(ValueError, match=r"Cannot set wings for rows \[0, 1\] alone: the rows .* share one environment"):
        env.set_attr("wings", 8, indices=[0, 1])
    assert env.get_attr("wings", indices=0) == [6]


@both_levels
def test_instances_are_those_of_the_rows(level: str) -> None:
    env = batched_env(level, 3, n_tasks=4)
    assert not env.has_attr("instance")
    observation = reset(env)
    for row, instance in zip([2, 0], env.get_attr("instance", indices=[2, 0]), strict=True):
        assert len(instance) == 1 and np.array_equal(instance.tasks.float().flatten(), observation["tasks"][row])
    assert env.has_attr("instance") and len(env.get_attr("instance")) == 3


@both_levels
def test_methods(level: str) -> None:
    """``action_masks`` returns a result per row; shared methods are called once, for all rows only."""
    env = batched_env(level, 3, n_tasks=4)
    reset(env)
    masks = env.action_masks()
    assert np.array_equal(np.stack(env.env_method("action_masks", indices=[2, 0])), masks[[2, 0]])
    assert env.env_method("action_masks", indices=1)[0].tolist() == masks[1].tolist()
    assert [mask.tolist() for mask in env.env_method("action_masks")] == masks.tolist()
    with pytest.raises(ValueError, match=r"Cannot call set_generator for rows 0 alone: the rows .* share one environment"):
        env.env_method("set_generator", UniformGenerator(4), indices=0)
    for name in ("reset", "step"):
        with pytest.raises(ValueError, match=rf"The rows of a BatchedVecEnv share one environment; call its own {name}\(\)"):
            env.env_method(name)
    with pytest.raises(AttributeError, match="flap"):
        env.env_method("flap")


@pytest.mark.parametrize("by_method", [True, False])
@both_levels
def test_set_generator(level: str, by_method: bool) -> None:
    """It takes effect in all rows with their next episodes."""
    env = batched_env(level, 3, n_tasks=4)
    first = reset(env)
    source = FixedGenerator(UniformGenerator(4, 1 if level == "routing" else 4)(1, np.random.default_rng(0)))
    if by_method:
        env.env_method("set_generator", source)
    else:
        env.set_generator(source)
    assert np.array_equal(env.get_attr("instance")[0].tasks.float().flatten(), first["tasks"][0])
    assert (reset(env)["tasks"] == source.instances.tasks.float().flatten().numpy()).all()
    with pytest.raises(ValueError, match="The new generator draws 5 tasks"):
        env.set_generator(UniformGenerator(5))


def test_set_router() -> None:
    """By ``env_method``, as training callbacks do, in all rows and during episodes."""
    env = batched_env("allocation", 3, n_tasks=2)

    def final_rewards() -> list[float]:
        env.step(np.zeros(3, dtype=np.int64))
        return env.step(np.zeros(3, dtype=np.int64))[1].tolist()

    env.seed(0)
    reset(env)
    assert sum(final_rewards()) > 0
    env.env_method("set_router", lambda instances: th.zeros(len(instances), 1, dtype=th.int64))
    assert final_rewards() == [0.0, 0.0, 0.0]
    env.env_method("set_router", nearest_feasible)
    assert sum(final_rewards()) > 0


def test_env_is_wrapped() -> None:
    """Reported as wrapped in a Monitor, because the infos have its statistics."""

    class OtherMonitor(Monitor):
        pass

    env = batched_env("routing", 3)
    assert env.env_is_wrapped(Monitor) == [True] * 3 and env.env_is_wrapped(Monitor, indices=[1]) == [True]
    assert env.env_is_wrapped(TransformReward) == [False] * 3 and env.env_is_wrapped(OtherMonitor) == [False] * 3

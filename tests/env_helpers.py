"""Helpers for the tests of the environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import random_legal
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.envs.gym_env import ProblemEnv

LEVELS: dict[str, Callable[..., ProblemEnv]] = {"routing": RoutePlanningEnv, "allocation": TaskAllocationEnv}
both_levels = pytest.mark.parametrize("level", sorted(LEVELS))


def make(level: str, **kwargs: Any) -> ProblemEnv:
    return LEVELS[level](**kwargs)


def act(env: ProblemEnv, rng: np.random.Generator) -> int:
    """A random legal action."""
    return int(random_legal(th.from_numpy(env.action_masks()), rng))


def play(env: ProblemEnv, rng: np.random.Generator, **reset_kwargs: Any) -> tuple[list[dict[str, np.ndarray]], list[float]]:
    """The observations and rewards of one episode of random legal actions."""
    observation, _ = env.reset(**reset_kwargs)
    observations, rewards = [observation], []
    while True:
        observation, reward, terminated, truncated, info = env.step(act(env, rng))
        assert observation in env.observation_space and not truncated
        observations.append(observation)
        rewards.append(float(reward))
        assert ("objective" in info) == terminated
        if terminated:
            assert info["illegal_actions"] == 0 and info["objective"] == pytest.approx(sum(rewards))
            return observations, rewards


def overwrite(*arrays: np.ndarray) -> None:
    """Overwrite arrays that an environment has returned."""
    for array in arrays:
        array[...] = array == 0


def rendered(env: ProblemEnv) -> np.ndarray:
    image = env.render()
    assert image is not None
    return image


def env_fns(level: str, n_envs: int, **kwargs: Any) -> list[Callable[[], gym.Env]]:
    return [lambda: Monitor(LEVELS[level](**kwargs)) for _ in range(n_envs)]


def batched_env(level: str, n_envs: int, **kwargs: Any) -> BatchedVecEnv:
    return BatchedVecEnv(env_fns(level, n_envs, **kwargs))


def reset(env: VecEnv) -> dict[str, np.ndarray]:
    observation = env.reset()
    assert isinstance(observation, dict)
    return observation


def step(env: VecEnv, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
    observation, rewards, dones, infos = env.step(actions)
    assert isinstance(observation, dict)
    return observation, rewards, dones, infos


def masks_of(env: VecEnv) -> np.ndarray:
    return np.stack(env.env_method("action_masks"))


def legal_actions(env: VecEnv, rng: np.random.Generator) -> np.ndarray:
    return random_legal(th.from_numpy(masks_of(env)), rng).numpy()


def assert_same_arrays(a: Any, b: Any) -> None:
    """Two Dict observations have the same keys in the same order, dtypes and values."""
    assert list(a) == list(b)
    for key in a:
        assert a[key].dtype == b[key].dtype and np.array_equal(a[key], b[key]), key


def assert_same_infos(a: dict[str, Any], b: dict[str, Any]) -> None:
    """All infos are equal except for times."""
    assert set(a) - {"TimeLimit.truncated"} == set(b) - {"TimeLimit.truncated"}
    assert a.get("TimeLimit.truncated", False) == b.get("TimeLimit.truncated", False)
    assert a["illegal_actions"] == b["illegal_actions"]
    assert a.get("objective") == b.get("objective")
    if "episode" in a:
        assert {**a["episode"], "t": 0} == {**b["episode"], "t": 0} and a["episode"]["t"] >= 0
        assert_same_arrays(a["terminal_observation"], b["terminal_observation"])


def assert_same_run(ours: VecEnv, theirs: VecEnv, rng: np.random.Generator, n_steps: int, recklessness: float) -> int:
    """
    Step both alike and compare everything they return.

    :return: How many episodes ended
    """
    n_episodes = 0
    for _ in range(n_steps):
        assert np.array_equal(masks_of(ours), masks_of(theirs))
        actions = legal_actions(theirs, rng)
        careless = rng.random(len(actions)) < recklessness
        actions[careless] = rng.integers(0, masks_of(ours).shape[1], careless.sum())
        (obs_a, rewards_a, dones_a, infos_a), (obs_b, rewards_b, dones_b, infos_b) = step(ours, actions), step(theirs, actions)
        assert_same_arrays(obs_a, obs_b)
        for a, b in ((rewards_a, rewards_b), (dones_a, dones_b)):
            assert a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
        for info_a, info_b, done in zip(infos_a, infos_b, dones_a, strict=True):
            assert_same_infos(info_a, info_b)
            assert ("episode" in info_a) == done
        n_episodes += dones_a.sum()
    return int(n_episodes)

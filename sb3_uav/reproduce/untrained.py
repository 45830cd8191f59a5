"""Pairs before any training, so that a reader sees what learning adds to the heuristics that the networks begin with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.common.saving import save_atomically
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reproduce.pair_training import ALLOCATOR_FILE, ITS_KEY, ROUTER_FILE


def make_untrained_pair(entry: Mapping[str, Any], env_id: str, folder: Path, seed: int) -> None:
    """
    Write the zips of a pair of new networks.

    :param entry: The zoo's YAML entry of the allocator, which holds the settings of both networks
    :param env_id: Id of its environment
    :param folder: Folder of the zips
    :param seed: Seed of the allocator; the router has the next one, as in a training
    """
    router_kwargs = entry["callback"][0][ITS_KEY]["router"]["policy_kwargs"]
    sizes = dict(entry["env_kwargs"])
    folder.mkdir(parents=True, exist_ok=True)
    with undisturbed_random_state():
        env = BatchedVecEnv([lambda: gym.make(env_id, **sizes)])
        allocator = REINFORCE(AllocatorPolicy, env, policy_kwargs=dict(entry["policy_kwargs"]), seed=seed, device="cpu")
        env = BatchedVecEnv([lambda: RoutePlanningEnv(**sizes)])
        router = REINFORCE(RouterPolicy, env, policy_kwargs=dict(router_kwargs), seed=seed + 1, device="cpu")
    save_atomically(allocator, folder / ALLOCATOR_FILE)
    save_atomically(router, folder / ROUTER_FILE)

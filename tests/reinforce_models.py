"""Small environments and models for the tests of REINFORCE."""

from typing import Any

import torch as th

from sb3_uav.envs import (
    BatchedVecEnv,
    RoutePlanningEnv,
    TaskAllocationEnv,
)
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE

SMALL: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)
BASELINES = ("none", "exponential", "shared", "critic", "rollout")


def make_env(level: str = "allocator", n_envs: int = 4, n_tasks: int = 6, max_distance: float = 1.2) -> Any:
    if level == "allocator":
        return BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks, 2, max_distance=max_distance)] * n_envs)
    return BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks, max_distance=max_distance)] * n_envs)


def make_model(level: str = "allocator", baseline: str = "shared", env=None, **kwargs) -> Any:
    policy = AllocatorPolicy if level == "allocator" else RouterPolicy
    settings: dict[str, Any] = dict(
        n_samples=3, instances_per_epoch=8, seed=0, device="cpu", policy_kwargs=SMALL, learning_rate=1e-3
    )
    if baseline == "rollout":
        settings["baseline_kwargs"] = dict(n_test_instances=16)
    return REINFORCE(policy, env or make_env(level), baseline=baseline, **{**settings, **kwargs})


def assert_equal_parameters(a: REINFORCE, b: REINFORCE) -> None:
    one, two = a.get_parameters(), b.get_parameters()
    assert one.keys() == two.keys()
    for name in one:
        if name != "policy.optimizer":
            for key, value in one[name].items():
                assert th.equal(value, two[name][key]), (name, key)

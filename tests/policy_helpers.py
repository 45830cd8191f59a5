"""What the tests of the policies share: small networks, environments and instances."""

from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy

SMALL: dict[str, Any] = dict(embed_dim=16, n_layers=2, n_heads=4, ff_dim=32)
# Leaves the sizes to the preset.
UNSET: dict[str, Any] = dict.fromkeys(SMALL)
LEVELS = ("allocator", "router")


def make_policy(level: str, n_uavs: int = 3, n_tasks: int = 7, seed: int = 0, **kwargs) -> Any:
    th.manual_seed(seed)
    env = TaskAllocationEnv(n_tasks, n_uavs) if level == "allocator" else RoutePlanningEnv(n_tasks)
    cls = AllocatorPolicy if level == "allocator" else RouterPolicy
    policy = cls(env.observation_space, env.action_space, lambda _: 1e-3, **{**SMALL, **kwargs})
    policy.set_training_mode(False)
    return policy


def make_vec(level: str, n_envs: int = 4, n_tasks: int = 7, n_uavs: int = 3) -> Any:
    if level == "allocator":
        return BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks, n_uavs)] * n_envs)
    return BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks)] * n_envs)


def draw(n: int, n_tasks: int = 7, n_uavs: int = 3, seed: int = 0) -> Instances:
    return UniformGenerator(n_tasks, n_uavs)(n, np.random.default_rng(seed))


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def shake_statistics(policy: EpisodicPolicy) -> None:
    """Give batch norms statistics and weights that a test can tell from no normalization."""
    generator = th.Generator().manual_seed(1)
    for module in policy.modules():
        if isinstance(module, nn.BatchNorm1d):
            assert module.running_mean is not None and module.running_var is not None
            module.running_mean.copy_(th.randn(module.num_features, generator=generator) * 0.1)
            module.running_var.copy_(th.rand(module.num_features, generator=generator) + 0.5)
            module.weight.data.copy_(th.rand(module.num_features, generator=generator) + 0.5)
            module.bias.data.copy_(th.randn(module.num_features, generator=generator) * 0.1)

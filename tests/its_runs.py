"""Small ITS runs, and what tests compare of them."""

from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.envs import BatchedVecEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import ITSCallback

SMALL: dict[str, Any] = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
PAPER: dict[str, Any] = dict(SMALL, preset="paper")
N_TASKS, N_UAVS, N_ENVS = 5, 2, 4


def make_env(n_envs: int = N_ENVS, n_uavs: int = N_UAVS) -> Any:
    return BatchedVecEnv([lambda: TaskAllocationEnv(N_TASKS, n_uavs, max_distance=1.5)] * n_envs)


def make_allocator(n_uavs: int = N_UAVS, **kwargs) -> Any:
    settings: dict[str, Any] = dict(
        baseline="exponential", instances_per_epoch=8, learning_rate=1e-2, seed=0, device="cpu", policy_kwargs=SMALL
    )
    return REINFORCE(AllocatorPolicy, make_env(n_uavs=n_uavs), **{**settings, **kwargs})


def make_its(router: dict | None = None, **kwargs) -> Any:
    default_router: dict[str, Any] = dict(policy="RouterPolicy", n_envs=4, learning_rate=1e-2, policy_kwargs=SMALL)
    settings: dict[str, Any] = dict(n_epochs=6, n_pretraining_epochs=2, n_intensive_epochs=4, n_continuous_epochs=2)
    return ITSCallback({**default_router, **(router or {})}, **{**settings, **kwargs})


def learn(model: REINFORCE, its: ITSCallback, *others: BaseCallback) -> Any:
    return model.learn(10**9, callback=[its, *others])


def snapshot(policy) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in policy.state_dict().items()}


def equal(a: dict[str, th.Tensor], b: dict[str, th.Tensor]) -> bool:
    return all(th.equal(value, b[name]) for name, value in a.items())


def trace(its: ITSCallback) -> str:
    """The order of the epochs: a for allocator, p, i and t for the router's phases."""
    letters = {"pre-training": "p", "intensive": "i", "alternate": "t"}
    return "".join("a" if record.level == "allocator" else letters[record.phase] for record in its.records)

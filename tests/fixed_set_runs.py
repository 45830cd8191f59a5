"""Small trainings with an evaluation on a fixed set."""

from pathlib import Path
from typing import Any

import torch as th
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback
from sb3_uav.training.fixed_set_history import EvaluationHistory

NETWORK: dict[str, Any] = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
BATCH_NORM: dict[str, Any] = dict(NETWORK, preset="paper")
N_TASKS, N_UAVS, N_ENVS = 5, 2, 4
ROLLOUT = N_TASKS * N_ENVS
POLICIES: dict[str, Any] = {"allocation": AllocatorPolicy, "routing": RouterPolicy}


def allocation_env() -> TaskAllocationEnv:
    return TaskAllocationEnv(N_TASKS, N_UAVS, max_distance=1.5, task_order="sweep")


def routing_env() -> RoutePlanningEnv:
    return RoutePlanningEnv(N_TASKS, max_distance=1.5)


ENVS: dict[str, Any] = {"allocation": allocation_env, "routing": routing_env}


def make_model(algorithm: Any = PPO, level: str = "allocation", vec_env: Any = BatchedVecEnv, **kwargs: Any) -> Any:
    env = vec_env([ENVS[level]] * N_ENVS)
    settings: dict[str, Any] = dict(learning_rate=1e-2, seed=0, device="cpu", policy_kwargs=dict(NETWORK))
    if algorithm is REINFORCE:
        settings.update(instances_per_epoch=2 * N_ENVS)
    else:
        settings.update(n_steps=N_TASKS, gamma=1.0)
    if algorithm in (PPO, MaskablePPO):
        settings.update(batch_size=ROLLOUT, n_epochs=1)
    return algorithm(POLICIES[level], env, **{**settings, **kwargs})


def make_callback(folder: Path | None = None, **kwargs: Any) -> FixedSetEvalCallback:
    return FixedSetEvalCallback(**{**dict(n_instances=6, n_samples=3, eval_freq=ROLLOUT, save_path=folder), **kwargs})


def parameters(model: Any) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def equal(a: dict[str, th.Tensor], b: dict[str, th.Tensor]) -> bool:
    return a.keys() == b.keys() and all(th.equal(value, b[name]) for name, value in a.items())


def load(folder: Path) -> EvaluationHistory:
    return EvaluationHistory.load(folder / "evaluations.npz")

"""What the tests of the drivers share: networks, environments, and episodes replayed in a ``BatchedVecEnv``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy

# The default preset with single ingredients left out, and that of the paper.
VARIANTS: dict[str, dict[str, Any]] = {
    "default": dict(n_layers=2),
    "whole": dict(preset="whole", n_layers=1),
    "paper": dict(preset="paper", n_layers=1),
    "no geometry": dict(geometry=False, n_layers=1),
    "one scorer per UAV": dict(shared_scorer=False, n_layers=1),
}


@cache
def make_policy(level: str, preset: str, n_tasks: int, n_uavs: int, is_whole: bool = False) -> EpisodicPolicy:
    """One policy for all examples of a size, so that encodings kept from one example must not leak into the next."""
    th.manual_seed(0)
    allocates = level == "allocator"
    cls: Any = AllocatorPolicy if allocates else RouterPolicy
    env: Any = TaskAllocationEnv(n_tasks, n_uavs) if allocates else RoutePlanningEnv(n_tasks)
    if is_whole:
        # Any instances of this size that go beyond the paper's problem.
        plain = UniformGenerator(n_tasks, n_uavs)(1, np.random.default_rng(0))
        env = make_env(level, replace(plain, service=th.ones_like(plain.values)))
    sizes = dict(embed_dim=16, n_heads=2, ff_dim=16)
    policy = cls(env.observation_space, env.action_space, lambda _: 0.0, **sizes, **VARIANTS[preset])
    with th.no_grad():
        for parameter in policy.parameters():
            if (parameter == 0).all():
                # What starts at 0 must have an effect here.
                parameter.normal_(std=0.3)
    for module in policy.modules():
        if isinstance(module, nn.BatchNorm1d):
            assert module.running_mean is not None and module.running_var is not None
            module.running_mean.normal_(std=0.1)
            module.running_var.uniform_(0.5, 1.5)
    policy.set_training_mode(False)
    return policy


def make_env(level: str, instances: Instances) -> Any:
    return TaskAllocationEnv(instances=instances) if level == "allocator" else RoutePlanningEnv(instances=instances)


def sample(policy: EpisodicPolicy, instances: Instances, n_samples: int, seed: int) -> th.Tensor:
    return policy.decode_episodes(instances, n_samples, False, th.Generator().manual_seed(seed))


def near_unit(instances: Instances) -> Instances:
    """The same instances in other units, because float32 networks say nothing about coordinates of any magnitude."""
    points = th.cat([instances.depot[:, None], instances.tasks, instances.uav_start, instances.uav_end], dim=1)
    unit = points.abs().amax((1, 2)).clamp(min=1e-300)
    distance = (instances.max_distance.t() / unit).t().clamp(max=100.0)
    return replace(
        instances.map_points(lambda points: points / unit[:, None, None]),
        depot=instances.depot / unit[:, None],
        values=instances.values / instances.values.amax(1, keepdim=True).clamp(min=1.0),
        max_distance=distance,
        service=None if instances.service is None else (instances.service / unit[:, None]).clamp(max=100.0),
    )


def play_vectorized(
    level: str, instances: Instances, actions: th.Tensor, watch: Callable[[int, dict[str, np.ndarray], np.ndarray], None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Replay complete episodes in a ``BatchedVecEnv``, one row per episode.

    :param level: Which of the two
    :param instances: ``batch`` instances
    :param actions: ``(batch, n_samples, n_steps)`` int64
    :param watch: Called before every step with its number, the observation, and which rows still run
    :return: Returns, sums of the float32 rewards, and lengths of the episodes, ``(batch, n_samples)``
    """
    shape = tuple(actions.shape[:2])
    flat = actions.flatten(0, 1).numpy()
    owners = np.repeat(np.arange(shape[0]), shape[1])
    env = BatchedVecEnv([lambda: make_env(level, instances)] * len(flat))
    env.set_options([{"instance": instances[int(i)]} for i in owners])
    observation: Any = env.reset()
    running = np.ones(len(flat), dtype=bool)
    returns, rewarded, lengths = np.full(len(flat), np.nan), np.zeros(len(flat)), np.zeros(len(flat), dtype=np.int64)
    for step in range(flat.shape[1]):
        if not running.any():
            break
        watch(step, observation, running.copy())
        masks = env.action_masks()
        assert (masks == observation["action_mask"].astype(bool)).all()
        # Rows that are over have begun another episode, where any legal action will do.
        chosen = np.where(running, flat[:, step], masks.argmax(1))
        assert masks[np.arange(len(flat)), chosen].all()
        observation, rewards, dones, infos = env.step(chosen)
        assert not any(infos[row]["illegal_actions"] for row in running.nonzero()[0])
        rewarded[running] += rewards[running]
        lengths[running] += 1
        for row in (running & dones).nonzero()[0]:
            returns[row] = infos[row]["objective"]
            assert infos[row]["episode"]["l"] == lengths[row]
        running &= ~dones
    assert not running.any()
    return returns.reshape(shape), rewarded.reshape(shape), lengths.reshape(shape)

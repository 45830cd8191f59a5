"""Training on the whole problem: REINFORCE and ITS, stock PPO with the episode buffer, zips, and evaluation on fixed sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from its_runs import SMALL, learn, make_its, snapshot
from stable_baselines3 import PPO

from sb3_uav.envs import BatchedVecEnv, Instances, TaskAllocationEnv, WorldGenerator
from sb3_uav.envs.allocation import plan_tours
from sb3_uav.envs.routing import nearest_feasible
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import EpisodeRolloutBuffer, FixedSetEvalCallback

WHOLE: dict[str, Any] = dict(SMALL, preset="whole")
WORLD = WorldGenerator(n_tasks=12, n_uavs=3, min_tasks=8, whole_share=1.0)


def make_env(n_envs: int = 8) -> BatchedVecEnv:
    return BatchedVecEnv([lambda: TaskAllocationEnv(generator=WORLD, task_order="sweep")] * n_envs)


def make_allocator(**kwargs: Any) -> REINFORCE:
    settings: dict[str, Any] = dict(n_samples=4, baseline="shared", learning_rate=1e-2, seed=0, device="cpu")
    return REINFORCE(AllocatorPolicy, make_env(), policy_kwargs=WHOLE, **{**settings, **kwargs})


def test_its_trains_both_levels_and_the_zip_comes_back(tmp_path: Path) -> None:
    its = make_its(
        dict(algo="reinforce", policy_kwargs=WHOLE),
        n_epochs=2,
        n_pretraining_epochs=1,
        n_intensive_epochs=2,
        n_continuous_epochs=1,
    )
    fixed = FixedSetEvalCallback(sizes=[[2, 9, 4], [3, 9, 4, "world"]], n_samples=2, save_path=str(tmp_path))
    model = make_allocator(instances_per_epoch=16)
    before = snapshot(model.policy)
    learn(model, its, fixed)
    assert its.router is not None
    assert any(not th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    assert all(
        value.isfinite().all() for policy in (model.policy, its.router.policy) for value in policy.state_dict().values()
    )
    assert list(fixed.sets.sets) == ["U2-N9", "U3-N9-world"]  # type: ignore[union-attr]
    assert not fixed.sets.sets["U3-N9-world"].is_plain  # type: ignore[union-attr]
    assert np.isfinite(fixed.last_mean_reward)
    model.save(tmp_path / "world.zip")
    loaded = REINFORCE.load(tmp_path / "world.zip", device="cpu")
    instances = WORLD(3, np.random.default_rng(0))
    for policy in (model.policy, loaded.policy):
        assert isinstance(policy, AllocatorPolicy)
    assert th.equal(model.policy.decode_episodes(instances), loaded.policy.decode_episodes(instances))  # type: ignore[operator]


def test_stock_ppo_with_the_episode_buffer() -> None:
    model = PPO(
        AllocatorPolicy,  # type: ignore[arg-type]
        make_env(),
        n_steps=12,
        batch_size=48,
        n_epochs=1,
        policy_kwargs=WHOLE,
        rollout_buffer_class=EpisodeRolloutBuffer,
        device="cpu",
    )
    assert {"uav_start", "uav_end", "uav_distance", "service"} <= set(model.rollout_buffer.static_keys)  # type: ignore[attr-defined]
    model.learn(96)
    assert all(value.isfinite().all() for value in model.policy.state_dict().values())


def test_an_allocator_learns_which_uav_serves_what() -> None:
    """UAVs at both ends of a strip, tasks beside them, one range barely enough: random allocations serve about half."""
    rng = np.random.default_rng(0)
    n, n_tasks = 64, 8
    ends = np.tile([[[0.0, 0.0], [1.0, 0.0]]], (n, 1, 1))
    side = rng.integers(2, size=(n, n_tasks))
    tasks = np.stack([side + 0.1 * rng.standard_normal((n, n_tasks)), 0.1 * rng.standard_normal((n, n_tasks))], axis=-1)
    instances = Instances.from_arrays(
        np.full((n, 2), 0.5), tasks, max_distance=rng.uniform(1.9, 2.1, (n, 2)), n_uavs=2, start=ends, end=ends
    )
    env = BatchedVecEnv([lambda: TaskAllocationEnv(instances=instances)] * 16)
    model = REINFORCE(
        AllocatorPolicy, env, n_samples=8, baseline="shared", learning_rate=1e-2, seed=0, device="cpu", policy_kwargs=WHOLE
    )

    def value(policy: Any, deterministic: bool) -> float:
        shown = policy.arrange(instances)
        actions = policy.decode_episodes(shown, deterministic=deterministic, generator=th.Generator().manual_seed(0))
        return float(plan_tours(shown, actions, nearest_feasible).value.mean())

    policy: Any = model.policy
    with th.no_grad():
        # What it knows before any training.
        policy.features_extractor.scorer.direct.weight.zero_()
    before = value(policy, False)
    model.learn(16 * 8 * n_tasks * 30)
    assert before < 0.85 * n_tasks
    assert value(policy, True) > 0.95 * n_tasks


def test_the_entry_of_the_zoo_exists() -> None:
    env = gym.make("TaskAllocation-World-v0")
    assert "uav_start" in env.observation_space.spaces  # type: ignore[attr-defined]


@pytest.mark.parametrize("size", [[2, 9, 4, "nowhere"], [2, 9, 4, "world", 1]])
def test_distributions_of_sizes_are_checked(size: list[Any]) -> None:
    with pytest.raises(ValueError, match=r"distribution is 'nowhere'|sizes: .* and may name a distribution"):
        FixedSetEvalCallback(sizes=[size])

"""``BatchedVecEnv`` with SB3: monitors, wrappers, evaluation and training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import random_legal
from env_helpers import (
    assert_same_arrays,
    batched_env,
    both_levels,
    env_fns,
    legal_actions,
    reset,
)
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.results_plotter import X_TIMESTEPS, ts2xy
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

from sb3_uav.envs import (
    BatchedVecEnv,
)


def run_random(env: VecEnv, n_steps: int) -> list[list[dict[str, float]]]:
    """The episode infos of each row."""
    rng = np.random.default_rng(0)
    episodes: list[list[dict[str, float]]] = [[] for _ in range(env.num_envs)]
    reset(env)
    for _ in range(n_steps):
        infos = env.step(legal_actions(env, rng))[3]
        for row, info in enumerate(infos):
            if "episode" in info:
                episodes[row].append(info["episode"])
    return episodes


@pytest.mark.parametrize("env_id", ["RoutePlanning-N20-v0", "TaskAllocation-U3-N20-v0"])
def test_monitor_file_holds_the_episodes_of_all_rows(env_id: str, tmp_path: Path) -> None:
    env = make_vec_env(
        env_id,
        n_envs=3,
        seed=0,
        monitor_dir=str(tmp_path),
        vec_env_cls=BatchedVecEnv,  # type: ignore[arg-type]
        monitor_kwargs={"info_keywords": ("objective", "illegal_actions")},
    )
    episodes = run_random(env, 70)
    env.close()
    assert [path.name for path in tmp_path.iterdir()] == ["0.monitor.csv"]
    results = load_results(str(tmp_path))
    played = [episode for row in episodes for episode in row]
    assert min(len(row) for row in episodes) >= 3 and len(results) == len(played)
    columns = ["r", "l", "objective", "illegal_actions"]
    found, expected = results[columns].values.tolist(), [[episode[column] for column in columns] for episode in played]
    assert sorted(found) == pytest.approx(np.array(sorted(expected)))
    assert results["t"].is_monotonic_increasing


def test_plots_of_monitor_files_show_the_true_time_steps(tmp_path: Path) -> None:
    """SB3's plots count the steps of all complete episodes of all rows."""
    folder = str(tmp_path)
    env = make_vec_env("RoutePlanning-N20-v0", n_envs=4, monitor_dir=folder, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
    model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=64, n_epochs=1, seed=0, policy_kwargs={"net_arch": [8]})
    model.learn(4 * 64 * 3)
    env.close()
    steps, _ = ts2xy(load_results(folder), X_TIMESTEPS)
    # The last episode of each row may be incomplete.
    assert model.num_timesteps == 768 and 768 - 4 * 20 <= steps[-1] <= 768


@both_levels
def test_vec_monitor(level: str, tmp_path: Path) -> None:
    """Counts the same returns and lengths as the environment itself."""
    inner = batched_env(level, 3, n_tasks=4)
    inner.seed(0)
    own = run_random(inner, 20)
    inner.seed(0)
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
        env = VecMonitor(inner, str(tmp_path / "all"))
    outer = run_random(env, 20)
    env.close()
    for row in range(3):
        assert [e["l"] for e in own[row]] == [e["l"] for e in outer[row]]
        assert [e["r"] for e in own[row]] == pytest.approx([e["r"] for e in outer[row]])
    assert len(load_results(str(tmp_path))) == sum(len(row) for row in own)


@both_levels
def test_vec_normalize(level: str) -> None:
    """Rewards are normalized, observations are not, and the original rewards remain available."""
    plain, inner = batched_env(level, 3, n_tasks=4), batched_env(level, 3, n_tasks=4)
    env = VecNormalize(inner, norm_obs=False)
    plain.seed(0)
    env.seed(0)
    assert_same_arrays(reset(env), reset(plain))
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = legal_actions(plain, rng)
        expected, rewards, dones, _ = plain.step(actions)
        observation, normalized, their_dones, _ = env.step(actions)
        assert_same_arrays(observation, expected)
        assert np.array_equal(env.get_original_reward(), rewards) and np.array_equal(dones, their_dones)
        assert (np.sign(normalized) == np.sign(rewards)).all()
    assert np.isfinite(normalized).all() and env.ret_rms.var > 0


class RandomPolicy:
    """Takes any legal action in the observation."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        return random_legal(th.from_numpy(observation["action_mask"].astype(bool)), self.rng).numpy(), None


@both_levels
def test_evaluate_policy(level: str) -> None:
    """SB3's evaluation gives the same episodes on our VecEnv and on SB3's, and no illegal action."""
    fns = env_fns(level, 2, n_tasks=5)
    results, illegal = [], []

    def look(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
        illegal.append(local_variables["info"]["illegal_actions"])

    for env in (BatchedVecEnv(fns), DummyVecEnv(fns)):
        env.seed(3)
        rewards, lengths = evaluate_policy(RandomPolicy(), env, 7, return_episode_rewards=True, callback=look)
        assert isinstance(rewards, list) and isinstance(lengths, list)
        results.append((rewards, lengths))
        assert len(rewards) == 7 and 0 <= min(rewards) <= max(rewards) <= 5 and 1 <= min(lengths) <= max(lengths) <= 6
    assert results[0] == results[1]
    assert len(illegal) > 0 and set(illegal) == {0}


@both_levels
def test_stock_ppo_learns_the_same(level: str) -> None:
    """SB3's PPO with SB3's policy: a few updates on our VecEnv and on SB3's end with equal parameters."""
    models = []
    for vec_env_cls in (BatchedVecEnv, DummyVecEnv):
        env = vec_env_cls(env_fns(level, 4, n_tasks=5))
        model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=16, n_epochs=1, seed=0, policy_kwargs={"net_arch": [8]})
        before = {name: parameter.clone() for name, parameter in model.policy.state_dict().items()}
        model.learn(64)
        assert model.num_timesteps == 64 and len(model.ep_info_buffer) > 0  # type: ignore[arg-type]
        assert any(not th.equal(before[name], parameter) for name, parameter in model.policy.state_dict().items())
        models.append(model)
    ours, theirs = (model.policy.state_dict() for model in models)
    assert all(th.equal(ours[name], theirs[name]) for name in ours)

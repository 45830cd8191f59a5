"""SB3's monitor files under REINFORCE, which plays whole episodes without stepping the environment."""

import math
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.wrappers import RecordEpisodeStatistics
from reinforce_models import make_env, make_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.results_plotter import X_TIMESTEPS, ts2xy
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv

KINDS = ("DummyVecEnv", "BatchedVecEnv", "VecMonitor", "VecMonitor inside", "Monitor inside")
N_ENVS, N_SAMPLES, N_UPDATES = 4, 3, 5


def monitored_env(kind: str, level: str, folder: str) -> Any:
    def make() -> gym.Env:
        return TaskAllocationEnv(6, 2, max_distance=1.2) if level == "allocator" else RoutePlanningEnv(6, max_distance=1.2)

    if kind == "DummyVecEnv":
        return make_vec_env(make, N_ENVS, monitor_dir=folder)
    if kind == "BatchedVecEnv":
        return make_vec_env(make, N_ENVS, monitor_dir=folder, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
    if kind == "Monitor inside":
        return make_vec_env(make, N_ENVS, monitor_dir=folder, wrapper_class=RecordEpisodeStatistics)
    env = VecMonitor(DummyVecEnv([make] * N_ENVS), f"{folder}/all")
    return VecCheckNan(env) if kind == "VecMonitor inside" else env


class Reported(BaseCallback):
    """The episodes that callbacks see."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes: list[tuple[float, int]] = []

    def _on_step(self) -> bool:
        found = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(episode["r"], episode["l"]) for episode in found]
        return True


@pytest.mark.parametrize("level", ["allocator", "router"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_episode_has_a_row_and_the_lengths_add_up_to_the_time_steps(kind, level, tmp_path):
    env = monitored_env(kind, level, str(tmp_path))
    reported = Reported()
    model = make_model(level, env=env, n_samples=N_SAMPLES).learn_instances(N_ENVS * N_UPDATES, reported)
    env.close()
    rows = load_results(str(tmp_path))
    assert len(rows) == N_ENVS * N_SAMPLES * N_UPDATES
    assert sorted(zip(rows["r"], rows["l"], strict=True)) == sorted(reported.episodes)
    # SB3 counts n_envs steps at a time.
    assert model.num_timesteps == N_ENVS * math.ceil(rows["l"].sum() / N_ENVS)
    steps, _ = ts2xy(rows, X_TIMESTEPS)
    assert steps[-1] == rows["l"].sum()
    assert rows["t"].min() >= 0


def test_rows_of_a_dummy_vec_env_log_their_own_episodes(tmp_path):
    env = monitored_env("DummyVecEnv", "router", str(tmp_path))
    model = make_model("router", env=env, n_samples=N_SAMPLES).learn_instances(N_ENVS * N_UPDATES)
    monitors = [row for row in env.envs if isinstance(row, Monitor)]
    assert len(monitors) == N_ENVS
    for monitor in monitors:
        assert len(monitor.get_episode_rewards()) == len(monitor.get_episode_times()) == N_SAMPLES * N_UPDATES
        assert monitor.get_total_steps() == sum(monitor.get_episode_lengths())
    env.close()
    for row in range(N_ENVS):
        lines = (tmp_path / f"{row}.monitor.csv").read_text().splitlines()
        assert len(lines) == 2 + N_SAMPLES * N_UPDATES
    assert 0 <= model.num_timesteps - sum(monitor.get_total_steps() for monitor in monitors) < N_ENVS


@pytest.mark.parametrize("kind", ["DummyVecEnv", "BatchedVecEnv", "VecMonitor"])
def test_rows_hold_the_info_keywords(kind, tmp_path):
    keywords = ("objective", "illegal_actions")

    def make() -> gym.Env:
        return RoutePlanningEnv(6, max_distance=1.2)

    if kind == "VecMonitor":
        env: Any = VecMonitor(DummyVecEnv([make] * 2), f"{tmp_path}/all", info_keywords=keywords)
    else:
        chosen = BatchedVecEnv if kind == "BatchedVecEnv" else DummyVecEnv
        kwargs: dict[str, Any] = dict(info_keywords=keywords)
        env = make_vec_env(make, 2, monitor_dir=str(tmp_path), vec_env_cls=chosen, monitor_kwargs=kwargs)  # type: ignore[arg-type]
    make_model("router", env=env).learn_instances(2)
    env.close()
    rows = load_results(str(tmp_path))
    assert len(rows) == 6
    assert (rows["objective"] == rows["r"]).all() and (rows["illegal_actions"] == 0).all()


def test_batched_env_finds_a_monitor_behind_a_harmless_wrapper(tmp_path):
    def make() -> gym.Env:
        return RecordEpisodeStatistics(Monitor(RoutePlanningEnv(6, max_distance=1.2), str(tmp_path / "0")))

    env = BatchedVecEnv([make] * 2)
    make_model("router", env=env).learn_instances(2)
    env.close()
    assert len(load_results(str(tmp_path))) == 6


def test_environments_without_monitor_files_need_none():
    for env in (make_env("router"), DummyVecEnv([lambda: RoutePlanningEnv(6)] * 2), VecMonitor(make_env("router"))):
        assert make_model("router", env=env).learn_instances(4).n_batches > 0


def test_time_steps_of_a_resumed_run_continue(tmp_path):
    """How far num_timesteps is ahead of the episodes is part of the zip."""
    unbroken = make_model("router").learn_instances(40)
    broken = make_model("router").learn_instances(20)
    broken.save(tmp_path / "model")
    resumed = type(broken).load(tmp_path / "model", env=make_env("router")).learn_instances(20)
    assert (resumed.num_timesteps, resumed.steps_ahead) == (unbroken.num_timesteps, unbroken.steps_ahead)

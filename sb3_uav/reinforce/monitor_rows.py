"""Writes rows to SB3's monitor files for episodes that are played without stepping the environment."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_uav.envs.vec_env import BatchedVecEnv, find_monitor


def log_episodes(env: VecEnv, infos: Sequence[dict[str, Any]]) -> None:
    """
    Write a row per episode to the monitor files of an environment.

    :param env: The environment
    :param infos: The final ``info`` of each episode, with its statistics under ``"episode"``; episode ``i`` belongs to row
        ``i`` of the environment, modulo the number of rows
    """
    inner = env
    while isinstance(inner, VecEnvWrapper):
        if isinstance(inner, VecMonitor):
            inner.episode_count += len(infos)
            if inner.results_writer is not None:
                for info in infos:
                    inner.results_writer.write_row(_row(info, inner.t_start, inner.info_keywords))
        inner = inner.venv
    if isinstance(inner, BatchedVecEnv):
        for info in infos:
            statistics = inner.episode_info(info["episode"]["r"], info["episode"]["l"])
            inner.log_episode(statistics | _extra(info, inner.info_keywords))
    elif isinstance(inner, DummyVecEnv):
        for i, info in enumerate(infos):
            _log_in_row(inner.envs[i % inner.num_envs], info)


def _log_in_row(env: Any, info: dict[str, Any]) -> None:
    """Record an episode in the ``Monitor`` around a single environment, if there is one."""
    monitor = find_monitor(env)
    if monitor is None:
        return
    monitor.episode_returns.append(info["episode"]["r"])
    monitor.episode_lengths.append(info["episode"]["l"])
    monitor.episode_times.append(time.time() - monitor.t_start)
    monitor.total_steps += info["episode"]["l"]
    if monitor.results_writer is not None:
        monitor.results_writer.write_row(_row(info, monitor.t_start, monitor.info_keywords) | monitor.current_reset_info)


def _row(info: dict[str, Any], start: float, keywords: Iterable[str]) -> dict[str, Any]:
    episode = info["episode"]
    row = {"r": round(episode["r"], 6), "l": episode["l"], "t": round(time.time() - start, 6)}
    return row | _extra(info, keywords)


def _extra(info: dict[str, Any], keywords: Iterable[str]) -> dict[str, Any]:
    return {key: info[key] for key in keywords}

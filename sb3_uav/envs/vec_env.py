"""``BatchedVecEnv``: one SB3 ``VecEnv`` that steps thousands of instances in lock step."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_uav.envs.episodes import Episodes, given_instance
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem, Stage

# Wrappers that change nothing; BatchedVecEnv keeps the episode statistics itself.
_TRANSPARENT_WRAPPERS = (Monitor, OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics)
# By name, because importing rl_zoo3 puts its own class in the place of Gymnasium's:
# https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/gym_patches.py
_TIME_LIMITS = ("gymnasium.wrappers.common.TimeLimit", "rl_zoo3.gym_patches.PatchedTimeLimit")


def strip_wrappers(env: gym.Env) -> gym.Env:
    """
    :param env: An environment
    :return: What is left without the wrappers around it that change nothing, among them a time limit that no episode reaches
    """
    inner: Any = env
    # Only exact types: a subclass may behave differently.
    while type(inner) in _TRANSPARENT_WRAPPERS or _is_loose_limit(inner):
        inner = inner.env
    return inner


def find_monitor(env: gym.Env) -> Monitor | None:
    """
    :param env: An environment
    :return: The outermost ``Monitor`` around it
    """
    inner: Any = env
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, Monitor):
            return inner
        inner = inner.env
    return None


def _is_loose_limit(env: gym.Env) -> bool:
    """Whether this is a time limit that no episode inside reaches; False if there is no telling."""
    if not isinstance(env, gym.Wrapper) or f"{type(env).__module__}.{type(env).__qualname__}" not in _TIME_LIMITS:
        return False
    n_steps = None if env.spec is None else env.spec.max_episode_steps
    inner = env.unwrapped
    # The router's tours visit every task and the depot at most; the allocator takes one step fewer.
    return n_steps is not None and isinstance(inner, ProblemEnv) and n_steps >= inner.problem.generator.n_tasks + 1


def unwrap_problem_env(env: gym.Env) -> ProblemEnv | None:
    """
    :param env: An environment
    :return: The :class:`ProblemEnv` inside, or None if there is none or a wrapper changes its behavior
    """
    inner = strip_wrappers(env)
    if not isinstance(inner, ProblemEnv):
        return None
    # Only ProblemEnv's own methods: a subclass may behave differently.
    inherits = type(inner).step is ProblemEnv.step and type(inner).reset is ProblemEnv.reset
    return inner if inherits else None


class BatchedVecEnv(VecEnv):
    """
    A drop-in for ``DummyVecEnv`` that steps all its episodes with one batched tensor operation.

    With the same seed, it plays exactly the episodes of a ``DummyVecEnv``. Only the first of the ``env_fns`` is called: it
    defines the problem, and its ``Monitor``, if it has a file, logs the episodes of all rows, as ``VecMonitor`` does. The
    statistics of an episode are in ``infos[i]["episode"]``, as with ``Monitor``.

    :param env_fns: Functions that make the environment, as for ``DummyVecEnv``; one per row
    :raises ValueError: If the functions do not make an environment of this package, or wrap it in something that changes it
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]]) -> None:
        env = env_fns[0]()
        problem_env = unwrap_problem_env(env)
        if problem_env is None:
            raise ValueError(f"BatchedVecEnv cannot batch {env}; use stable_baselines3's DummyVecEnv for it.")
        self.template = problem_env
        self.problem: Problem = problem_env.problem
        self._monitor = find_monitor(env)
        self._info_keywords: tuple[str, ...] = () if self._monitor is None else self._monitor.info_keywords
        self._windows: dict[int, Any] = {}
        # Instance and routes of the episodes that ended in the last step, for rendering.
        self._ended: dict[int, tuple[Instances, list[list[int]]]] = {}
        self.episodes = Episodes(self.problem, len(env_fns))
        self._start_time = time.perf_counter()
        self._actions = np.zeros(len(env_fns), dtype=np.int64)
        super().__init__(len(env_fns), problem_env.observation_space, problem_env.action_space)
        self._episode_returns = np.zeros(self.num_envs)
        self._episode_lengths = np.zeros(self.num_envs, dtype=np.int64)
        self._n_illegal = np.zeros(self.num_envs, dtype=np.int64)

    def reset(self) -> VecEnvObs:
        given = {}
        for row, (seed, options) in enumerate(zip(self._seeds, self._options, strict=True)):
            if seed is not None:
                self.episodes.seed(row, seed)
            instance = given_instance(options)
            if instance is not None:
                given[row] = instance
        self.episodes.reset(given=given)
        self._ended.clear()
        for counter in (self._episode_returns, self._episode_lengths, self._n_illegal):
            counter[:] = 0
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return self.episodes.observation()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        result = self.episodes.step(self._actions)
        self._ended.clear()
        self._episode_returns += result.rewards
        self._episode_lengths += 1
        self._n_illegal += result.illegal
        infos: list[dict[str, Any]] = [{"illegal_actions": n} for n in self._n_illegal.tolist()]
        finished = result.dones.nonzero()[0]
        observation = result.observation
        if len(finished) > 0:
            returns = th.from_numpy(self._episode_returns[finished])[:, None]
            successes = self.problem.successes(self.episodes.instances[finished], returns)
            if self.render_mode is not None:
                self._ended = {row: (self.episodes.instances[row], self.episodes.routes(row)) for row in finished.tolist()}
            for number, row in enumerate(finished):
                infos[row]["terminal_observation"] = {key: value[row] for key, value in observation.items()}
                infos[row]["TimeLimit.truncated"] = False
                infos[row]["objective"] = float(self._episode_returns[row])
                if successes is not None:
                    infos[row]["is_success"] = bool(successes[number])
                infos[row]["episode"] = self.episode_info(self._episode_returns[row], self._episode_lengths[row])
                for key in self._info_keywords:
                    infos[row]["episode"][key] = infos[row][key]
                self.log_episode(infos[row]["episode"])
            for counter in (self._episode_returns, self._episode_lengths, self._n_illegal):
                counter[finished] = 0
            self.episodes.reset(finished)
            observation = self.episodes.observation()
        return observation, result.rewards.astype(np.float32), result.dones.copy(), infos

    def episode_info(self, episode_return: float, length: int) -> dict[str, float]:
        """Episode statistics in the form of SB3's ``Monitor``."""
        elapsed = round(time.perf_counter() - self._start_time, 6)
        return {"r": round(float(episode_return), 6), "l": int(length), "t": elapsed}

    def log_episode(self, episode_info: dict[str, float]) -> None:
        """
        Write a line to the monitor file, if there is one.

        All rows write to the same file, so that SB3's ``load_results`` and ``plot_results`` count all time steps.

        :param episode_info: The result of :meth:`episode_info`, and the info keywords of the ``Monitor``
        """
        if self._monitor is not None and self._monitor.results_writer is not None:
            self._monitor.results_writer.write_row(episode_info)

    @property
    def monitor_folder(self) -> str | None:
        """Folder of the monitor file, if there is one."""
        if self._monitor is None or self._monitor.results_writer is None:
            return None
        return os.path.dirname(self._monitor.results_writer.file_handler.name)

    @property
    def info_keywords(self) -> tuple[str, ...]:
        """What the monitor file holds of an episode besides its return, length and time."""
        return self._info_keywords

    def action_masks(self) -> np.ndarray:
        """``(n_envs, n_actions)`` bool, True where an action is legal."""
        return self.episodes.action_masks()

    def set_generator(self, generator: Any) -> None:
        """Draw the instances of the next episodes from another source of the same size."""
        self.problem.set_generator(generator)

    def close(self) -> None:
        if self._monitor is not None:
            self._monitor.close()
        self.template.close()
        for window in self._windows.values():
            window.close()
        self._windows.clear()

    def get_images(self) -> Sequence[np.ndarray | None]:
        if self.render_mode != "rgb_array":
            return [None for _ in range(self.num_envs)]
        return self._images(range(self.num_envs))

    def _images(self, rows: Iterable[int]) -> list[np.ndarray]:
        from sb3_uav.envs.render import MapFigure

        figure = MapFigure()
        images = []
        for row in rows:
            self._draw(figure, row)
            images.append(figure.rgb_array())
        return images

    def _draw(self, figure: Any, row: int) -> None:
        """The episode that has just ended, rather than the new one, whose beginning shows little."""
        if row in self._ended:
            figure.draw_routes(*self._ended[row], Stage.FINISHED)
        else:
            figure.draw(self.episodes, row)

    def _show(self, rows: Iterable[int]) -> None:
        from sb3_uav.envs.render import MapFigure

        for row in rows:
            if row not in self._windows:
                self._windows[row] = MapFigure(interactive=True)
            self._draw(self._windows[row], row)
            self._windows[row].show()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of the shared environment, once per row; ``instance`` differs between rows."""
        rows = self._get_indices(indices)
        if attr_name == "instance":
            return [self.episodes.instances[row] for row in rows]
        return [getattr(self.template, attr_name) for _ in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of the shared environment.

        :raises ValueError: If only some rows are given, because all rows share the environment
        """
        self._require_all_rows(indices, f"set {attr_name}")
        setattr(self.template, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of every row's environment; ``action_masks`` and ``render`` return results for each row.

        :raises ValueError: If only some rows are given for a method of the shared environment
        """
        rows = list(self._get_indices(indices))
        if method_name == "action_masks":
            masks = self.action_masks()
            return [masks[row] for row in rows]
        if method_name == "render" and self.render_mode == "human":
            self._show(rows)
            return [None for _ in rows]
        if method_name == "render":
            return list(self._images(rows))
        if method_name in ("reset", "step"):
            raise ValueError(f"The rows of a BatchedVecEnv share one environment; call its own {method_name}() instead.")
        self._require_all_rows(indices, f"call {method_name}")
        result = getattr(self.template, method_name)(*method_args, **method_kwargs)
        return [result for _ in rows]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """True for ``Monitor``, whose statistics this class provides; the constructor refuses other wrappers."""
        return [issubclass(Monitor, wrapper_class) for _ in self._get_indices(indices)]

    def _require_all_rows(self, indices: VecEnvIndices, action: str) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(f"Cannot {action} for rows {indices} alone: the rows of a BatchedVecEnv share one environment.")

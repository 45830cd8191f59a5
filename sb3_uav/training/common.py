"""What the callbacks share: each other, the folder of their run, and files that are whole at any moment."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.logger import HumanOutputFormat
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_uav.envs.routing import Router
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce.reinforce import find_problem

CallbackT = TypeVar("CallbackT", bound=BaseCallback)


def walk_callbacks(callback: Any) -> Iterator[BaseCallback]:
    """
    :param callback: A callback or None
    :return: It and all callbacks inside it
    """
    if isinstance(callback, CallbackList):
        for child in callback.callbacks:
            yield from walk_callbacks(child)
    elif isinstance(callback, BaseCallback):
        yield callback
        if isinstance(callback, EventCallback):
            yield from walk_callbacks(callback.callback)


def siblings(callback: BaseCallback, kind: type[CallbackT]) -> list[CallbackT]:
    """
    :param callback: A callback whose training has started
    :param kind: A class
    :return: The other callbacks of this class in the same training
    """
    found = walk_callbacks(callback.locals.get("callback"))
    return [other for other in found if isinstance(other, kind) and other is not callback]


def find_run_folder(callback: BaseCallback) -> Path | None:
    """
    Where the files of a run belong: the folder of its ``EvalCallback``, else that of its monitor files, else of its logger.

    The first two are the run folder of rl_zoo3, the third is what plain SB3 users give to ``logger.configure``.

    :param callback: A callback whose training has started
    :return: The folder; None if there is none
    """
    for evaluation in siblings(callback, EvalCallback):
        if evaluation.best_model_save_path is not None:
            return Path(evaluation.best_model_save_path)
        if evaluation.log_path is not None:
            return Path(evaluation.log_path).parent
    monitor = monitor_folder(callback.training_env.unwrapped)
    if monitor is not None:
        return monitor
    # Without output files, SB3's logger names a temporary folder, where nobody would look for zips.
    logger = callback.logger
    if logger.dir and any(not isinstance(output, HumanOutputFormat) for output in logger.output_formats):
        return Path(logger.dir)
    return None


def monitor_folder(env: VecEnv) -> Path | None:
    """
    :param env: A vectorized environment without wrappers around it
    :return: Where the ``Monitor`` of its first row writes, if it does
    """
    if isinstance(env, BatchedVecEnv):
        return None if env.monitor_folder is None else Path(env.monitor_folder)
    if isinstance(env, DummyVecEnv) and env.has_attr("results_writer"):
        writer = env.get_attr("results_writer", 0)[0]
        return None if writer is None else Path(writer.file_handler.name).parent
    return None


def hand_over_router(callback: BaseCallback, router: Router) -> None:
    """
    Let rewards come from this router, in training and in SB3's evaluation, and tasks in the order that the allocator wants.

    :param callback: A callback of the allocator's training, which has started
    :param router: The router
    """
    model, problem = callback.model, find_problem(callback.training_env)
    shown = getattr(problem, "task_order", None)
    for env in (callback.training_env, *(evaluation.eval_env for evaluation in siblings(callback, EvalCallback))):
        env.env_method("set_router", router)
        if isinstance(model.policy, AllocatorPolicy):
            env.env_method("set_task_order", model.policy.env_order)
    if getattr(problem, "task_order", None) != shown and isinstance(model, OnPolicyAlgorithm):
        # SB3 has reset the environment already, and its first episodes have the tasks in another order.
        model._last_obs = callback.training_env.reset()  # type: ignore[assignment]
        model._last_episode_starts = np.ones(model.n_envs, dtype=bool)


@contextmanager
def undisturbed_random_state() -> Iterator[None]:
    """Undo what happens to the global generators inside, such as the seeding by an algorithm's constructor."""
    states = random.getstate(), np.random.get_state()
    with th.random.fork_rng():
        yield
    random.setstate(states[0])
    np.random.set_state(states[1])

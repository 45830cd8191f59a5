"""Where the files of a run belong."""

from __future__ import annotations

import warnings
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import HumanOutputFormat
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_uav.common import distributed
from sb3_uav.common.callback_tree import siblings
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.training.best_pair import best_model_folder


def find_run_folder(callback: BaseCallback) -> Path | None:
    """
    The folder of the ``EvalCallback`` of a run, else that of its monitor files, else that of its logger.

    The first two are the run folder of rl_zoo3, the third is what plain SB3 users give to ``logger.configure``.

    :param callback: A callback whose training has started
    :return: The folder; None if there is none
    """
    for evaluation in siblings(callback, EvalCallback):
        best = best_model_folder(evaluation)
        if best is not None:
            return best
        if evaluation.log_path is not None:
            return Path(evaluation.log_path).parent
    monitor = _monitor_folder(callback.training_env.unwrapped)
    if monitor is not None:
        return monitor
    # Without output files, SB3's logger has a temporary folder, which is no place for zips.
    logger = callback.logger
    if logger.dir and any(not isinstance(output, HumanOutputFormat) for output in logger.output_formats):
        return Path(logger.dir)
    return None


def folder_for_router(callback: BaseCallback) -> Path | None:
    """
    :param callback: An ``ITSCallback`` whose training has started, in all processes
    :return: The folder of the run, as :func:`find_run_folder` finds it in the first of several processes; with a warning if
        there is none
    """
    folder = distributed.on_main(lambda: find_run_folder(callback))
    if folder is None:
        warnings.warn(f"{type(callback).__name__} saves no router: set save_path to a folder.", stacklevel=4)
    return folder


def _monitor_folder(env: VecEnv) -> Path | None:
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

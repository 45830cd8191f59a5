"""What the processes of a data-parallel training agree upon before they begin, and which callbacks each of them has."""

from __future__ import annotations

import itertools
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_uav.common import distributed
from sb3_uav.common.random_streams import PartGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.reinforce.drivers import why_step_loop

# Name of a class attribute of callbacks that evaluate, write or report, and so belong to rank 0.
MAIN_ONLY = "only_on_main_rank"
_STOCK = (EvalCallback, CheckpointCallback, ProgressBarCallback)


def begin_together(model: Any, callback: MaybeCallback, progress_bar: bool) -> tuple[MaybeCallback, bool]:
    """
    Let all processes begin with the parameters and the streams of rank 0, and only rank 0 evaluate, write and report.

    :param model: A REINFORCE algorithm
    :param callback: The callbacks of its training
    :param progress_bar: Whether it shows its progress
    :return: Those of this process
    :raises ValueError: If the training cannot be shared, or the processes have come differently far
    """
    if distributed.world_size() == 1:
        return callback, progress_bar
    if model.problem is None:
        raise ValueError(
            f"Several processes can only share whole episodes, but {why_step_loop(model.policy_class, model.env)}; train in a "
            "single process."
        )
    progress = {name: getattr(model, name) for name in ("n_envs", "n_samples", "n_batches", "n_instances", "epoch")}
    distributed.require_equal("settings or progress", {**progress, "instances_per_epoch": model.instances_per_epoch})
    model.stream_seed = distributed.broadcast(model.stream_seed)
    modules = [module for module in (model.policy, model.baseline_policy) if module is not None]
    distributed.share_tensors(itertools.chain(*((*module.parameters(), *module.buffers()) for module in modules)))
    if distributed.is_main():
        return callback, progress_bar
    model.set_logger(Logger(None, []))
    return _without_reports(callback), False


def part_of_batch(model: Any) -> tuple[Instances, int, th.Generator]:
    """
    :param model: A REINFORCE algorithm
    :return: The instances of the next update that this process plays, their number in all processes, and the generator of
        their actions
    """
    instances, generator = model.draw_batch(model.n_batches), model.action_generator(model.n_batches)
    n_instances = len(instances)
    if distributed.world_size() == 1:
        return instances.to(model.device), n_instances, generator
    rows = distributed.shard(n_instances)
    return instances[rows].to(model.device), n_instances, PartGenerator.of(generator, rows, n_instances)


def require_shareable(model: Any) -> None:
    """
    :param model: An algorithm
    :raises ValueError: If there are several processes, which can share the training of REINFORCE only
    """
    if distributed.world_size() > 1 and not hasattr(model, "n_batches"):
        raise ValueError(
            f"Several processes can only share the training of REINFORCE, found {type(model).__name__}; train it in a single "
            "process, or set --algo reinforce."
        )


def _without_reports(callback: Any) -> Any:
    """:return: The callbacks but those that evaluate, write or report"""
    if isinstance(callback, CallbackList):
        return _without_reports(list(callback.callbacks))
    if isinstance(callback, list):
        return [_without_reports(child) for child in callback if not _reports(child)]
    return None if _reports(callback) else callback


def _reports(callback: Any) -> bool:
    return isinstance(callback, BaseCallback) and (isinstance(callback, _STOCK) or getattr(callback, MAIN_ONLY, False))

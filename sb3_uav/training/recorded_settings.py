"""The settings of a training, for TensorBoard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_uav.common.tensorboard import hyperparameters, record_hyperparameters
from sb3_uav.policies import EpisodicPolicy
from sb3_uav.training.its import ITSCallback


def record_settings(model: BaseAlgorithm, policy: EpisodicPolicy, its: ITSCallback | None, metrics: Sequence[str]) -> None:
    """
    :param model: The algorithm, whose logger gets the settings
    :param policy: Its policy
    :param its: The strategy that trains its router, if there is one
    :param metrics: Names of the curves to compare runs by
    """
    settings = hyperparameters(model)
    settings["preset"] = (model.policy_kwargs or {}).get("preset", "default")
    settings["network"] = asdict(policy.settings)
    if its is not None:
        settings["its"] = {"strategy": its.strategy, **asdict(its.schedule)}
        settings["its"]["warm_start"] = {} if its.warm_start is None else its.warm_start.arguments
        network: Any = its.router.policy
        settings["router"] = {**hyperparameters(its.router), "network": asdict(network.settings)}
    record_hyperparameters(model.logger, settings, metrics)

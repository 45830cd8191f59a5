"""REINFORCE's two drivers: why the fused one cannot be used, and which settings have no effect."""

from __future__ import annotations

import warnings
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_uav.policies import EpisodicPolicy, MaskedAttentionPolicy
from sb3_uav.reinforce.recognition import why_unrecognized

# Settings of REINFORCE that only one of the drivers uses, with their defaults.
_FUSED_SETTINGS: dict[str, Any] = {"n_samples": 1, "instances_per_epoch": 1_280_000, "lr_decay": 1.0, "micro_batch_size": None}
_STEP_LOOP_SETTINGS: dict[str, Any] = {"n_steps": 512, "gamma": 1.0}


def why_step_loop(policy_class: type, env: VecEnv | None) -> str:
    """
    :param policy_class: The class of the algorithm's policy
    :param env: The environment of the algorithm
    :return: The reason why the fused driver cannot be used, a clause without a period
    """
    if issubclass(policy_class, MaskedAttentionPolicy):
        return f"{policy_class.__name__} is for environments that can only be stepped"
    if not issubclass(policy_class, EpisodicPolicy):
        return f"{policy_class.__name__} is not a policy of sb3_uav"
    return "no environment is set" if env is None else why_unrecognized(env)


def warn_of_ignored_settings(model: Any) -> None:
    """
    Warn if a setting that differs from its default has no effect.

    :param model: A REINFORCE algorithm
    """
    fused = model.problem is not None
    settings = _STEP_LOOP_SETTINGS if fused else _FUSED_SETTINGS
    ignored = [f"{name}={getattr(model, name)!r}" for name, default in settings.items() if getattr(model, name) != default]
    if ignored:
        cause = "it plays whole episodes, undiscounted" if fused else why_step_loop(model.policy_class, model.env)
        loop = "" if fused else ", which leaves only SB3's step loop"
        warnings.warn(f"{type(model).__name__} ignores {', '.join(ignored)} here: {cause}{loop}.", stacklevel=3)

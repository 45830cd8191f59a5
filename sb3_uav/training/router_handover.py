"""Handing a router to the environments of an allocator's training."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.sb3_compat import set_last_observation
from sb3_uav.envs.routing import Router
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce.recognition import find_problem


def hand_over_router(callback: BaseCallback, router: Router) -> None:
    """
    Let rewards come from this router, in training and in SB3's evaluation, and show tasks in the allocator's order.

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
        observation: Any = callback.training_env.reset()
        set_last_observation(model, observation)

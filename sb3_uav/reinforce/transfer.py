"""Our policies in another algorithm, on an environment of another size: fine-tuning a zip, whoever wrote it."""

from __future__ import annotations

import os
from typing import Any

from gymnasium import Env
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_uav.policies import AllocatorPolicy
from sb3_uav.policies.loading import StoredPolicy, misfit, read_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.algorithms import resolve_algorithm
from sb3_uav.reinforce.any_size import environment_name, fits, own_spaces, problem_of_spaces

__all__ = ["fine_tuning_settings", "load", "own_spaces", "require_fit"]

# A tenth of the learning rate of the shipped pair's own training, whose end this is near.
_LEARNING_RATE = 1e-4
# Steps between two updates of a router's environment: two or three tours.
_ROUTER_STEPS = 40
_MAX_MINIBATCHES = 4


def load(
    path: str | os.PathLike[str],
    env: GymEnv | str,
    algorithm: str | type[OnPolicyAlgorithm] = "reinforce",
    policy_kwargs: dict[str, Any] | None = None,
    **kwargs: Any,
) -> Any:
    """
    Start a new training with the weights of a zip: of any of our policies, saved by any SB3 algorithm, on an environment of
    any size, in the same or another algorithm.

    Only the weights and ``policy_kwargs`` come from the zip, and nothing in it is unpickled, so that a zip from a stranger is
    safe to use. The algorithm's settings are new, its counters start from 0 and its optimizer is fresh; to continue a training
    with its settings instead, use the algorithm's own ``load`` (that of ``REINFORCE`` takes any size too, others with
    ``custom_objects=``:func:`~sb3_uav.reinforce.any_size.own_spaces` ``(path, env)``). The environment presents its tasks in
    the order that the allocator expects, from its next reset on.

    A critic that was never trained comes as it is: ``REINFORCE`` without the baseline ``critic`` leaves it at 0, so that PPO
    and A2C begin with values of 0.

    :param path: The zip; ``.zip`` is appended if there is no such file
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param algorithm: ``"reinforce"``, ``"ppo"``, ``"ppo_mask"``, ``"a2c"``, or the class or dotted path of another on-policy
        algorithm
    :param policy_kwargs: Arguments of the policy that replace those of the zip, such as ``mixed_precision``
    :param kwargs: Arguments of the algorithm
    :return: A new model of that algorithm
    :raises FileNotFoundError: If there is no such zip
    :raises ValueError: If the zip is damaged or holds no policy of ours, if the environment is none of ours of that level, or
        has another number of UAVs than the network is bound to, or if ``policy_kwargs`` do not fit the weights
    """
    cls = resolve_algorithm(algorithm, "algorithm") if isinstance(algorithm, str) else algorithm
    made: Any = maybe_make_env(env, 0)
    stored = require_fit(path, made)
    arguments = {**stored.policy_kwargs, **(policy_kwargs or {})}
    model: Any = cls(stored.policy_class, made, policy_kwargs=arguments, **kwargs)  # type: ignore[arg-type]
    weights = stored.parameters
    if isinstance(model, REINFORCE) and model.baseline != "critic":
        # As in a new model: its critic does not learn, and only values of 0 add nothing at time limits.
        critic = {name: value for name, value in model.policy.state_dict().items() if name.startswith("value_net.")}
        weights = {**weights, **critic}
    parameters = model.get_parameters()
    for name in parameters.keys() & {"policy", "baseline_policy"}:
        parameters[name] = weights
    try:
        model.set_parameters(parameters, device=model.device)
    except RuntimeError as error:
        raise misfit(stored, arguments, error) from error
    if isinstance(model.policy, AllocatorPolicy) and model.env.has_attr("set_task_order"):
        model.env.env_method("set_task_order", model.policy.env_order)
    return model


def require_fit(path: str | os.PathLike[str], env: Env[Any, Any] | VecEnv) -> StoredPolicy:
    """
    :param path: The zip
    :param env: An environment, vectorized or not
    :return: The policy of the zip, which serves this environment
    :raises FileNotFoundError: If there is no such zip
    :raises ValueError: As :func:`load`
    """
    stored = read_policy(path)
    if not fits(stored, env.observation_space, env.action_space):
        raise ValueError(
            f"{stored.file}: {stored.policy_class.__name__} needs a {environment_name(stored.policy_class)} environment, "
            f"found the spaces {env.observation_space!s:.200} and {env.action_space}; make one of this package, of any size."
        )
    return stored


def fine_tuning_settings(algorithm: str | type[OnPolicyAlgorithm], env: Env[Any, Any] | VecEnv) -> dict[str, Any]:
    """
    Settings to go on learning with, from a policy that was trained before. The learning rate is 1e-4 in all of them.

    - ``REINFORCE``: 8 samples per instance with their mean as the baseline, advantages normalized;
    - ``PPO`` and ``MaskablePPO``: rollouts of whole episodes of the allocator (``n_steps`` is the number of tasks) or of 40
      steps of the router, up to 4 equal minibatches and 4 epochs, no discount, ``vf_coef`` 0.05 as returns count tasks;
    - others: the same rollouts, no discount.

    :param algorithm: As of :func:`load`
    :param env: One of our environments, vectorized or not
    :return: Arguments of the algorithm
    :raises ValueError: If it is no environment of ours, or there is no such algorithm
    """
    cls = resolve_algorithm(algorithm, "algorithm") if isinstance(algorithm, str) else algorithm
    problem = problem_of_spaces(env.observation_space, env.action_space)
    if problem is None:
        raise ValueError(f"env has the spaces of no environment of this package: {env.observation_space!s:.200}.")
    if issubclass(cls, REINFORCE):
        shared = dict(n_samples=8, baseline="shared", normalize_advantage=True)
        return dict(learning_rate=_LEARNING_RATE, max_grad_norm=1.0, **shared)
    n_steps = problem.generator.n_tasks if problem.uses_fleet else _ROUTER_STEPS
    settings: dict[str, Any] = dict(learning_rate=_LEARNING_RATE, n_steps=n_steps, gamma=1.0, gae_lambda=0.98, vf_coef=0.05)
    if issubclass(cls, PPO | MaskablePPO):
        n_rows = n_steps * (env.num_envs if isinstance(env, VecEnv) else 1)
        # As many as divide a rollout into equal ones, which SB3 asks for.
        n_batches = next(n for n in range(_MAX_MINIBATCHES, 0, -1) if n_rows % n == 0)
        settings |= dict(batch_size=n_rows // n_batches, n_epochs=4)
    return settings

"""
Search spaces of ``-optimize`` for our environments, in rl_zoo3's form: a sampler, and a converter of what it drew.

rl_zoo3's own spaces for on-policy algorithms replace the network's arguments, discount rewards, and cut episodes anywhere.
Ours leave to the YAML entry

- the network (``policy`` and ``policy_kwargs``), because trials do not measure the time that a larger one costs;
- the discount ``gamma``, which is 1 in ours: a task visited late counts as much as one visited early;
- the rollout (``n_envs`` and ``n_steps``), which holds whole episodes in ours;
- the router under ``ITSCallback``; tune it on a ``RoutePlanning`` environment.

=================== ============================= ========== ===== ===========
hyperparameter      values                        reinforce  ppo   a2c
=================== ============================= ========== ===== ===========
learning_rate       1e-4 to 5e-3, logarithmic     yes        yes   yes
max_grad_norm       0.3 to 5, logarithmic         yes        yes   yes
ent_coef            1e-5 to 3e-2, logarithmic     yes        yes   yes
gae_lambda          0.9, 0.95, 0.98, 0.99, 1                 yes   yes
vf_coef             1e-3 to 1, logarithmic                   yes   yes
batch_size          256, 512, ..., 8192                      yes
n_epochs            1 to 8                                   yes
clip_range          0.1, 0.2, 0.3                            yes
normalize_advantage true, false                   yes              yes
use_rms_prop        true, false                                    yes
baseline            shared, rollout, critic       yes
n_samples           2, 4, 8, 16                   yes
=================== ============================= ========== ===== ===========

``ppo_mask`` has the space of ``ppo``. On other environments ``ppo``, ``ppo_mask`` and ``a2c`` have rl_zoo3's own spaces, and
``reinforce`` one with ``gamma`` and ``n_steps`` and without samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator
from rl_zoo3.hyperparams_opt import convert_onpolicy_params, sample_a2c_params, sample_ppo_params
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.zoo.rl_zoo3_compat import set_search_space

_Params = dict[str, Any]
_Converter = Callable[[_Params], _Params]
# Takes the trial (optuna.Trial), the number of actions (for noise), n_envs and arguments for off-policy algorithms.
_Sampler = Callable[[Any, int, int, _Params], _Params]


def _suggest_common(trial: Any) -> _Params:
    """:param trial: Draws the hyperparameters that all algorithms share"""
    return {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 5e-3, log=True),
        "max_grad_norm": trial.suggest_float("max_grad_norm", 0.3, 5.0, log=True),
        "ent_coef": trial.suggest_float("ent_coef", 1e-5, 0.03, log=True),
    }


def _suggest_critic(trial: Any) -> _Params:
    """:param trial: Draws the hyperparameters of algorithms with a critic"""
    return {
        "gae_lambda": trial.suggest_categorical("gae_lambda", [0.9, 0.95, 0.98, 0.99, 1.0]),
        "vf_coef": trial.suggest_float("vf_coef", 1e-3, 1.0, log=True),
    }


def _sample_ppo(trial: Any, n_actions: int, n_envs: int, additional_args: _Params) -> _Params:
    """PPO and MaskablePPO on our environments; parameters and result as in rl_zoo3."""
    hyperparams = _convert_powers(
        {
            **_suggest_common(trial),
            **_suggest_critic(trial),
            "batch_size_pow": trial.suggest_int("batch_size_pow", 8, 13),
            "n_epochs": trial.suggest_int("n_epochs", 1, 8),
            "clip_range": trial.suggest_categorical("clip_range", [0.1, 0.2, 0.3]),
        }
    )
    # As in rl_zoo3, so that reports also show the number itself.
    trial.set_user_attr("batch_size", hyperparams["batch_size"])
    return hyperparams


def _sample_a2c(trial: Any, n_actions: int, n_envs: int, additional_args: _Params) -> _Params:
    """A2C on our environments; parameters and result as in rl_zoo3."""
    return {
        **_suggest_common(trial),
        **_suggest_critic(trial),
        "normalize_advantage": trial.suggest_categorical("normalize_advantage", [False, True]),
        "use_rms_prop": trial.suggest_categorical("use_rms_prop", [False, True]),
    }


def _sample_reinforce(trial: Any, n_actions: int, n_envs: int, additional_args: _Params) -> _Params:
    """REINFORCE on our environments, playing whole episodes; parameters and result as in rl_zoo3."""
    return _convert_reinforce(
        {
            **_suggest_common(trial),
            "normalize_advantage": trial.suggest_categorical("normalize_advantage", [False, True]),
            "baseline": trial.suggest_categorical("baseline", ["shared", "rollout", "critic"]),
            "n_samples_pow": trial.suggest_int("n_samples_pow", 1, 4),
        }
    )


def _sample_reinforce_steps(trial: Any, n_actions: int, n_envs: int, additional_args: _Params) -> _Params:
    """REINFORCE on any other environment, in SB3's loop; parameters and result as in rl_zoo3."""
    return _convert_reinforce(
        {
            **_suggest_common(trial),
            "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-4, 0.03, log=True),
            "n_steps_pow": trial.suggest_int("n_steps_pow", 6, 11),
            "normalize_advantage": trial.suggest_categorical("normalize_advantage", [False, True]),
            "baseline": trial.suggest_categorical("baseline", ["exponential", "critic"]),
        }
    )


def _convert_powers(params: _Params) -> _Params:
    """
    :param params: Parameters of a trial
    :return: Hyperparameters: ``x_pow`` is the binary logarithm of ``x``, ``one_minus_x`` is 1 - ``x``
    """
    converted: _Params = {}
    for name, value in params.items():
        if name.endswith("_pow"):
            converted[name.removesuffix("_pow")] = 2**value
        elif name.startswith("one_minus_"):
            converted[name.removeprefix("one_minus_")] = 1 - value
        else:
            converted[name] = value
    return converted


def _convert_reinforce(params: _Params) -> _Params:
    """
    :param params: Parameters of a REINFORCE trial
    :return: Hyperparameters; the YAML's baseline arguments are dropped, because they do not fit other baselines
    """
    return {**_convert_powers(params), "baseline_kwargs": None}


_OUR_SPACES: dict[str, tuple[_Sampler, _Converter]] = {
    "reinforce": (_sample_reinforce, _convert_reinforce),
    "ppo": (_sample_ppo, _convert_powers),
    "ppo_mask": (_sample_ppo, _convert_powers),
    "a2c": (_sample_a2c, _convert_powers),
}
_OTHER_SPACES: dict[str, tuple[_Sampler, _Converter]] = {
    "reinforce": (_sample_reinforce_steps, _convert_reinforce),
    "ppo": (sample_ppo_params, convert_onpolicy_params),
    "ppo_mask": (sample_ppo_params, convert_onpolicy_params),
    "a2c": (sample_a2c_params, convert_onpolicy_params),
}


def register_search_spaces(env_id: str) -> None:
    """
    Register the search spaces for this environment with rl_zoo3.

    :param env_id: Id of a registered environment
    """
    for algo, (sampler, converter) in (_OUR_SPACES if problem_env_class(env_id) else _OTHER_SPACES).items():
        set_search_space(algo, sampler, converter)


def problem_env_class(env_id: str) -> type[ProblemEnv] | None:
    """
    :param env_id: Id of a registered environment
    :return: Its class, if that is one of this package, or a user's subclass of one
    """
    entry_point = gym.spec(env_id).entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return creator if isinstance(creator, type) and issubclass(creator, ProblemEnv) else None


def has_success(env_id: str, env_kwargs: _Params) -> bool:
    """
    :param env_id: Id of a registered environment
    :param env_kwargs: Arguments that it is made with
    :return: Whether the last ``info`` of its episodes holds ``is_success``, which it does not with a reward of the user
    """
    found = problem_env_class(env_id)
    if found is None or found.step is not ProblemEnv.step:
        return False
    # The reward may come from the arguments, the registration or the constructor of a subclass.
    env = gym.spec(env_id).make(**env_kwargs)
    made: Any = env.unwrapped
    env.close()
    return made.problem.reward is None


class StopWhenDiverged(BaseCallback):
    """
    Stops a training whose parameters are no longer finite.

    :raises ValueError: At the start of a rollout; ``-optimize`` prunes a trial on it
    """

    def _on_rollout_start(self) -> None:
        for name, parameter in self.model.policy.named_parameters():
            if not parameter.isfinite().all():
                raise ValueError(f"Training diverged: {name} is not finite after {self.num_timesteps} steps.")

    def _on_step(self) -> bool:
        return True

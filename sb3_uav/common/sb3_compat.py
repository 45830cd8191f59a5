"""
Access to private attributes of Stable-Baselines3's objects from outside a subclass, and what differs between its versions.

No other module does either. Each function links the upstream code that it relies on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common import base_class, utils
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule


def linear_schedule(start: float) -> Schedule:
    """
    A schedule that falls linearly from ``start`` to 0 over the whole training.

    ``LinearSchedule``, which SB3 2.6 has not, in place of ``get_linear_fn``, which it deprecates:
    https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/utils.py#L107

    :param start: Value at the beginning
    :return: A function of the progress that remains, 1 to 0
    """
    if hasattr(utils, "LinearSchedule"):
        return utils.LinearSchedule(start=start, end=0.0, end_fraction=1.0)
    return utils.get_linear_fn(start, 0.0, 1.0)


def n_updates(model: BaseAlgorithm) -> int:
    """
    Number of updates so far; PPO counts its epochs over a rollout, A2C and REINFORCE their optimizer steps.

    ``self._n_updates``: https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L161

    :param model: Any SB3 algorithm
    :return: Its number of updates, kept in its zip
    """
    return model._n_updates


def total_timesteps(model: BaseAlgorithm) -> int:
    """
    Number of steps at which the running ``learn`` stops.

    ``_setup_learn``: https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L417

    :param model: Any SB3 algorithm
    :return: Its ``total_timesteps``, earlier calls of ``learn`` included; 0 before the first
    """
    return model._total_timesteps


def set_last_observation(model: OnPolicyAlgorithm, observation: np.ndarray | dict[str, np.ndarray]) -> None:
    """
    Continue from the first observation of an environment that was reset by other code than the algorithm.

    ``_setup_learn`` does the same after its own reset:
    https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L423

    :param model: An on-policy algorithm
    :param observation: The observation that ``reset`` of its environment returned
    """
    model._last_obs = observation
    model._last_episode_starts = np.ones(model.n_envs, dtype=bool)


def forget_last_observation(model: OnPolicyAlgorithm) -> None:
    """
    Make the next ``learn`` reset the environment, even with ``reset_num_timesteps=False``.

    ``set_env`` with ``force_reset`` does the same:
    https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L506

    :param model: An on-policy algorithm
    """
    model._last_obs = None


def replace_logger(model: BaseAlgorithm, logger: Logger) -> None:
    """
    Replace the logger until the next ``learn``, which makes a new one unless ``set_logger`` was called.

    ``_setup_learn``: https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L430

    :param model: Any SB3 algorithm
    :param logger: Its new logger
    """
    model._logger = logger


@contextmanager
def replaced_zip_reader(make: Callable[[Any], Any]) -> Iterator[None]:
    """
    Replace the function with which ``load`` and ``set_parameters`` read zips, which unpickles them.

    https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L677

    :param make: Takes the function of this name that is in place now, and returns another one with the same arguments
    """
    before = base_class.load_from_zip_file
    base_class.load_from_zip_file = make(before)
    try:
        yield
    finally:
        base_class.load_from_zip_file = before

"""What TensorBoard shows beside numbers, in the way that SB3's documentation shows: pictures and hyperparameters."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HParam, Image, Logger, TensorBoardOutputFormat

# Outputs that cannot write pictures or hyperparameters.
_TEXT_OUTPUTS = ("stdout", "log", "json", "csv")
# Arguments of algorithms that are no settings of the training, or not numbers and texts.
_LEFT_OUT = {"policy", "env", "policy_kwargs", "tensorboard_log", "verbose", "device", "_init_setup_model"}


def shows_pictures(logger: Logger) -> bool:
    """
    :param logger: The logger of an algorithm
    :return: Whether it writes for TensorBoard, and matplotlib is installed
    """
    return _writes_tensorboard(logger) and find_spec("matplotlib") is not None


def record_picture(logger: Logger, key: str, picture: np.ndarray) -> None:
    """
    Record a picture for TensorBoard only.

    :param logger: The logger of an algorithm
    :param key: Name of the picture
    :param picture: ``(height, width, 3)`` uint8
    """
    logger.record(key, Image(picture, "HWC"), exclude=_TEXT_OUTPUTS)


def record_hyperparameters(logger: Logger, settings: Mapping[str, Any], metrics: Iterable[str]) -> None:
    """
    Record a line of TensorBoard's HPARAMS tab, if the logger writes for TensorBoard.

    :param logger: The logger of an algorithm
    :param settings: Settings by name, mappings nested; what is neither a number nor a text is left out
    :param metrics: Keys of the values to show beside them, which the same logger records
    """
    if _writes_tensorboard(logger):
        # The values are read from the scalars of these names.
        shown = HParam(_flat(settings), {name: 0.0 for name in metrics})
        logger.record("hparams", shown, exclude=_TEXT_OUTPUTS)


def hyperparameters(model: BaseAlgorithm) -> dict[str, Any]:
    """
    :param model: Any SB3 algorithm
    :return: Its class, its policy's class, the number of environments and the arguments of its constructor; of a schedule
        the value at the beginning
    """
    settings: dict[str, Any] = {"algo": type(model).__name__, "policy": type(model.policy).__name__, "n_envs": model.n_envs}
    for cls in type(model).__mro__:
        parameters = inspect.signature(cls).parameters
        settings.update({name: getattr(model, name) for name in parameters.keys() - _LEFT_OUT if hasattr(model, name)})
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
            break
    # The constructors of some algorithms replace numbers by schedules.
    return {name: value(1.0) if callable(value) and not isinstance(value, type) else value for name, value in settings.items()}


def _writes_tensorboard(logger: Logger) -> bool:
    return any(isinstance(output, TensorBoardOutputFormat) for output in logger.output_formats)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, bool | str | float]:
    """
    :param settings: Settings by name
    :param prefix: Precedes the names
    :return: Numbers and texts, with a slash between the names of nested mappings
    """
    flat: dict[str, bool | str | float] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{name}/"))
        elif isinstance(value, bool | str | int | float):
            flat[prefix + name] = value
    return flat

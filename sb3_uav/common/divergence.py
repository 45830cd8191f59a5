"""Numbers that are not finite: what training stops with, and what no file of a model may hold."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

# Largest weight that is not reported. Those of the trained pairs of this package are at most 60, those of a training whose
# learning rate is too high grow by orders of magnitude.
LARGEST_WEIGHT = 1_000.0
# What to train with after most divergences.
SMALLER_STEPS = "a smaller learning_rate or max_grad_norm"

# The last file that each model was saved to, and whether a training can continue from it. Not an attribute of the model,
# because SB3 would write it into the zip.
_saved: WeakKeyDictionary[Any, tuple[Path, bool]] = WeakKeyDictionary()
# Models whose weights were reported.
_reported: WeakSet[Any] = WeakSet()


class DivergenceError(ValueError):
    """Training, or a model that is to be saved, has come to a number that is not finite."""


def level_of(model: Any) -> str:
    """
    :param model: An algorithm or a policy
    :return: What messages call it: ``allocator``, ``router``, or the name of its class
    """
    policy = getattr(model, "policy", model)
    return getattr(policy, "level", None) or type(model).__name__


def note_saved(model: Any, path: Path, is_checkpoint: bool = False) -> None:
    """
    :param model: An algorithm that was just saved
    :param path: The zip
    :param is_checkpoint: Whether a training can continue from there; it then stays noted when other zips follow
    """
    if is_checkpoint or not _saved.get(model, (path, False))[1]:
        _saved[model] = (path, is_checkpoint)


def last_saved(model: Any) -> Path | None:
    """
    :param model: An algorithm
    :return: Its last checkpoint, or else the last zip of it; None if there is none
    """
    path = _saved.get(model, (None, False))[0]
    return path if path is not None and path.is_file() else None


def diverged(model: Any, what: str, value: float, remedy: str = SMALLER_STEPS, unused: bool = True) -> DivergenceError:
    """
    :param model: The algorithm that learns
    :param what: The quantity
    :param value: Its value
    :param remedy: What to train again with
    :param unused: Whether the update was stopped before it changed the weights
    :return: The error, which names the level, the quantity, the update and the last good checkpoint
    """
    # n_updates of REINFORCE and A2C counts updates; that of PPO counts its epochs over a rollout.
    when = f"in update {getattr(model, '_n_updates', 0) + 1}, after {model.num_timesteps} steps"
    saved = last_saved(model)
    good = "No checkpoint has been saved yet" if saved is None else f"The last good checkpoint is {saved}"
    done = "this update was not applied" if unused else "no file holds these weights"
    from_zip = "" if saved is None else "continue from it, or "
    return DivergenceError(f"{level_of(model)}: The {what} is {value} {when}; {done}. {good}; {from_zip}train with {remedy}.")


def with_checkpoint(error: DivergenceError, model: Any) -> str:
    """
    :param error: An error of the policy, which does not know what has been saved
    :param model: The algorithm that learns
    :return: Its message, with the last good checkpoint
    """
    text = str(error)
    if "checkpoint" in text:
        return text
    saved = last_saved(model)
    good = "No checkpoint has been saved yet" if saved is None else f"The last good checkpoint is {saved}"
    return f"{text} This was after {model.num_timesteps} steps. {good}."


def first_bad(tensor: th.Tensor) -> float | None:
    """
    :param tensor: Numbers
    :return: The first that is not finite; None if all are
    """
    if not tensor.is_floating_point() or bool(th.isfinite(tensor).all()):
        return None
    return float(tensor[~th.isfinite(tensor)].flatten()[0].item())


def largest(tensors: Iterable[tuple[str, th.Tensor]]) -> tuple[str, float]:
    """
    :param tensors: Names and tensors
    :return: Name and absolute value of the largest number, with one transfer from the device; NaN counts as the largest
    """
    named = [(name, tensor) for name, tensor in tensors if tensor.numel() > 0 and tensor.is_floating_point()]
    if not named:
        return "", 0.0
    sizes = th.stack([th.linalg.vector_norm(tensor.detach(), math.inf).float() for _, tensor in named])
    # argmax takes NaN for the largest, as vector_norm does.
    index = int(sizes.argmax())
    return named[index][0], float(sizes[index])


def report_weights(model: Any) -> None:
    """
    Stop if a weight is no longer finite, log the largest one, and warn when it exceeds :data:`LARGEST_WEIGHT`, once per model.

    :param model: An algorithm after an update
    :raises DivergenceError: If a weight is NaN or infinite
    """
    name, size = largest(model.policy.named_parameters())
    if not math.isfinite(size):
        raise diverged(model, f"weight {name}", size, unused=False)
    model.logger.record("train/max_weight", size)
    if size > LARGEST_WEIGHT and model not in _reported:
        _reported.add(model)
        warnings.warn(
            f"{level_of(model)}: The weight {name} has grown to {size:.3g} after {model.num_timesteps} steps, more than "
            f"{LARGEST_WEIGHT:g}: training is likely to diverge. Stop it and train with a smaller learning_rate, or watch "
            "train/max_weight.",
            stacklevel=2,
        )


def require_finite_model(model: BaseAlgorithm, path: Path | str) -> None:
    """
    Refuse to save what no training can continue from.

    :param model: Any algorithm of SB3
    :param path: Where it is to be saved, for the message
    :raises DivergenceError: If a weight, a buffer, the state of an optimizer or the statistics of ``VecNormalize`` are not
        finite
    """
    for part, state in model.get_parameters().items():
        for name, value in _numbers(state, part):
            _require(model, name, value, path)
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        for name, value in normalization_statistics(normalization):
            _require(model, name, value, path)


def normalization_statistics(env: Any) -> Iterator[tuple[str, th.Tensor]]:
    """
    :param env: A ``VecNormalize``
    :return: Its running means and variances by name
    """
    running = {"ret_rms": env.ret_rms}
    observed = getattr(env, "obs_rms", None)
    running |= (
        {f"obs_rms[{key!r}]": value for key, value in observed.items()}
        if isinstance(observed, dict)
        else {"obs_rms": observed}
    )
    for name, statistics in running.items():
        for field in ("mean", "var"):
            if statistics is not None:
                yield f"VecNormalize.{name}.{field}", th.as_tensor(np.asarray(getattr(statistics, field)))


def _require(model: BaseAlgorithm, name: str, value: th.Tensor, path: Path | str) -> None:
    bad = first_bad(value)
    if bad is not None:
        saved = last_saved(model)
        good = "" if saved is None else f" The last good checkpoint is {saved}."
        raise DivergenceError(
            f"{path} was not written, and an earlier file of this name is untouched: {name} of the {level_of(model)} holds "
            f"{bad} after {model.num_timesteps} steps.{good} Train with {SMALLER_STEPS}."
        )


def _numbers(value: Any, name: str) -> Iterator[tuple[str, th.Tensor]]:
    """:return: All tensors and floats in nested dictionaries and lists, with their places"""
    if isinstance(value, th.Tensor):
        yield name, value
    elif isinstance(value, float):
        yield name, th.tensor(value, dtype=th.float64, device="cpu")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _numbers(item, f"{name}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _numbers(item, f"{name}.{index}")

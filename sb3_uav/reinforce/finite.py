"""Stops training before an update with numbers that are not finite."""

from __future__ import annotations

import math

import torch as th


def require_finite(values: dict[str, th.Tensor], update: int, n_steps: int) -> None:
    """
    :param values: Scalars by the name that the error gives them
    :param update: Number of the update that would follow, from 1
    :param n_steps: Number of environment steps so far
    :raises ValueError: If a value is infinite or NaN
    """
    for name, value in values.items():
        if not math.isfinite(value.item()):
            raise ValueError(
                f"The {name} is {value.item()} in update {update}, after {n_steps} steps; this update was not applied. "
                "Train again, or continue from an earlier zip, with a smaller learning_rate or max_grad_norm."
            )

"""Euclidean distances, and the tolerance of the maximum flight distance."""

from __future__ import annotations

import torch as th

# Rounding tolerance of the dynamics and the checker, relative to the maximum flight distance.
DISTANCE_TOLERANCE = 5e-10


def euclidean(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """
    Euclidean distance over the last dimension.

    Written out so that rounding does not depend on the driver or the batch size.

    :param a: ``(..., 2)``
    :param b: ``(..., 2)``, broadcast against ``a``
    :return: ``(...)``
    """
    dx, dy = (a - b).unbind(-1)
    return th.sqrt(dx * dx + dy * dy)


def distance_limit(max_distance: th.Tensor) -> th.Tensor:
    """
    The longest tour that counts as feasible: ``max_distance`` plus the rounding tolerance.

    :param max_distance: ``(batch,)``
    :return: ``(batch,)``
    """
    return max_distance + DISTANCE_TOLERANCE * max_distance

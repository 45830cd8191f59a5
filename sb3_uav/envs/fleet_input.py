"""Conversion of user input about UAVs and tasks: defaults are left out, so that equal instances look equal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_uav.envs.array_input import as_numbers, per_instance


def fleet_arrays(
    depot: np.ndarray, batch_size: int, max_distance: Any, start: Any, end: Any, n_uavs: int, is_single: bool, source: str
) -> dict[str, np.ndarray]:
    """
    :param depot: ``(batch, 2)``
    :param batch_size: Number of instances
    :param max_distance: A number, ``(batch,)`` or ``(batch, n_uavs)``; of one instance ``(n_uavs,)`` too
    :param start: ``(batch, n_uavs, 2)`` or None
    :param end: ``(batch, n_uavs, 2)`` or None
    :param n_uavs: Size of the fleet
    :param is_single: Whether arrays come without the first dimension
    :param source: Where they come from, for errors
    :return: ``max_distance``, and ``start`` and ``end`` if they differ from the depot
    :raises ValueError: If a shape is not allowed
    """
    distance = as_numbers("max_distance", max_distance, source)
    if is_single and distance.shape == (n_uavs,) and n_uavs > 1:
        distance = distance[None]
    if distance.ndim == 2 and distance.shape == (batch_size, n_uavs):
        # NaN equals nothing and is left to the checks.
        are_equal = bool((distance == distance[:, :1]).all())
        fields = {"max_distance": distance[:, 0].copy() if are_equal else distance}
    elif distance.ndim == 2:
        raise ValueError(
            f"{source}: field 'max_distance' has shape {distance.shape}, expected ({batch_size},), or "
            f"({batch_size}, {n_uavs}) for one number per UAV."
        )
    else:
        fields = {"max_distance": per_instance("max_distance", distance, batch_size, source)}
    for name, given in (("start", start), ("end", end)):
        if given is None:
            continue
        points = as_numbers(name, given, source)
        points = points[None] if is_single and points.ndim == 2 else points
        if points.shape != (batch_size, n_uavs, 2):
            raise ValueError(
                f"{source}: field '{name}' has shape {points.shape}, expected ({batch_size}, {n_uavs}, 2), one point per UAV."
            )
        if depot.shape != (batch_size, 2) or not (points == depot[:, None]).all():
            fields[name] = points
    return fields


def task_arrays(given: Mapping[str, Any], is_single: bool, source: str) -> dict[str, np.ndarray]:
    """
    :param given: Some of ``values``, ``task_mask``, ``service`` and ``must_serve``, ``(batch, n_tasks)`` each, or None
    :param is_single: Whether arrays come without the first dimension
    :param source: Where they come from, for errors
    :return: Those that are not None; ``service`` and ``must_serve`` only if they say anything
    :raises ValueError: If one is not an array of numbers, or one of bools is not
    """
    fields = {}
    for name, array in given.items():
        if array is None:
            continue
        numbers = as_numbers(name, array, source)
        numbers = numbers[None] if is_single else numbers
        if name in ("task_mask", "must_serve"):
            if not np.isin(numbers, (0, 1)).all():
                raise ValueError(f"{source}: field '{name}' holds values other than True and False.")
            numbers = numbers.astype(bool)
        if name in ("values", "task_mask") or numbers.any():
            fields[name] = numbers
    return fields

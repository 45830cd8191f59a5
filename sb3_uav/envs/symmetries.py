"""Rotations and reflections of instances around their depots."""

from __future__ import annotations

import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.sweep import sweep_center

N_SYMMETRIES = 8
# Digits to which two poses are told apart: rounding errors of a moved instance are far below.
_DIGITS = 6


def reflect(instances: Instances, symmetry: int) -> Instances:
    """
    Rotate and reflect all points around the depot, which preserves all distances.

    :param instances: ``batch`` instances
    :param symmetry: Index of one of the :data:`N_SYMMETRIES` symmetries of the square; 0 is the identity
    :return: The transformed instances
    """
    if symmetry == 0:
        return instances
    signs = instances.tasks.new_tensor([-1.0 if symmetry & 2 else 1.0, -1.0 if symmetry & 4 else 1.0])

    def move(points: th.Tensor) -> th.Tensor:
        offset = points - instances.depot[:, None]
        if symmetry & 1:
            offset = offset.flip(-1)
        return instances.depot[:, None] + offset * signs

    return instances.map_points(move)


def combine(first: int, then: int) -> int:
    """
    :param first: A symmetry, see :func:`reflect`
    :param then: Another one
    :return: The symmetry that has the effect of both, one after the other
    """
    signs = (first >> 1 & 1, first >> 2 & 1)
    x, y = signs[::-1] if then & 1 else signs
    return ((first ^ then) & 1) | (x << 1 ^ then & 2) | (y << 2 ^ then & 4)


def standard_pose(instances: Instances) -> list[int]:
    """
    Find the symmetry that turns an instance the way that its mirror images and quarter turns are turned too.

    It is the one that moves the tasks farthest to the right and up, on average; where that does not decide, with their values
    or their distances as weights.

    :param instances: ``batch`` instances
    :return: A symmetry for each, see :func:`reflect`; where several lead to the same picture, any of these
    """
    offset = (instances.tasks - sweep_center(instances)[:, None]) * instances.task_mask[..., None]
    size = th.linalg.vector_norm(offset, dim=-1)
    largest = size.amax(1, keepdim=True).clamp(min=1e-300)
    offset, size = offset / largest[..., None], size / largest
    prizes = instances.prizes * instances.task_mask
    weights = th.stack([instances.task_mask.to(offset.dtype), prizes, size, prizes * size], dim=1)
    weights = weights / weights.sum(2, keepdim=True).clamp(min=1e-300)
    return [max(range(N_SYMMETRIES), key=lambda symmetry: _seen(row, symmetry)) for row in (weights @ offset).tolist()]


def _seen(points: list[list[float]], symmetry: int) -> list[float]:
    """:return: Coordinates of points under a symmetry, the first of all points and then the second, rounded"""
    moved = [(y, x) if symmetry & 1 else (x, y) for x, y in points]
    signed = [(-x if symmetry & 2 else x, -y if symmetry & 4 else y) for x, y in moved]
    return [round(part, _DIGITS) for point in signed for part in point]


def turn(instances: Instances, angle: th.Tensor) -> Instances:
    """
    Rotate all points around the depot, which preserves all distances up to rounding errors.

    :param instances: ``batch`` instances
    :param angle: ``(batch,)``, in radians
    :return: The rotated instances
    """
    cosine, sine = (part.to(instances.tasks.dtype)[:, None] for part in (angle.cos(), angle.sin()))

    def move(points: th.Tensor) -> th.Tensor:
        x, y = (points - instances.depot[:, None]).unbind(-1)
        turned = th.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)
        return instances.depot[:, None] + turned

    return instances.map_points(move)

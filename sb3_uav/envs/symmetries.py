"""Rotations and reflections of instances around their depots."""

from __future__ import annotations

import torch as th

from sb3_uav.envs.instances import Instances

N_SYMMETRIES = 8


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

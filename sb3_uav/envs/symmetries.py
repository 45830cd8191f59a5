"""Rotations and reflections of instances around their depots."""

from __future__ import annotations

from dataclasses import replace

import torch as th

from sb3_uav.envs.instances import Instances

N_SYMMETRIES = 8


def reflect(instances: Instances, symmetry: int) -> Instances:
    """
    Rotate and reflect the tasks around the depot, which preserves all distances.

    :param instances: ``batch`` instances
    :param symmetry: Index of one of the :data:`N_SYMMETRIES` symmetries of the square; 0 is the identity
    :return: The transformed instances
    """
    if symmetry == 0:
        return instances
    offset = instances.tasks - instances.depot[:, None]
    if symmetry & 1:
        offset = offset.flip(-1)
    signs = offset.new_tensor([-1.0 if symmetry & 2 else 1.0, -1.0 if symmetry & 4 else 1.0])
    return replace(instances, tasks=instances.depot[:, None] + offset * signs)


def turn(instances: Instances, angle: th.Tensor) -> Instances:
    """
    Rotate the tasks around the depot, which preserves all distances up to rounding errors.

    :param instances: ``batch`` instances
    :param angle: ``(batch,)``, in radians
    :return: The rotated instances
    """
    x, y = (instances.tasks - instances.depot[:, None]).unbind(-1)
    cosine, sine = (part.to(x.dtype)[:, None] for part in (angle.cos(), angle.sin()))
    turned = th.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)
    return replace(instances, tasks=instances.depot[:, None] + turned)

"""The part of an observation that does not change during an episode, as tensors for the encoder."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_uav.envs.instances import Instances


class StaticObservation(NamedTuple):
    """
    The static part of ``batch`` observations, float32 on the network's device.

    :param depot: ``(batch, 2)``
    :param tasks: ``(batch, n_tasks, 2)``
    :param values: ``(batch, n_tasks)``
    :param task_mask: ``(batch, n_tasks)`` bool, True for real tasks
    :param max_distance: ``(batch, 1)``
    """

    depot: th.Tensor
    tasks: th.Tensor
    values: th.Tensor
    task_mask: th.Tensor
    max_distance: th.Tensor

    @classmethod
    def from_observation(cls, observation: TensorDict) -> StaticObservation:
        """:param observation: A batch of preprocessed observations"""
        return cls(
            depot=observation["depot"],
            tasks=observation["tasks"].unflatten(1, (-1, 2)),
            values=observation["task_values"],
            task_mask=observation["task_mask"].bool(),
            max_distance=observation["max_distance"],
        )

    @classmethod
    def from_instances(cls, instances: Instances) -> StaticObservation:
        """:param instances: Instances on the network's device"""
        instances = instances.near_origin()
        return cls(
            depot=instances.depot.float(),
            tasks=instances.tasks.float(),
            values=instances.values.float(),
            task_mask=instances.task_mask,
            max_distance=instances.max_distance.float()[:, None],
        )

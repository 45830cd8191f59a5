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

    def rows(self, rows: th.Tensor) -> StaticObservation:
        """
        :param rows: ``(n,)`` int64
        :return: These rows, in this order
        """
        return StaticObservation(*(field[rows] for field in self))

    def unique(self) -> tuple[StaticObservation, th.Tensor]:
        """
        :return: The distinct rows, and the index among them of every row, ``(batch,)`` int64
        """
        flat = th.cat([field.flatten(1).float() for field in self], dim=1)
        different, index = flat.unique(dim=0, return_inverse=True)
        # Any row of each kind; index_copy with repeated targets keeps one of them.
        row = th.arange(len(index), device=index.device)
        return self.rows(index.new_zeros(len(different)).index_copy(0, index, row)), index

    def changed_rows(self, other: StaticObservation) -> th.Tensor:
        """
        :param other: As many observations of the same size
        :return: ``(n,)`` int64, the rows that differ in any field
        """
        return th.stack([(old != new).flatten(1).any(1) for old, new in zip(self, other, strict=True)]).any(0).nonzero()[:, 0]

    def clone(self) -> StaticObservation:
        """:return: A copy that shares no memory"""
        return StaticObservation(*(field.clone() for field in self))

"""The part of an observation that does not change during an episode, as tensors for the encoder."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_uav.envs.instances import Instances


class StaticObservation(NamedTuple):
    """
    The static part of ``batch`` observations, float32 on the network's device.

    Fields of the whole problem are None where every row has their defaults.

    :param depot: ``(batch, 2)``
    :param tasks: ``(batch, n_tasks, 2)``
    :param values: ``(batch, n_tasks)``, see :attr:`~sb3_uav.envs.instances.Instances.prizes`
    :param task_mask: ``(batch, n_tasks)`` bool, True for real tasks
    :param max_distance: ``(batch, 1)``, that of the UAV that flies farthest
    :param start: ``(batch, n_uavs, 2)``
    :param end: ``(batch, n_uavs, 2)``
    :param uav_distance: ``(batch, n_uavs)``
    :param service: ``(batch, n_tasks)``
    """

    depot: th.Tensor
    tasks: th.Tensor
    values: th.Tensor
    task_mask: th.Tensor
    max_distance: th.Tensor
    start: th.Tensor | None = None
    end: th.Tensor | None = None
    uav_distance: th.Tensor | None = None
    service: th.Tensor | None = None

    @classmethod
    def from_observation(cls, observation: TensorDict) -> StaticObservation:
        """:param observation: A batch of preprocessed observations"""
        whole = {}
        unit = observation["max_distance"]
        if "uav_distance" in observation:
            unit = _unit(unit)
            whole = {
                "start": observation["uav_start"].unflatten(1, (-1, 2)),
                "end": observation["uav_end"].unflatten(1, (-1, 2)),
                "uav_distance": observation["uav_distance"],
                "service": observation["service"],
            }
        return cls(
            depot=observation["depot"],
            tasks=observation["tasks"].unflatten(1, (-1, 2)),
            values=observation["task_values"],
            task_mask=observation["task_mask"].bool(),
            max_distance=unit,
            **whole,
        )

    @classmethod
    def from_instances(cls, instances: Instances) -> StaticObservation:
        """:param instances: Instances on the network's device"""
        instances = instances.near_origin()
        return cls(
            depot=instances.depot.float(),
            tasks=instances.tasks.float(),
            values=instances.prizes.float(),
            task_mask=instances.task_mask,
            max_distance=_unit(instances.unit.float()[:, None]),
            start=None if instances.start is None else instances.start.float(),
            end=None if instances.end is None else instances.end.float(),
            uav_distance=None if instances.max_distance.dim() == 1 else instances.max_distance.float(),
            service=None if instances.service is None else instances.service.float(),
        )

    @property
    def home(self) -> th.Tensor:
        """The origin of the networks' coordinates: the mean of the UAVs' ends, ``(batch, 2)``."""
        if self.end is None:
            return self.depot
        # Exact where all are equal.
        return self.end[:, 0] + (self.end - self.end[:, :1]).mean(1)


def _unit(max_distance: th.Tensor) -> th.Tensor:
    """:return: The same as a unit of length: that of a single UAV may be 0, which stands for 1 then"""
    return max_distance.where(max_distance > 0, 1.0)

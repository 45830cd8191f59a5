"""The part of an observation that does not change during an episode, as tensors for the encoder."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_uav.envs.distances import euclidean
from sb3_uav.envs.instances import Instances

# Of distances in float32, as a part of them.
_ROUNDING = 1e-5


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
        """The origin of the networks' coordinates: the mean of the ends of the UAVs that can fly, ``(batch, 2)``."""
        if self.end is None:
            return self.depot
        start = self.depot[:, None] if self.start is None else self.start
        limit = self.max_distance if self.uav_distance is None else self.uav_distance
        # The ends of grounded UAVs may be anywhere.
        flies = euclidean(start, self.end) <= (1 + _ROUNDING) * limit
        first = self.end.gather(1, flies.to(th.int8).argmax(1)[:, None, None].expand(-1, 1, 2))
        # Exact where all are equal.
        offset = (self.end - first).masked_fill(~flies[..., None], 0.0)
        return first[:, 0] + offset.sum(1) / flies.sum(1, keepdim=True).clamp(min=1)


def _unit(max_distance: th.Tensor) -> th.Tensor:
    """:return: The same as a unit of length: that of a single UAV may be 0, which stands for 1 then"""
    return max_distance.where(max_distance > 0, 1.0)

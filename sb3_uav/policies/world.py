"""What the whole problem adds to the geometry: values, service costs, and each UAV's start, end and maximum distance."""

from __future__ import annotations

from typing import NamedTuple

import torch as th

from sb3_uav.envs.distances import euclidean
from sb3_uav.policies.static_observation import StaticObservation

# Logarithms of ratios of values are limited to this: a factor of 400.
_LOG_VALUE_LIMIT = 6.0
# Where UAVs start and end is limited to so many units: squares of distances must be finite.
_FARTHEST_SITE = 1e6
# A solo flight longer than so many times the maximum distance is as impossible as any.
LONGEST_SOLO = 2.0
# Values are compared with the mean of the instance's tasks; this keeps the quotient finite where all are 0.
_SMALLEST = 1e-30


class World(NamedTuple):
    """
    In units of the maximum flight distance, relative to the home of the instance, see :attr:`StaticObservation.home`.

    The UAVs' dimension is 1 where all UAVs are equal.

    :param start: ``(batch, n_uavs, 2)``
    :param end: ``(batch, n_uavs, 2)``
    :param reach: ``(batch, n_uavs)``, the maximum distance of each UAV, in units of the farthest; 1 where they are equal
    :param service: ``(batch, n_tasks)``; 0 for padded tasks
    :param value: ``(batch, n_tasks)``, relative to the mean of the instance; 0 for padded tasks
    :param log_value: ``(batch, n_tasks)``, its logarithm, limited; 0 for padded tasks
    """

    start: th.Tensor
    end: th.Tensor
    reach: th.Tensor
    service: th.Tensor
    value: th.Tensor
    log_value: th.Tensor

    @classmethod
    def of(cls, static: StaticObservation) -> World:
        """:param static: ``batch`` instances"""
        unit, home = static.max_distance, static.home[:, None]
        depot = static.depot[:, None]
        start, end = (depot if points is None else points for points in (static.start, static.end))
        service = th.zeros_like(static.values) if static.service is None else static.service / unit
        real = static.task_mask
        values = static.values.masked_fill(~real, 0.0)
        mean = values.sum(1, keepdim=True) / real.sum(1, keepdim=True).clamp(min=1)
        value = values / mean.clamp(min=_SMALLEST)
        log_value = value.clamp(min=_SMALLEST).log().clamp(-_LOG_VALUE_LIMIT, _LOG_VALUE_LIMIT)
        return cls(
            start=((start - home) / unit[..., None]).clamp(-_FARTHEST_SITE, _FARTHEST_SITE),
            end=((end - home) / unit[..., None]).clamp(-_FARTHEST_SITE, _FARTHEST_SITE),
            reach=th.ones_like(unit) if static.uav_distance is None else static.uav_distance / unit,
            service=service.masked_fill(~real, 0.0).clamp(max=LONGEST_SOLO),
            value=value,
            log_value=log_value.masked_fill(~real, 0.0),
        )

    @property
    def middle(self) -> th.Tensor:
        """Midway between start and end of every UAV, ``(batch, n_uavs, 2)``."""
        return (self.start + self.end) / 2

    def solo(self, tasks: th.Tensor) -> th.Tensor:
        """
        :param tasks: ``(batch, n_tasks, 2)``, their scaled coordinates
        :return: ``(batch, n_uavs, n_tasks)``, which part of each UAV's maximum distance a flight to the task alone takes
        """
        points = tasks[:, None]
        length = euclidean(points, self.start[:, :, None]) + euclidean(points, self.end[:, :, None]) + self.service[:, None]
        return (length / self.reach.clamp(min=1e-6)[..., None]).clamp(max=LONGEST_SOLO)

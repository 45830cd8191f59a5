"""Measures of how a task fits the UAVs of a fleet, as inputs of the allocator."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch as th

from sb3_uav.envs.instances import euclidean
from sb3_uav.policies.geometry import (
    FAR_SCALE,
    FARTHEST,
    NEAR,
    log_ratio,
    scaled_coordinates,
    stack_features,
    task_distances,
)
from sb3_uav.policies.static_observation import StaticObservation

# How many of the nearest earlier tasks count as the neighbors of a task.
_N_NEIGHBORS = 8
# Fraction of its share of the tasks from which a UAV counts as full.
_FULL = 0.95
# Logarithm of about 20, a common number of tasks per UAV.
LOG_TASKS_PER_UAV_OFFSET = 3.0


# Features of a task and a UAV in the allocator. The weights in existing zips depend on this order.
FleetFeature = IntEnum(
    "FleetFeature",
    # Tasks that the UAV would have, in fair shares; what exceeds FULL of that; and whether it has none yet.
    "LOAD OVERLOAD EMPTY "
    # Which part of the task's neighbors the UAV has; the distance to the nearest of them, relative to the nearest of any UAV.
    "VOTES RELATIVE_DISTANCE NEAREST "
    # Distances to the centroid of the UAV's tasks and to the last of them.
    "CENTROID LAST "
    # Half the perimeter of the box around its tasks and the depot, and what the task adds to that.
    "PERIMETER GROWTH "
    # Cosine of the angle between task and centroid, seen from the depot.
    "TOWARDS "
    # The same for all UAVs: distance to the depot, progress, tasks per UAV, fleet size, and UAVs without tasks.
    "HOME PROGRESS TASKS_PER_UAV FLEET_SIZE N_EMPTY",
    start=0,
)


class FleetState(NamedTuple):
    """
    Where the UAVs' tasks lie. A UAV without tasks has only zeros.

    :param n_tasks: ``(batch, n_samples, n_uavs)``, how many
    :param total: ``(batch, n_samples, n_uavs, 2)``, sum of their coordinates
    :param last: ``(batch, n_samples, n_uavs, 2)``, coordinates of the last one
    :param box: ``(batch, n_samples, n_uavs, 4)``, the largest x, y, -x, -y of them and the depot
    """

    n_tasks: th.Tensor
    total: th.Tensor
    last: th.Tensor
    box: th.Tensor


class FleetGeometry(NamedTuple):
    """
    Precomputed distances for the features of tasks and UAVs.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param neighbors: ``(batch, n_tasks, n_neighbors)`` int64, the nearest tasks of a task among those before it
    :param neighbor_distance: ``(batch, n_tasks, n_neighbors)``, ``FARTHEST`` where there are fewer
    :param n_real: ``(batch, 1)``, number of real tasks
    """

    coordinates: th.Tensor
    neighbors: th.Tensor
    neighbor_distance: th.Tensor
    n_real: th.Tensor

    @property
    def tasks(self) -> th.Tensor:
        """``(batch, n_tasks, 2)``."""
        return self.coordinates[:, 1:]

    @classmethod
    def of(cls, static: StaticObservation) -> FleetGeometry:
        """:param static: ``batch`` instances"""
        coordinates = scaled_coordinates(static)
        n_tasks = static.task_mask.shape[1]
        later = th.ones(n_tasks, n_tasks, dtype=th.bool, device=coordinates.device).triu()
        distance = task_distances(coordinates, static.task_mask).masked_fill(later, 2 * FARTHEST)
        near, neighbors = distance.topk(min(_N_NEIGHBORS, n_tasks), largest=False)
        return cls(coordinates, neighbors, near, static.task_mask.sum(1, keepdim=True).clamp(min=1).float())

    def initial(self, n_samples: int, n_uavs: int) -> FleetState:
        """
        :param n_samples: Episodes per instance
        :param n_uavs: Size of the fleet
        :return: A fleet without tasks
        """
        count = self.coordinates.new_zeros(len(self.coordinates), n_samples, n_uavs)
        total = count[..., None].repeat(1, 1, 1, 2)
        return FleetState(count, total, total.clone(), count[..., None].repeat(1, 1, 1, 4))

    def add(self, fleet: FleetState, task: int, mine: th.Tensor) -> FleetState:
        """
        :param fleet: The fleet before
        :param task: Index of a task
        :param mine: ``(batch, n_samples, n_uavs)`` bool, True for the UAV that gets it
        :return: The fleet with it
        """
        point = self.tasks[:, None, None, task]
        mine = mine[..., None]
        return FleetState(
            fleet.n_tasks + mine.squeeze(-1),
            fleet.total + point * mine,
            th.where(mine, point, fleet.last),
            th.where(mine, fleet.box.maximum(th.cat([point, -point], dim=-1)), fleet.box),
        )

    def of_prefixes(self, mine: th.Tensor) -> FleetState:
        """
        :param mine: ``(batch, n_samples, n_tasks, n_uavs)`` bool, True where the task belongs to the UAV
        :return: The fleets before each task and after the last, ``(batch, n_samples, n_tasks + 1, n_uavs, ...)``
        """
        # What the node before each task adds; the depot adds nothing.
        added = th.cat([th.zeros_like(mine[:, :, :1]), mine], dim=2)
        points = self.coordinates[:, None, :, None]
        newest = (th.arange(added.shape[2], device=added.device)[:, None] * added).cummax(2).values
        rows = points.expand(-1, added.shape[1], -1, added.shape[3], -1)
        held = added[..., None]
        return FleetState(
            added.cumsum(2).to(points.dtype),
            (points * held).cumsum(2),
            rows.gather(2, newest[..., None].expand_as(rows)),
            (th.cat([points, -points], dim=-1) * held).cummax(2).values,
        )

    def of_assignment(self, mine: th.Tensor) -> FleetState:
        """
        :param mine: ``(batch, n_samples, n_tasks, n_uavs)`` bool, True where the task belongs to the UAV,
            which may be none
        :return: The fleet with these tasks
        """
        points = self.tasks[:, None, :, None]
        held = mine[..., None]
        signed = th.cat([points, -points], dim=-1)
        places = th.arange(1, mine.shape[2] + 1, device=mine.device)[:, None]
        newest = (places * mine).amax(2)
        rows = self.coordinates[:, None, :, None].expand(-1, mine.shape[1], -1, mine.shape[3], -1)
        return FleetState(
            mine.sum(2).to(points.dtype),
            (points * held).sum(2),
            rows.gather(2, newest[:, :, None, :, None].expand(-1, -1, 1, -1, 2)).squeeze(2),
            (signed * held).amax(2).clamp(min=0.0),
        )

    def owners(self, task: th.Tensor, assignment: th.Tensor) -> th.Tensor:
        """
        :param task: ``(batch, n_samples)`` int64
        :param assignment: ``(batch, n_samples, n_tasks)`` int64, or ``(batch, 1, n_tasks)``
        :return: ``(batch, n_samples, n_neighbors)``, the UAVs of the task's :attr:`neighbors`
        """
        index = task[..., None].expand(-1, -1, self.neighbors.shape[-1])
        return assignment.gather(-1, self.neighbors.gather(1, index))

    def all_owners(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: ``(batch, n_samples, n_tasks)`` int64, the UAV of each task
        :return: ``(batch, n_samples * n_tasks, n_neighbors)``, the same for all tasks of all samples
        """
        index = self.neighbors.flatten(1)[:, None].expand(-1, actions.shape[1], -1)
        return actions.gather(-1, index).view(len(actions), -1, self.neighbors.shape[-1])

    def features(self, fleet: FleetState, task: th.Tensor, owners: th.Tensor) -> th.Tensor:
        """
        :param fleet: The fleet before the task
        :param task: ``(batch, n_samples)`` int64
        :param owners: ``(batch, n_samples, n_neighbors)`` int64, the UAVs of the task's :attr:`neighbors`
        :return: ``(batch, n_samples, n_uavs, len(FleetFeature))``
        """
        n_uavs = fleet.n_tasks.shape[-1]
        point = self.tasks.gather(1, task[..., None].expand(-1, -1, 2))[:, :, None]
        uavs = th.arange(n_uavs, device=task.device)[:, None]
        index = task[..., None].expand(-1, -1, self.neighbors.shape[-1])
        distance = self.neighbor_distance.gather(1, index)[:, :, None]
        theirs = (owners[:, :, None] == uavs) & (distance < FARTHEST)
        nearest = th.where(theirs, distance, FARTHEST).amin(-1)
        # Integers divided by integers would have torch's default dtype.
        votes = theirs.sum(-1).to(nearest.dtype) / theirs.any(2).sum(-1, keepdim=True).clamp(min=1)

        per_task = n_uavs / self.n_real[..., None]
        load = (fleet.n_tasks + 1) * per_task
        empty = (fleet.n_tasks == 0).to(load.dtype)
        centroid = fleet.total / fleet.n_tasks.clamp(min=1.0)[..., None]
        home = th.linalg.vector_norm(point, dim=-1)
        towards = (point * centroid).sum(-1) / (home * th.linalg.vector_norm(centroid, dim=-1)).clamp(min=NEAR**2)
        grown = fleet.box.maximum(th.cat([point, -point], dim=-1))
        perimeter = fleet.box.sum(-1)
        fields = {
            FleetFeature.LOAD: load,
            FleetFeature.OVERLOAD: (load - _FULL).clamp(min=0.0),
            FleetFeature.EMPTY: empty,
            FleetFeature.VOTES: votes,
            FleetFeature.RELATIVE_DISTANCE: log_ratio(nearest, nearest.amin(-1, keepdim=True)),
            FleetFeature.NEAREST: FAR_SCALE * nearest,
            FleetFeature.CENTROID: FAR_SCALE * euclidean(point, centroid) * (1 - empty),
            FleetFeature.LAST: FAR_SCALE * euclidean(point, fleet.last) * (1 - empty),
            FleetFeature.PERIMETER: FAR_SCALE * perimeter,
            FleetFeature.GROWTH: FAR_SCALE * (grown.sum(-1) - perimeter),
            FleetFeature.TOWARDS: towards.clamp(-1.0, 1.0),
            FleetFeature.HOME: FAR_SCALE * home,
            FleetFeature.PROGRESS: task[..., None] / self.n_real[..., None],
            FleetFeature.TASKS_PER_UAV: (self.n_real[..., None] / n_uavs).log() - LOG_TASKS_PER_UAV_OFFSET,
            FleetFeature.FLEET_SIZE: self.n_real.new_full((), 1.0 / n_uavs),
            FleetFeature.N_EMPTY: empty.mean(-1, keepdim=True),
        }
        return stack_features(FleetFeature, fields, load)

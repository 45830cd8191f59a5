"""Measures of how a task fits the UAVs of a fleet, as inputs of the allocator."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch as th
from torch.nn import functional

from sb3_uav.envs.instances import euclidean
from sb3_uav.policies.geometry import (
    FAR_SCALE,
    FARTHEST,
    NEAR,
    SHORT_SCALE,
    log_ratio,
    scaled_coordinates,
    stack_features,
    task_distances,
)
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.world import LONGEST_SOLO, World

# How many of the nearest earlier tasks count as the neighbors of a task.
_N_NEIGHBORS = 8
# Fraction of its share of the tasks from which a UAV counts as full.
_FULL = 0.95
# A UAV that can serve nothing counts as if it flew this part of the mean distance, so that its load stays a moderate number.
_LEAST_CAPACITY = 0.1
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


# What networks with ``whole`` see beside them. The weights in existing zips depend on this order.
WholeFleetFeature = IntEnum(
    "WholeFleetFeature",
    # Which part of the UAV's maximum distance it flies for the task alone, whether that is too far, and the logarithm of the
    # ratio of that part to that of the best placed UAV.
    "SOLO TOO_FAR RELATIVE_SOLO "
    # Distances from the UAV's start and to its end; its maximum distance, relative to the mean.
    "START END REACH "
    # Value that the UAV would have, in fair shares.
    "VALUE_LOAD "
    # The same for all UAVs: logarithm of the task's value, service cost, and which part of all value has been assigned.
    "LOG_VALUE SERVICE VALUE_PROGRESS",
    start=0,
)


class FleetState(NamedTuple):
    """
    Where the UAVs' tasks lie. A UAV without tasks has only zeros, apart from the box.

    :param n_tasks: ``(batch, n_samples, n_uavs)``, how many
    :param total: ``(batch, n_samples, n_uavs, 2)``, sum of their coordinates
    :param last: ``(batch, n_samples, n_uavs, 2)``, coordinates of the last one
    :param box: ``(batch, n_samples, n_uavs, 4)``, the largest x, y, -x, -y of them and of start and end
    :param value: ``(batch, n_samples, n_uavs)``, total value of the tasks; zeros where networks do not see it
    """

    n_tasks: th.Tensor
    total: th.Tensor
    last: th.Tensor
    box: th.Tensor
    value: th.Tensor


class FleetGeometry(NamedTuple):
    """
    Precomputed distances for the features of tasks and UAVs.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param neighbors: ``(batch, n_tasks, n_neighbors)`` int64, the nearest tasks of a task among those before it
    :param neighbor_distance: ``(batch, n_tasks, n_neighbors)``, ``FARTHEST`` where there are fewer
    :param n_real: ``(batch, 1)``, number of real tasks
    :param world: The rest of the whole problem; None for networks that see only the paper's
    :param solo: ``(batch, n_uavs, n_tasks)``, see :meth:`World.solo`; None with it
    """

    coordinates: th.Tensor
    neighbors: th.Tensor
    neighbor_distance: th.Tensor
    n_real: th.Tensor
    world: World | None = None
    solo: th.Tensor | None = None

    @property
    def tasks(self) -> th.Tensor:
        """``(batch, n_tasks, 2)``."""
        return self.coordinates[:, 1:]

    @classmethod
    def of(cls, static: StaticObservation, whole: bool = False) -> FleetGeometry:
        """
        :param static: ``batch`` instances
        :param whole: Whether to add what the whole problem takes
        """
        coordinates = scaled_coordinates(static, whole)
        n_tasks = static.task_mask.shape[1]
        later = th.ones(n_tasks, n_tasks, dtype=th.bool, device=coordinates.device).triu()
        distance = task_distances(coordinates, static.task_mask).masked_fill(later, 2 * FARTHEST)
        near, neighbors = distance.topk(min(_N_NEIGHBORS, n_tasks), largest=False)
        world = World.of(static) if whole else None
        solo = None
        if world is not None:
            solo = world.solo(coordinates[:, 1:]).masked_fill(~static.task_mask[:, None], LONGEST_SOLO)
        n_real = static.task_mask.sum(1, keepdim=True).clamp(min=1).float()
        return cls(coordinates, neighbors, near, n_real, world, solo)

    def initial(self, n_samples: int, n_uavs: int) -> FleetState:
        """
        :param n_samples: Episodes per instance
        :param n_uavs: Size of the fleet
        :return: A fleet without tasks
        """
        count = self.coordinates.new_zeros(len(self.coordinates), n_samples, n_uavs)
        total = count[..., None].repeat(1, 1, 1, 2)
        box = count[..., None].repeat(1, 1, 1, 4)
        if self.world is not None:
            box = box + self._first_box()[:, None]
        return FleetState(count, total, total.clone(), box, count)

    def _first_box(self) -> th.Tensor:
        """:return: ``(batch, n_uavs or 1, 4)``, the box around start and end of each UAV"""
        assert self.world is not None
        start, end = self.world.start, self.world.end
        return th.cat([start.maximum(end), (-start).maximum(-end)], dim=-1)

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
            fleet.value if self.world is None else fleet.value + self.world.value[:, None, None, task] * mine.squeeze(-1),
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
        count = added.cumsum(2).to(points.dtype)
        box, value = (th.cat([points, -points], dim=-1) * held).cummax(2).values, count
        if self.world is not None:
            corners = th.where(held, th.cat([points, -points], dim=-1), -th.inf)
            box = corners.cummax(2).values.maximum(self._first_box()[:, None, None])
            value = (functional.pad(self.world.value, (1, 0))[:, None, :, None] * added).cumsum(2)
        return FleetState(count, (points * held).cumsum(2), rows.gather(2, newest[..., None].expand_as(rows)), box, value)

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
        count = mine.sum(2).to(points.dtype)
        box, value = (signed * held).amax(2).clamp(min=0.0), count
        if self.world is not None:
            box = th.where(held, signed, -th.inf).amax(2).maximum(self._first_box()[:, None])
            value = (self.world.value[:, None, :, None] * mine).sum(2)
        return FleetState(
            count,
            (points * held).sum(2),
            rows.gather(2, newest[:, :, None, :, None].expand(-1, -1, 1, -1, 2)).squeeze(2),
            box,
            value,
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
        if self.world is not None:
            # A UAV's fair share is as large as its part of all distances.
            per_task = per_task / self._capacity()[:, None]
        load = (fleet.n_tasks + 1) * per_task
        empty = (fleet.n_tasks == 0).to(load.dtype)
        centroid = fleet.total / fleet.n_tasks.clamp(min=1.0)[..., None]
        # Where the UAV is seen from: midway between its start and its end.
        origin = th.zeros_like(point) if self.world is None else self.world.middle[:, None]
        here, middle = point - origin, centroid - origin
        home = th.linalg.vector_norm(here, dim=-1)
        towards = (here * middle).sum(-1) / (home * th.linalg.vector_norm(middle, dim=-1)).clamp(min=NEAR**2)
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
        features = stack_features(FleetFeature, fields, load)
        return features if self.world is None else th.cat([features, self._whole_features(fleet, task, point)], dim=-1)

    def _capacity(self) -> th.Tensor:
        """:return: ``(batch, n_uavs or 1)``, how far each UAV flies relative to the mean; nearly 0 if it can serve nothing"""
        assert self.world is not None and self.solo is not None
        able = self.world.reach * (self.solo <= 1).any(-1)
        return (able / able.mean(1, keepdim=True).clamp(min=NEAR)).clamp(min=_LEAST_CAPACITY)

    def _whole_features(self, fleet: FleetState, task: th.Tensor, point: th.Tensor) -> th.Tensor:
        """
        :param fleet: The fleet before the task
        :param task: ``(batch, n_samples)`` int64
        :param point: ``(batch, n_samples, 1, 2)``, where it is
        :return: ``(batch, n_samples, n_uavs, len(WholeFleetFeature))``
        """
        assert self.world is not None and self.solo is not None
        world, n_uavs = self.world, fleet.n_tasks.shape[-1]
        solo = self.solo.gather(2, task[:, None].expand(-1, self.solo.shape[1], -1)).transpose(1, 2)
        value, service, log_value = (
            field.gather(1, task)[..., None] for field in (world.value, world.service, world.log_value)
        )
        total = world.value.sum(1)[:, None, None].clamp(min=NEAR)
        fields = {
            WholeFleetFeature.SOLO: solo,
            WholeFleetFeature.TOO_FAR: (solo > 1).to(solo.dtype),
            WholeFleetFeature.RELATIVE_SOLO: log_ratio(solo, solo.amin(-1, keepdim=True)),
            WholeFleetFeature.START: FAR_SCALE * euclidean(point, world.start[:, None]),
            WholeFleetFeature.END: FAR_SCALE * euclidean(point, world.end[:, None]),
            WholeFleetFeature.REACH: self._capacity()[:, None],
            WholeFleetFeature.VALUE_LOAD: (fleet.value + value) / total * n_uavs / self._capacity()[:, None],
            WholeFleetFeature.LOG_VALUE: log_value,
            WholeFleetFeature.SERVICE: SHORT_SCALE * service,
            WholeFleetFeature.VALUE_PROGRESS: fleet.value.sum(-1, keepdim=True) / total,
        }
        return stack_features(WholeFleetFeature, fields, fleet.n_tasks)

"""
Distances that the networks are told instead of having to learn them, all in units of the maximum flight distance.

In these units one network serves every maximum flight distance, and a task that can be reached lies within 0.5 of the depot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch as th
from torch.nn import functional

from sb3_uav.envs.distances import euclidean

if TYPE_CHECKING:
    from sb3_uav.policies.encoder import StaticObservation

# Beyond this nothing can be reached, so where exactly a task lies does not matter, nor does the magnitude of the numbers.
FARTHEST = 1.0
# Distances below this are as good as 0.
NEAR = 1e-3
# How many tasks count as the neighbourhood of a task.
N_DENSITY, N_NEIGHBOURS, N_NEXT = 4, 8, 16

# From which part of its share of the tasks on a UAV counts as full.
FULL = 0.95

N_NODE_FEATURES = 8
N_MOVE_FEATURES = 15
N_FLEET_FEATURES = 16


def scaled_coordinates(static: StaticObservation) -> th.Tensor:
    """
    :param static: ``batch`` instances
    :return: ``(batch, n_tasks + 1, 2)``, depot first, relative to it; padded tasks lie in the depot
    """
    relative = (static.tasks - static.depot[:, None]) / static.max_distance[..., None]
    tasks = relative.clamp(-FARTHEST, FARTHEST).masked_fill(~static.task_mask[..., None], 0.0)
    return th.cat([th.zeros_like(tasks[:, :1]), tasks], dim=1)


def task_distances(coordinates: th.Tensor, task_mask: th.Tensor) -> th.Tensor:
    """
    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param task_mask: ``(batch, n_tasks)`` bool
    :return: ``(batch, n_tasks, n_tasks)``, from each task to each other real one; ``FARTHEST`` at most, also to itself
    """
    tasks = coordinates[:, 1:]
    distance = euclidean(tasks[:, :, None], tasks[:, None]).clamp(max=FARTHEST)
    distance = distance.masked_fill(~task_mask[:, None], FARTHEST)
    return distance.diagonal_scatter(distance.new_full(task_mask.shape, FARTHEST), dim1=1, dim2=2)


def smallest(distance: th.Tensor, n_smallest: int) -> th.Tensor:
    """
    :param distance: ``(..., n)``
    :param n_smallest: How many to find
    :return: ``(..., n_smallest)``, the smallest, ``FARTHEST`` where there are fewer, because padding must not change anything
    """
    found = distance.topk(min(n_smallest, distance.shape[-1]), largest=False).values
    return functional.pad(found, (0, n_smallest - found.shape[-1]), value=FARTHEST)


def node_features(coordinates: th.Tensor, task_mask: th.Tensor) -> th.Tensor:
    """
    What the encoder is told of every task: its place, and how dense the tasks are around it.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param task_mask: ``(batch, n_tasks)`` bool
    :return: ``(batch, n_tasks, N_NODE_FEATURES)``
    """
    tasks = coordinates[:, 1:]
    home = th.linalg.vector_norm(tasks, dim=-1, keepdim=True)
    nearest = smallest(task_distances(coordinates, task_mask), N_DENSITY)
    density = th.stack([nearest[..., 0], nearest.mean(-1)], dim=-1).clamp(min=NEAR).log() + 3.0
    return th.cat([4 * tasks, 4 * home, 8 * home**2, tasks / home.clamp(min=NEAR), density], dim=-1)


class MoveGeometry(NamedTuple):
    """
    What the router needs to measure a UAV's next moves.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param home: ``(batch, n_tasks + 1)``, distance to the depot
    :param neighbours: ``(batch, n_tasks, n_next)`` int64, the nearest other tasks
    :param neighbour_distance: ``(batch, n_tasks, n_next)``, ``FARTHEST`` where there are fewer
    :param neighbour_home: ``(batch, n_tasks, n_next)``, their distance to the depot
    """

    coordinates: th.Tensor
    home: th.Tensor
    neighbours: th.Tensor
    neighbour_distance: th.Tensor
    neighbour_home: th.Tensor

    @classmethod
    def of(cls, static: StaticObservation) -> MoveGeometry:
        """:param static: ``batch`` instances"""
        coordinates = scaled_coordinates(static)
        distance = task_distances(coordinates, static.task_mask)
        near, neighbours = distance.topk(min(N_NEXT, distance.shape[1]), largest=False)
        home = th.linalg.vector_norm(coordinates, dim=-1)
        neighbour_home = home[:, 1:].gather(1, neighbours.flatten(1)).view_as(near)
        return cls(coordinates, home, neighbours, near, neighbour_home)

    def features(self, position: th.Tensor, remaining: th.Tensor, action_mask: th.Tensor) -> th.Tensor:
        """
        :param position: ``(batch, n_samples)`` int64, the node where the UAV is
        :param remaining: ``(batch, n_samples)``, what it can still fly, in units of the maximum
        :param action_mask: ``(batch, n_samples, n_tasks + 1)`` bool
        :return: ``(batch, n_samples, n_tasks + 1, N_MOVE_FEATURES)``: distance, logarithm of its ratio to that of the nearest
            feasible node, distance home from there, slack left after it, detour, remaining distance, distance home from here;
            whether the move leads on to others that can still be visited after it: the distance to the nearest of them,
            logarithm of its ratio to the distance of the move, mean distance of the three nearest, parts of the 4 and the 16
            nearest; how many tasks can be visited now, and the part of them on the side of the node, seen from the line
            between depot and UAV; cosine of the angle between the two, seen from the depot
        """
        here = self.coordinates.gather(1, position[..., None].expand(-1, -1, 2))
        distance = euclidean(self.coordinates[:, None], here[:, :, None])
        nearest = distance.masked_fill(~action_mask, FARTHEST).amin(-1, keepdim=True)
        home = self.home[:, None]
        home_here = self.home.gather(1, position)[..., None]
        left = remaining[..., None]
        slack = (left - distance - home).clamp(min=-FARTHEST)

        # Which neighbours of each node can still be visited after it.
        shape = (*action_mask.shape[:2], *self.neighbours.shape[1:])
        index = self.neighbours.flatten(1)[:, None].expand(-1, shape[1], -1)
        near = self.neighbour_distance[:, None]
        there = self.neighbour_home[:, None]
        is_near = (near < FARTHEST) & (near + there <= (left - distance)[..., 1:, None])
        is_open = is_near & action_mask[..., 1:].gather(2, index).view(shape)
        three = smallest(th.where(is_open, near, FARTHEST), 3)
        onward = functional.pad(three[..., 0], (1, 0), value=FARTHEST)
        cluster = functional.pad(three.clamp(max=0.25).mean(-1), (1, 0), value=0.25)
        few = functional.pad(is_open[..., :4].sum(-1).to(distance.dtype) / 4, (1, 0))
        many = functional.pad(is_open.sum(-1).to(distance.dtype) / N_NEXT, (1, 0))

        feasible = action_mask.clone()
        feasible[..., 0] = False
        count = feasible.sum(-1, keepdim=True).to(distance.dtype)
        x, y = self.coordinates[:, None].unbind(-1)
        side = (here[..., :1] * y - here[..., 1:] * x).sign()
        on_left = ((side > 0) & feasible).sum(-1, keepdim=True) / count.clamp(min=1)
        on_side = th.where(side > 0, on_left, th.where(side < 0, 1 - on_left, 0.5))
        angle = (here[..., :1] * x + here[..., 1:] * y) / (home * home_here).clamp(min=NEAR**2)
        fields = (
            8 * distance,
            log_ratio(distance, nearest),
            4 * home,
            4 * slack,
            4 * (distance + home - home_here),
            left,
            4 * home_here,
            8 * onward.clamp(max=0.25),
            log_ratio(onward, distance),
            8 * cluster,
            few,
            many,
            (count + 1).log() / 3,
            on_side,
            angle.clamp(-1, 1),
        )
        return th.stack([field.expand_as(distance) for field in fields], dim=-1)


def log_ratio(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """
    :param a: Distances
    :param b: Distances, broadcast against ``a``
    :return: Logarithm of their ratio, at most 5 in magnitude
    """
    return ((a + NEAR).log() - (b + NEAR).log()).clamp(-5.0, 5.0)


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
    What the allocator needs to measure how a task fits to the UAVs.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param neighbours: ``(batch, n_tasks, n_neighbours)`` int64, the nearest tasks of a task among those before it
    :param neighbour_distance: ``(batch, n_tasks, n_neighbours)``, ``FARTHEST`` where there are fewer
    :param n_real: ``(batch, 1)``, number of real tasks
    """

    coordinates: th.Tensor
    neighbours: th.Tensor
    neighbour_distance: th.Tensor
    n_real: th.Tensor

    @classmethod
    def of(cls, static: StaticObservation) -> FleetGeometry:
        """:param static: ``batch`` instances"""
        coordinates = scaled_coordinates(static)
        n_tasks = static.task_mask.shape[1]
        later = th.ones(n_tasks, n_tasks, dtype=th.bool, device=coordinates.device).triu()
        distance = task_distances(coordinates, static.task_mask).masked_fill(later, 2 * FARTHEST)
        near, neighbours = distance.topk(min(N_NEIGHBOURS, n_tasks), largest=False)
        return cls(coordinates, neighbours, near, static.task_mask.sum(1, keepdim=True).clamp(min=1).float())

    @property
    def tasks(self) -> th.Tensor:
        """``(batch, n_tasks, 2)``."""
        return self.coordinates[:, 1:]

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
        :param mine: ``(batch, n_samples, n_uavs)`` bool, whose it becomes
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
        :param mine: ``(batch, n_samples, n_tasks, n_uavs)`` bool, whose task each is
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
        :param mine: ``(batch, n_samples, n_tasks, n_uavs)`` bool, whose task each is; of nobody if it has no UAV yet
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
        :return: ``(batch, n_samples, n_neighbours)``, the UAVs of the task's :attr:`neighbours`
        """
        index = task[..., None].expand(-1, -1, self.neighbours.shape[-1])
        return assignment.gather(-1, self.neighbours.gather(1, index))

    def all_owners(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: ``(batch, n_samples, n_tasks)`` int64, the UAV of each task
        :return: ``(batch, n_samples * n_tasks, n_neighbours)``, the same for all tasks of all samples
        """
        index = self.neighbours.flatten(1)[:, None].expand(-1, actions.shape[1], -1)
        return actions.gather(-1, index).view(len(actions), -1, self.neighbours.shape[-1])

    def features(self, fleet: FleetState, task: th.Tensor, owners: th.Tensor) -> th.Tensor:
        """
        :param fleet: The fleet before the task
        :param task: ``(batch, n_samples)`` int64
        :param owners: ``(batch, n_samples, n_neighbours)`` int64, the UAVs of the task's :attr:`neighbours`
        :return: ``(batch, n_samples, n_uavs, N_FLEET_FEATURES)``
        """
        n_uavs = fleet.n_tasks.shape[-1]
        point = self.tasks.gather(1, task[..., None].expand(-1, -1, 2))[:, :, None]
        uavs = th.arange(n_uavs, device=task.device)[:, None]
        index = task[..., None].expand(-1, -1, self.neighbours.shape[-1])
        distance = self.neighbour_distance.gather(1, index)[:, :, None]
        theirs = (owners[:, :, None] == uavs) & (distance < FARTHEST)
        nearest = th.where(theirs, distance, FARTHEST).amin(-1)
        votes = theirs.sum(-1) / theirs.any(2).sum(-1, keepdim=True).clamp(min=1)

        per_task = n_uavs / self.n_real[..., None]
        load = (fleet.n_tasks + 1) * per_task
        empty = (fleet.n_tasks == 0).to(load.dtype)
        centroid = fleet.total / fleet.n_tasks.clamp(min=1.0)[..., None]
        home = th.linalg.vector_norm(point, dim=-1)
        towards = (point * centroid).sum(-1) / (home * th.linalg.vector_norm(centroid, dim=-1)).clamp(min=NEAR**2)
        grown = fleet.box.maximum(th.cat([point, -point], dim=-1))
        perimeter = fleet.box.sum(-1)
        relative = log_ratio(nearest, nearest.amin(-1, keepdim=True))
        fields = (
            load,
            (load - FULL).clamp(min=0.0),
            empty,
            votes,
            relative,
            4 * nearest,
            4 * euclidean(point, centroid) * (1 - empty),
            4 * euclidean(point, fleet.last) * (1 - empty),
            4 * perimeter,
            4 * (grown.sum(-1) - perimeter),
            towards.clamp(-1.0, 1.0),
            4 * home,
            task[..., None] / self.n_real[..., None],
            (self.n_real[..., None] / n_uavs).log() - 3.0,
            self.n_real.new_full((), 1.0 / n_uavs),
            empty.mean(-1, keepdim=True),
        )
        return th.stack([field.expand_as(load) for field in fields], dim=-1)

"""
Distances and their kin as inputs of the networks, which then need not learn them, in units of the maximum flight distance.

In these units one network serves every maximum flight distance, and a task that can be reached lies within 0.5 of the depot.
Factors and offsets bring each feature to a magnitude of about 1 where D = 2 on the unit square, the paper's distribution.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum, auto
from typing import NamedTuple, TypeVar

import torch as th
from torch.nn import functional

from sb3_uav.envs.instances import euclidean
from sb3_uav.policies.static_observation import StaticObservation

# Beyond this nothing can be reached, so where exactly a task lies does not matter, nor does the magnitude of the numbers.
FARTHEST = 1.0
# Distances below this are as good as 0.
NEAR = 1e-3
# How many tasks count as the neighborhood of a task.
N_DENSITY, N_NEIGHBORS, N_NEXT = 4, 8, 16
# Of the N_NEXT nearest tasks, those whose mean distance and whose share are features of their own.
N_CLUSTER, N_FEW = 3, 4
# From which part of its share of the tasks on a UAV counts as full.
FULL = 0.95

# Reachable tasks lie within 0.5 of the depot, 0.25 on average.
FAR_SCALE = 4
# Moves between neighbors are shorter: about 0.1.
SHORT_SCALE = 8
# Distances to where a move leads on to are capped here, so that "nothing left" is not farther than "far away".
FARTHEST_NEXT = 0.25
# Minus the logarithm of about 0.05, a common distance to the nearest task.
LOG_DENSITY_OFFSET = 3.0
# Logarithm of about 20, a common number of tasks per UAV.
LOG_TASKS_PER_UAV_OFFSET = 3.0
# The logarithm of the number of feasible tasks is divided by this, that of about 20.
LOG_COUNT_SCALE = 3
# Largest logarithm of a ratio of distances: a factor of 150.
LOG_RATIO_LIMIT = 5.0


class NodeFeature(IntEnum):
    """Features of a task in the encoder. The zips that exist depend on the order: append only."""

    X = 0
    Y = auto()
    HOME = auto()
    HOME_SQUARED = auto()
    DIRECTION_X = auto()
    DIRECTION_Y = auto()
    NEAREST = auto()
    DENSITY = auto()


class MoveFeature(IntEnum):
    """Features of a move in the router. The zips that exist depend on the order: append only."""

    # Length of the move, and logarithm of its ratio to that of the nearest feasible node.
    DISTANCE = 0
    RELATIVE_DISTANCE = auto()
    # From there to the depot, distance left after flying there and home, and what the move adds to the way home.
    HOME = auto()
    SLACK = auto()
    DETOUR = auto()
    # The same for every move: distance left, and distance from here to the depot.
    REMAINING = auto()
    HOME_HERE = auto()
    # Tasks that can still be visited after the move: distance from there to the nearest, logarithm of its ratio to the
    # length of the move, mean distance of the N_CLUSTER nearest, and which part of the N_FEW and of the N_NEXT nearest tasks.
    ONWARD = auto()
    RELATIVE_ONWARD = auto()
    CLUSTER = auto()
    OPEN_FEW = auto()
    OPEN_MANY = auto()
    # How many tasks can be visited now, and which part of them lies on the same side of the line from the depot to here.
    N_FEASIBLE = auto()
    ON_SIDE = auto()
    # Cosine of the angle between here and there, seen from the depot.
    ANGLE = auto()


class FleetFeature(IntEnum):
    """Features of a task and a UAV in the allocator. The zips that exist depend on the order: append only."""

    # Tasks that the UAV would have, in fair shares; what exceeds FULL of that; and whether it has none yet.
    LOAD = 0
    OVERLOAD = auto()
    EMPTY = auto()
    # Which part of the task's neighbors the UAV has; the distance to the nearest of them, relative to the nearest of any UAV.
    VOTES = auto()
    RELATIVE_DISTANCE = auto()
    NEAREST = auto()
    # Distances to the centroid of the UAV's tasks and to the last of them.
    CENTROID = auto()
    LAST = auto()
    # Half the perimeter of the box around its tasks and the depot, and what the task adds to that.
    PERIMETER = auto()
    GROWTH = auto()
    # Cosine of the angle between task and centroid, seen from the depot.
    TOWARDS = auto()
    # The same for all UAVs: distance to the depot, progress, tasks per UAV, fleet size, and UAVs without tasks.
    HOME = auto()
    PROGRESS = auto()
    TASKS_PER_UAV = auto()
    FLEET_SIZE = auto()
    N_EMPTY = auto()


FeatureT = TypeVar("FeatureT", bound=IntEnum)


def stack_features(kind: type[FeatureT], fields: Mapping[FeatureT, th.Tensor], like: th.Tensor) -> th.Tensor:
    """
    :param kind: Which features, in their order
    :param fields: All of them, each broadcast against ``like``
    :param like: A tensor of the common shape
    :return: ``(..., len(kind))``
    """
    return th.stack([fields[feature].expand_as(like) for feature in kind], dim=-1)


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
    Features of every task in the encoder: its place, and how dense the tasks are around it.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param task_mask: ``(batch, n_tasks)`` bool
    :return: ``(batch, n_tasks, len(NodeFeature))``
    """
    tasks = coordinates[:, 1:]
    home = th.linalg.vector_norm(tasks, dim=-1, keepdim=True)
    nearest = smallest(task_distances(coordinates, task_mask), N_DENSITY)
    density = th.stack([nearest[..., 0], nearest.mean(-1)], dim=-1).clamp(min=NEAR).log() + LOG_DENSITY_OFFSET
    direction = tasks / home.clamp(min=NEAR)
    home = home.squeeze(-1)
    fields = {
        NodeFeature.X: FAR_SCALE * tasks[..., 0],
        NodeFeature.Y: FAR_SCALE * tasks[..., 1],
        NodeFeature.HOME: FAR_SCALE * home,
        NodeFeature.HOME_SQUARED: SHORT_SCALE * home**2,
        NodeFeature.DIRECTION_X: direction[..., 0],
        NodeFeature.DIRECTION_Y: direction[..., 1],
        NodeFeature.NEAREST: density[..., 0],
        NodeFeature.DENSITY: density[..., 1],
    }
    return stack_features(NodeFeature, fields, home)


class MoveGeometry(NamedTuple):
    """
    What the router needs to measure a UAV's next moves.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param home: ``(batch, n_tasks + 1)``, distance to the depot
    :param neighbors: ``(batch, n_tasks, n_next)`` int64, the nearest other tasks
    :param neighbor_distance: ``(batch, n_tasks, n_next)``, ``FARTHEST`` where there are fewer
    :param neighbor_home: ``(batch, n_tasks, n_next)``, their distance to the depot
    """

    coordinates: th.Tensor
    home: th.Tensor
    neighbors: th.Tensor
    neighbor_distance: th.Tensor
    neighbor_home: th.Tensor

    @classmethod
    def of(cls, static: StaticObservation) -> MoveGeometry:
        """:param static: ``batch`` instances"""
        coordinates = scaled_coordinates(static)
        distance = task_distances(coordinates, static.task_mask)
        near, neighbors = distance.topk(min(N_NEXT, distance.shape[1]), largest=False)
        home = th.linalg.vector_norm(coordinates, dim=-1)
        neighbor_home = home[:, 1:].gather(1, neighbors.flatten(1)).view_as(near)
        return cls(coordinates, home, neighbors, near, neighbor_home)

    def features(self, position: th.Tensor, remaining: th.Tensor, action_mask: th.Tensor) -> th.Tensor:
        """
        :param position: ``(batch, n_samples)`` int64, the node where the UAV is
        :param remaining: ``(batch, n_samples)``, what it can still fly, in units of the maximum
        :param action_mask: ``(batch, n_samples, n_tasks + 1)`` bool
        :return: ``(batch, n_samples, n_tasks + 1, len(MoveFeature))``
        """
        here = self.coordinates.gather(1, position[..., None].expand(-1, -1, 2))
        distance = euclidean(self.coordinates[:, None], here[:, :, None])
        nearest = distance.masked_fill(~action_mask, FARTHEST).amin(-1, keepdim=True)
        home = self.home[:, None]
        home_here = self.home.gather(1, position)[..., None]
        left = remaining[..., None]
        slack = (left - distance - home).clamp(min=-FARTHEST)

        # Which neighbors of each node can still be visited after it.
        shape = (*action_mask.shape[:2], *self.neighbors.shape[1:])
        index = self.neighbors.flatten(1)[:, None].expand(-1, shape[1], -1)
        near = self.neighbor_distance[:, None]
        there = self.neighbor_home[:, None]
        is_near = (near < FARTHEST) & (near + there <= (left - distance)[..., 1:, None])
        is_open = is_near & action_mask[..., 1:].gather(2, index).view(shape)
        nearest_open = smallest(th.where(is_open, near, FARTHEST), N_CLUSTER)
        onward = functional.pad(nearest_open[..., 0], (1, 0), value=FARTHEST)
        cluster = functional.pad(nearest_open.clamp(max=FARTHEST_NEXT).mean(-1), (1, 0), value=FARTHEST_NEXT)
        few = functional.pad(is_open[..., :N_FEW].sum(-1).to(distance.dtype) / N_FEW, (1, 0))
        many = functional.pad(is_open.sum(-1).to(distance.dtype) / N_NEXT, (1, 0))

        feasible = action_mask.clone()
        feasible[..., 0] = False
        count = feasible.sum(-1, keepdim=True).to(distance.dtype)
        x, y = self.coordinates[:, None].unbind(-1)
        side = (here[..., :1] * y - here[..., 1:] * x).sign()
        on_left = ((side > 0) & feasible).sum(-1, keepdim=True) / count.clamp(min=1)
        on_side = th.where(side > 0, on_left, th.where(side < 0, 1 - on_left, 0.5))
        angle = (here[..., :1] * x + here[..., 1:] * y) / (home * home_here).clamp(min=NEAR**2)
        fields = {
            MoveFeature.DISTANCE: SHORT_SCALE * distance,
            MoveFeature.RELATIVE_DISTANCE: log_ratio(distance, nearest),
            MoveFeature.HOME: FAR_SCALE * home,
            MoveFeature.SLACK: FAR_SCALE * slack,
            MoveFeature.DETOUR: FAR_SCALE * (distance + home - home_here),
            MoveFeature.REMAINING: left,
            MoveFeature.HOME_HERE: FAR_SCALE * home_here,
            MoveFeature.ONWARD: SHORT_SCALE * onward.clamp(max=FARTHEST_NEXT),
            MoveFeature.RELATIVE_ONWARD: log_ratio(onward, distance),
            MoveFeature.CLUSTER: SHORT_SCALE * cluster,
            MoveFeature.OPEN_FEW: few,
            MoveFeature.OPEN_MANY: many,
            MoveFeature.N_FEASIBLE: (count + 1).log() / LOG_COUNT_SCALE,
            MoveFeature.ON_SIDE: on_side,
            MoveFeature.ANGLE: angle.clamp(-1, 1),
        }
        return stack_features(MoveFeature, fields, distance)


def log_ratio(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """
    :param a: Distances
    :param b: Distances, broadcast against ``a``
    :return: Logarithm of their ratio, limited to ``LOG_RATIO_LIMIT`` in magnitude
    """
    return ((a + NEAR).log() - (b + NEAR).log()).clamp(-LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)


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
    :param neighbors: ``(batch, n_tasks, n_neighbors)`` int64, the nearest tasks of a task among those before it
    :param neighbor_distance: ``(batch, n_tasks, n_neighbors)``, ``FARTHEST`` where there are fewer
    :param n_real: ``(batch, 1)``, number of real tasks
    """

    coordinates: th.Tensor
    neighbors: th.Tensor
    neighbor_distance: th.Tensor
    n_real: th.Tensor

    @classmethod
    def of(cls, static: StaticObservation) -> FleetGeometry:
        """:param static: ``batch`` instances"""
        coordinates = scaled_coordinates(static)
        n_tasks = static.task_mask.shape[1]
        later = th.ones(n_tasks, n_tasks, dtype=th.bool, device=coordinates.device).triu()
        distance = task_distances(coordinates, static.task_mask).masked_fill(later, 2 * FARTHEST)
        near, neighbors = distance.topk(min(N_NEIGHBORS, n_tasks), largest=False)
        return cls(coordinates, neighbors, near, static.task_mask.sum(1, keepdim=True).clamp(min=1).float())

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
        votes = theirs.sum(-1) / theirs.any(2).sum(-1, keepdim=True).clamp(min=1)

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
            FleetFeature.OVERLOAD: (load - FULL).clamp(min=0.0),
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

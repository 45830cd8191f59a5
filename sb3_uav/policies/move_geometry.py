"""Measures of a UAV's next moves, as inputs of the router."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch as th
from torch.nn import functional

from sb3_uav.envs.instances import euclidean
from sb3_uav.policies.geometry import (
    FAR_SCALE,
    FARTHEST,
    LOG_RATIO_LIMIT,
    NEAR,
    SHORT_SCALE,
    log_ratio,
    scaled_coordinates,
    smallest,
    stack_features,
    task_distances,
)
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.world import World

# How many of the nearest tasks of a node count as what a move leads on to.
N_NEXT = 16
# Of them, those whose mean distance and those whose share are features of their own.
_N_CLUSTER, _N_FEW = 3, 4
# Distances to where a move leads on to are capped here, so that "nothing left" is not farther than "far away".
FARTHEST_NEXT = 0.25
# The logarithm of the number of feasible tasks is divided by this, that of about 20.
_LOG_COUNT_SCALE = 3


# Features of a move in the router. The weights in existing zips depend on this order.
MoveFeature = IntEnum(
    "MoveFeature",
    # Length of the move, and logarithm of its ratio to that of the nearest feasible node.
    "DISTANCE RELATIVE_DISTANCE "
    # From there to the depot, distance left after flying there and home, and what the move adds to the way home.
    "HOME SLACK DETOUR "
    # The same for every move: distance left, and distance from here to the depot.
    "REMAINING HOME_HERE "
    # Tasks that can still be visited after the move: distance from there to the nearest, logarithm of its ratio to the
    # length of the move, mean distance of the N_CLUSTER nearest, and which part of the N_FEW and of the N_NEXT nearest tasks.
    "ONWARD RELATIVE_ONWARD CLUSTER OPEN_FEW OPEN_MANY "
    # How many tasks can be visited now, and which part of them lies on the same side of the line from the depot to here.
    "N_FEASIBLE ON_SIDE "
    # Cosine of the angle between here and there, seen from the depot.
    "ANGLE",
    start=0,
)


# What networks with ``whole`` see of a move beside them. The weights in existing zips depend on this order.
WholeMoveFeature = IntEnum(
    "WholeMoveFeature",
    # Logarithm of the task's value, relative to the mean of the instance and to the greatest feasible one.
    "LOG_VALUE RELATIVE_VALUE "
    # Logarithms of value per length of the move and per detour, relative to the best feasible task.
    "WORTH WORTH_OF_DETOUR "
    # Service cost, and which part of the remaining distance the move with all that it costs takes.
    "SERVICE SPENT "
    # Of the tasks that can still be visited after it: the best value per length of a next move, relative to the best that
    # there is now, and which part of all value is that of the nearest.
    "ONWARD_WORTH OPEN_VALUE "
    # The same for every move: logarithm of the value that can be visited now, in mean values.
    "VALUE_LEFT",
    start=0,
)


class MoveWorth(NamedTuple):
    """
    What the whole problem adds to the geometry of moves.

    :param start: ``(batch, 1, 2)``, where the UAV starts
    :param value: ``(batch, n_tasks + 1)``, relative to the mean of the instance; 0 for the depot
    :param log_value: ``(batch, n_tasks + 1)``, its logarithm
    :param service: ``(batch, n_tasks + 1)``
    :param neighbor_value: ``(batch, n_tasks, n_next)``, that of the nearest other tasks
    :param neighbor_log_value: ``(batch, n_tasks, n_next)``
    :param neighbor_service: ``(batch, n_tasks, n_next)``
    """

    start: th.Tensor
    value: th.Tensor
    log_value: th.Tensor
    service: th.Tensor
    neighbor_value: th.Tensor
    neighbor_log_value: th.Tensor
    neighbor_service: th.Tensor

    @classmethod
    def of(cls, world: World, neighbors: th.Tensor) -> MoveWorth:
        """
        :param world: The instances, one UAV each
        :param neighbors: ``(batch, n_tasks, n_next)`` int64, the nearest other tasks
        """
        fields = (world.value, world.log_value, world.service)
        near = (field.gather(1, neighbors.flatten(1)).view(neighbors.shape) for field in fields)
        return cls(world.start[:, :1], *(functional.pad(field, (1, 0)) for field in fields), *near)

    def features(
        self,
        distance: th.Tensor,
        detour: th.Tensor,
        left: th.Tensor,
        feasible: th.Tensor,
        near: th.Tensor,
        is_open: th.Tensor,
    ) -> th.Tensor:
        """
        :param distance: ``(batch, n_samples, n_tasks + 1)``, length of each move
        :param detour: ``(batch, n_samples, n_tasks + 1)``, what it adds to the way home
        :param left: ``(batch, n_samples, 1)``, remaining distance
        :param feasible: ``(batch, n_samples, n_tasks + 1)`` bool, tasks that can be visited
        :param near: ``(batch, 1, n_tasks, n_next)``, distances from each task to the nearest others
        :param is_open: ``(batch, n_samples, n_tasks, n_next)`` bool, which of them can be visited after it
        :return: ``(batch, n_samples, n_tasks + 1, len(WholeMoveFeature))``
        """
        service, log_value = self.service[:, None], self.log_value[:, None]
        none = ~feasible.any(-1, keepdim=True)

        def relative(logarithm: th.Tensor) -> th.Tensor:
            best = logarithm.masked_fill(~feasible, -th.inf).amax(-1, keepdim=True).masked_fill(none, 0.0)
            return (logarithm - best).clamp(-LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)

        worth = log_value - (distance + service + NEAR).log()
        best = worth.masked_fill(~feasible, -th.inf).amax(-1, keepdim=True).masked_fill(none, 0.0)
        onward = self.neighbor_log_value[:, None] - (near + self.neighbor_service[:, None] + NEAR).log()
        onward = (th.where(is_open, onward, -th.inf).amax(-1) - best).clamp(-LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)
        value_left = (self.value[:, None] * feasible).sum(-1, keepdim=True)
        nearby = (self.neighbor_value[:, None] * is_open).sum(-1) / value_left.clamp(min=NEAR)
        fields = {
            WholeMoveFeature.LOG_VALUE: log_value,
            WholeMoveFeature.RELATIVE_VALUE: relative(log_value),
            WholeMoveFeature.WORTH: relative(worth),
            WholeMoveFeature.WORTH_OF_DETOUR: relative(log_value - (detour.clamp(min=0.0) + service + NEAR).log()),
            WholeMoveFeature.SERVICE: SHORT_SCALE * service,
            WholeMoveFeature.SPENT: ((distance + service) / left.clamp(min=NEAR)).clamp(0.0, 1.0),
            WholeMoveFeature.ONWARD_WORTH: functional.pad(onward, (1, 0), value=-LOG_RATIO_LIMIT),
            WholeMoveFeature.OPEN_VALUE: functional.pad(nearby.clamp(max=1.0), (1, 0)),
            WholeMoveFeature.VALUE_LEFT: (value_left + 1).log() / _LOG_COUNT_SCALE,
        }
        return stack_features(WholeMoveFeature, fields, distance)


class MoveGeometry(NamedTuple):
    """
    Precomputed distances for the features of a UAV's next moves.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param home: ``(batch, n_tasks + 1)``, distance to the depot
    :param neighbors: ``(batch, n_tasks, n_next)`` int64, the nearest other tasks
    :param neighbor_distance: ``(batch, n_tasks, n_next)``, ``FARTHEST`` where there are fewer
    :param neighbor_home: ``(batch, n_tasks, n_next)``, their distance to the depot, with their service costs
    :param worth: Values and service costs; None for networks that see only the paper's problem
    """

    coordinates: th.Tensor
    home: th.Tensor
    neighbors: th.Tensor
    neighbor_distance: th.Tensor
    neighbor_home: th.Tensor
    worth: MoveWorth | None = None

    @classmethod
    def of(cls, static: StaticObservation, whole: bool = False) -> MoveGeometry:
        """
        :param static: ``batch`` instances
        :param whole: Whether to add what the whole problem takes
        """
        coordinates = scaled_coordinates(static, whole)
        distance = task_distances(coordinates, static.task_mask)
        near, neighbors = distance.topk(min(N_NEXT, distance.shape[1]), largest=False)
        home = th.linalg.vector_norm(coordinates, dim=-1)
        neighbor_home = home[:, 1:].gather(1, neighbors.flatten(1)).view_as(near)
        if not whole:
            return cls(coordinates, home, neighbors, near, neighbor_home)
        worth = MoveWorth.of(World.of(static), neighbors)
        return cls(coordinates, home, neighbors, near, neighbor_home + worth.neighbor_service, worth)

    def features(self, position: th.Tensor, remaining: th.Tensor, action_mask: th.Tensor) -> th.Tensor:
        """
        :param position: ``(batch, n_samples)`` int64, the UAV's current node
        :param remaining: ``(batch, n_samples)``, remaining flight distance, in units of the maximum
        :param action_mask: ``(batch, n_samples, n_tasks + 1)`` bool
        :return: ``(batch, n_samples, n_tasks + 1, len(MoveFeature))``, and those of :data:`WholeMoveFeature` with them
        """
        here = self.coordinates.gather(1, position[..., None].expand(-1, -1, 2))
        if self.worth is not None:
            here = th.where((position == 0)[..., None], self.worth.start, here)
        distance = euclidean(self.coordinates[:, None], here[:, :, None])
        nearest = distance.masked_fill(~action_mask, FARTHEST).amin(-1, keepdim=True)
        home = self.home[:, None]
        home_here = self.home.gather(1, position)[..., None]
        left = remaining[..., None]
        # What is left after the move itself.
        after = left - distance
        if self.worth is not None:
            home_here = th.linalg.vector_norm(here, dim=-1, keepdim=True)
            after = after - self.worth.service[:, None]
        slack = (after - home).clamp(min=-FARTHEST)

        # Which neighbors of each node can still be visited after it.
        shape = (*action_mask.shape[:2], *self.neighbors.shape[1:])
        index = self.neighbors.flatten(1)[:, None].expand(-1, shape[1], -1)
        near = self.neighbor_distance[:, None]
        there = self.neighbor_home[:, None]
        is_near = (near < FARTHEST) & (near + there <= after[..., 1:, None])
        is_open = is_near & action_mask[..., 1:].gather(2, index).view(shape)
        nearest_open = smallest(th.where(is_open, near, FARTHEST), _N_CLUSTER)
        onward = functional.pad(nearest_open[..., 0], (1, 0), value=FARTHEST)
        cluster = functional.pad(nearest_open.clamp(max=FARTHEST_NEXT).mean(-1), (1, 0), value=FARTHEST_NEXT)
        few = functional.pad(is_open[..., :_N_FEW].sum(-1).to(distance.dtype) / _N_FEW, (1, 0))
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
            MoveFeature.N_FEASIBLE: (count + 1).log() / _LOG_COUNT_SCALE,
            MoveFeature.ON_SIDE: on_side,
            MoveFeature.ANGLE: angle.clamp(-1, 1),
        }
        features = stack_features(MoveFeature, fields, distance)
        if self.worth is None:
            return features
        detour = distance + home - home_here
        more = self.worth.features(distance, detour, left, feasible, near, is_open)
        return th.cat([features, more], dim=-1)

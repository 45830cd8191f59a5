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
    NEAR,
    SHORT_SCALE,
    log_ratio,
    scaled_coordinates,
    smallest,
    stack_features,
    task_distances,
)
from sb3_uav.policies.static_observation import StaticObservation

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


class MoveGeometry(NamedTuple):
    """
    Precomputed distances for the features of a UAV's next moves.

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
        :param position: ``(batch, n_samples)`` int64, the UAV's current node
        :param remaining: ``(batch, n_samples)``, remaining flight distance, in units of the maximum
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
        return stack_features(MoveFeature, fields, distance)

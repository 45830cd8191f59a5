"""
Distances and related measures as inputs of the networks, in units of the maximum flight distance.

In these units one network works for every maximum flight distance, and reachable tasks lie within 0.5 of the depot.
Factors and offsets bring each feature to a magnitude of about 1 where D = 2 on the unit square, the paper's distribution.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import TypeVar

import torch as th
from torch.nn import functional

from sb3_uav.envs.distances import euclidean
from sb3_uav.policies.static_observation import StaticObservation

# Beyond this nothing can be reached, so where exactly a task lies does not matter, nor does the magnitude of the numbers.
FARTHEST = 1.0
# Distances below this are as good as 0.
NEAR = 1e-3
# How many of the nearest tasks make up the density around a task.
_N_DENSITY = 4
# Reachable tasks lie within 0.5 of the depot, 0.25 on average.
FAR_SCALE = 4
# Moves between neighbors are shorter: about 0.1.
SHORT_SCALE = 8
# Minus the logarithm of about 0.05, a common distance to the nearest task.
LOG_DENSITY_OFFSET = 3.0
# Largest logarithm of a ratio of distances: a factor of 150.
LOG_RATIO_LIMIT = 5.0


# Features of a task in the encoder. The weights in existing zips depend on this order.
NodeFeature = IntEnum(
    "NodeFeature",
    "X Y HOME HOME_SQUARED DIRECTION_X DIRECTION_Y NEAREST DENSITY",
    start=0,
)


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
    itself = th.eye(task_mask.shape[1], dtype=th.bool, device=task_mask.device)
    return distance.masked_fill(~task_mask[:, None] | itself, FARTHEST)


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
    nearest = smallest(task_distances(coordinates, task_mask), _N_DENSITY)
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


def log_ratio(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """
    :param a: Distances
    :param b: Distances, broadcast against ``a``
    :return: Logarithm of their ratio, limited to ``LOG_RATIO_LIMIT`` in magnitude
    """
    return ((a + NEAR).log() - (b + NEAR).log()).clamp(-LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)

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
from sb3_uav.policies.world import World

# Beyond this nothing can be reached, so where exactly a task lies does not matter, nor does the magnitude of the numbers.
FARTHEST = 1.0
# The same for coordinates in networks with ``whole``, because UAVs may start and end far apart.
_FARTHEST_APART = 8.0
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


# What networks with ``whole`` see of a task beside them: logarithm of its value relative to the mean; its value relative to
# the greatest; service cost; distances from the nearest start and to the nearest end; which part of its maximum distance the
# UAV that is best placed flies for it alone; which part of the UAVs could serve it; and how much value lies near it.
WholeNodeFeature = IntEnum(
    "WholeNodeFeature",
    "LOG_VALUE VALUE SERVICE START END SOLO SERVED_BY RICHNESS",
    start=0,
)
# And of the instance, beside the number of tasks: mean of the starts; mean length of the flights from start to end; mean of
# the maximum distances; mean distance of the starts from their mean; spread of the values; and mean of the best SOLO.
WholeDepotFeature = IntEnum(
    "WholeDepotFeature",
    "START_X START_Y OPEN REACH APART VALUE_SPREAD SOLO",
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


def scaled_coordinates(static: StaticObservation, whole: bool = False) -> th.Tensor:
    """
    :param static: ``batch`` instances
    :param whole: Whether they are for a network that sees the whole problem
    :return: ``(batch, n_tasks + 1, 2)``, home first (the depot, or where UAVs end, see :attr:`StaticObservation.home`),
        relative to it; padded tasks lie there
    """
    relative = (static.tasks - static.home[:, None]) / static.max_distance[..., None]
    farthest = _FARTHEST_APART if whole else FARTHEST
    tasks = relative.clamp(-farthest, farthest).masked_fill(~static.task_mask[..., None], 0.0)
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


def whole_node_features(coordinates: th.Tensor, task_mask: th.Tensor, world: World) -> th.Tensor:
    """
    Features of every task in the encoder of networks with ``whole``, beside :func:`node_features`.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param task_mask: ``(batch, n_tasks)`` bool
    :param world: The rest of the instances
    :return: ``(batch, n_tasks, len(WholeNodeFeature))``
    """
    tasks = coordinates[:, 1:]
    start, end = (euclidean(tasks[:, None], points[:, :, None]).amin(1) for points in (world.start, world.end))
    solo = world.solo(tasks)
    distance = task_distances(coordinates, task_mask)
    near, neighbors = distance.topk(min(_N_DENSITY, distance.shape[-1]), largest=False)
    value = world.value.gather(1, neighbors.flatten(1)).view_as(near).masked_fill(near >= FARTHEST, 0.0)
    fields = {
        WholeNodeFeature.LOG_VALUE: world.log_value,
        WholeNodeFeature.VALUE: world.value / world.value.amax(1, keepdim=True).clamp(min=NEAR),
        WholeNodeFeature.SERVICE: SHORT_SCALE * world.service,
        WholeNodeFeature.START: FAR_SCALE * start,
        WholeNodeFeature.END: FAR_SCALE * end,
        WholeNodeFeature.SOLO: solo.amin(1),
        WholeNodeFeature.SERVED_BY: (solo <= 1).to(start.dtype).mean(1),
        WholeNodeFeature.RICHNESS: (value.mean(-1) + world.value + NEAR).log().clamp(min=-LOG_RATIO_LIMIT),
    }
    return stack_features(WholeNodeFeature, fields, start)


def whole_depot_features(coordinates: th.Tensor, task_mask: th.Tensor, world: World) -> th.Tensor:
    """
    Features of the instance in the encoder of networks with ``whole``.

    :param coordinates: ``(batch, n_tasks + 1, 2)``, see :func:`scaled_coordinates`
    :param task_mask: ``(batch, n_tasks)`` bool
    :param world: The rest of the instances
    :return: ``(batch, len(WholeDepotFeature))``
    """
    n_real = task_mask.sum(1).clamp(min=1)
    start = world.start.mean(1)
    solo = world.solo(coordinates[:, 1:]).amin(1).masked_fill(~task_mask, 0.0).sum(1) / n_real
    spread = (world.log_value**2).masked_fill(~task_mask, 0.0).sum(1) / n_real
    fields = {
        WholeDepotFeature.START_X: FAR_SCALE * start[:, 0],
        WholeDepotFeature.START_Y: FAR_SCALE * start[:, 1],
        WholeDepotFeature.OPEN: FAR_SCALE * euclidean(world.start, world.end).mean(1),
        WholeDepotFeature.REACH: world.reach.mean(1),
        WholeDepotFeature.APART: FAR_SCALE * euclidean(world.start, start[:, None]).mean(1),
        WholeDepotFeature.VALUE_SPREAD: (spread + NEAR).sqrt(),
        WholeDepotFeature.SOLO: solo,
    }
    return stack_features(WholeDepotFeature, fields, solo)


def log_ratio(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """
    :param a: Distances
    :param b: Distances, broadcast against ``a``
    :return: Logarithm of their ratio, limited to ``LOG_RATIO_LIMIT`` in magnitude
    """
    return ((a + NEAR).log() - (b + NEAR).log()).clamp(-LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)

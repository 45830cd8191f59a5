"""K-means clustering of points in the plane, and a cluster of tasks for every UAV."""

from __future__ import annotations

import numpy as np

from sb3_uav.envs.distances import euclidean
from sb3_uav.envs.instances import Instances
from sb3_uav.solvers.matching import cheapest_assignment

_MAX_LLOYD_ITERATIONS = 100
# In units of what the UAV that flies farthest can fly.
_LEAST_RANGE = 1e-9


def checked_restarts(restarts: int, solver: str) -> int:
    """
    :param restarts: How many times K-means starts
    :param solver: Name of the solver, for errors
    :return: The same
    :raises ValueError: If it is less than 1
    """
    if restarts < 1:
        raise ValueError(f"restarts of {solver} is {restarts}; K-means needs at least 1 start.")
    return restarts


def clusters_of_uavs(instance: Instances, rng: np.random.Generator, restarts: int = 10) -> np.ndarray:
    """
    A cluster of tasks for every UAV.

    Of UAVs that differ, those that can serve no task get none, and the others the clusters whose centers are the least detour
    for them, in parts of what they can fly, added up over the fleet.

    :param instance: A batch of one on the CPU, without padding
    :param rng: The source of randomness
    :param restarts: Number of starts of K-means
    :return: ``(n_tasks,)`` int64, the UAV of each task
    """
    points = instance.tasks[0].numpy()
    if instance.has_equal_uavs:
        return kmeans(points, instance.n_uavs, rng, restarts)
    useful = np.flatnonzero(instance.reachable_by_uav()[0].any(1).numpy())
    if len(useful) == 0:
        return np.zeros(len(points), np.int64)
    clusters = kmeans(points, len(useful), rng, restarts)
    costs = np.zeros((len(useful), len(useful)))
    for cluster in np.unique(clusters):
        center = instance.tasks[0, clusters == cluster].mean(0)
        flown = euclidean(instance.uav_start[0], center) + euclidean(center, instance.uav_end[0])
        # A UAV with nothing to fly is useful where it is.
        costs[cluster] = (flown / instance.uav_distance[0].clamp(min=_LEAST_RANGE * float(instance.unit[0])))[useful]
    return useful[cheapest_assignment(costs)][clusters]


def kmeans(points: np.ndarray, n_clusters: int, rng: np.random.Generator, restarts: int = 10) -> np.ndarray:
    """
    Lloyd's algorithm from k-means++ starts.

    :param points: ``(n_points, 2)``
    :param n_clusters: Number of clusters; some stay empty if there are fewer distinct points
    :param rng: The source of randomness
    :param restarts: Number of starts; the clustering with the smallest sum of squared distances is kept
    :return: ``(n_points,)`` int64, the cluster of each point
    """
    # In a unit square, so that squares of very small or large coordinates neither vanish nor overflow.
    points = points - points.min(0)
    points = points / (points.max() or 1.0)
    best: tuple[float, np.ndarray] | None = None
    for _ in range(restarts):
        labels, inertia = _lloyd(points, _spread_centers(points, n_clusters, rng))
        if best is None or inertia < best[0]:
            best = inertia, labels
    assert best is not None
    return best[1]


def _spread_centers(points: np.ndarray, n_clusters: int, rng: np.random.Generator) -> np.ndarray:
    """
    k-means++: each next center is a point drawn with probability proportional to its squared distance to the centers so far.

    :return: ``(n_clusters, 2)``
    """
    centers = points[rng.integers(len(points))][None]
    nearest = np.full(len(points), np.inf)
    while len(centers) < n_clusters:
        nearest = np.minimum(nearest, np.square(points - centers[-1]).sum(-1))
        cumulated = nearest.cumsum()
        # One past the end if every point is a center already; its cluster then stays empty.
        drawn = np.searchsorted(cumulated, rng.random() * cumulated[-1], side="right")
        centers = np.vstack([centers, points[min(drawn, len(points) - 1)]])
    return centers


def _lloyd(points: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, float]:
    """
    :param points: ``(n_points, 2)``
    :param centers: ``(n_clusters, 2)``
    :return: The cluster of each point, ``(n_points,)`` int64, and the sum of squared distances to their centers
    """
    labels = np.full(len(points), -1)
    for _ in range(_MAX_LLOYD_ITERATIONS):
        distances = np.square(points[:, None] - centers).sum(-1)
        previous, labels = labels, distances.argmin(1)
        if np.array_equal(labels, previous):
            break
        counts = np.bincount(labels, minlength=len(centers))
        sums = np.stack([np.bincount(labels, weights=axis, minlength=len(centers)) for axis in points.T], axis=1)
        # A cluster that has lost all its points keeps its center.
        centers = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], centers)
    return labels, float(np.square(points - centers[labels]).sum())

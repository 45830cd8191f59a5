"""Simple splits of the tasks, each followed by flights to the nearest feasible task: what a trained pair must beat."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import nearest_feasible
from sb3_uav.envs.schedule import Schedule
from sb3_uav.solvers.base import OneByOneSolver, Solution

MAX_LLOYD_ITERATIONS = 100


def nearest_feasible_schedule(instance: Instances, assignment: np.ndarray) -> Schedule:
    """
    :param instance: A batch of one
    :param assignment: ``(n_tasks,)`` integers, the UAV of each task
    :return: Every UAV flies to the nearest of its tasks that still fits, until none does
    """
    planned = plan_tours(instance, th.from_numpy(assignment.astype(np.int64))[None, None], nearest_feasible)
    return schedules(planned.tours[:, 0])[0]


class RandomNearest(OneByOneSolver):
    """Every task goes to a random UAV, every UAV to its nearest feasible task."""

    name = "random-nearest"
    uses_time_limit = False

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        return Solution(nearest_feasible_schedule(instance, rng.integers(instance.n_uavs, size=instance.n_tasks)))


class KMeansNearest(OneByOneSolver):
    """
    K-means clusters of the tasks, one for every UAV, and every UAV flies to its nearest feasible task.

    :param restarts: How many times K-means starts anew; the most compact clusters are kept
    :raises ValueError: If there is not at least one start
    """

    name = "kmeans-nearest"
    uses_time_limit = False

    def __init__(self, restarts: int = 10) -> None:
        self.restarts = checked_restarts(restarts, self.name)

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        clusters = kmeans(instance.tasks[0].numpy(), instance.n_uavs, rng, self.restarts)
        return Solution(nearest_feasible_schedule(instance, clusters))


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


def kmeans(points: np.ndarray, n_clusters: int, rng: np.random.Generator, restarts: int = 10) -> np.ndarray:
    """
    Lloyd's algorithm from k-means++ starts.

    :param points: ``(n_points, 2)``
    :param n_clusters: Number of clusters; some stay empty if there are fewer distinct points
    :param rng: The source of randomness
    :param restarts: Number of starts, of which the one with the smallest sum of squared distances is kept
    :return: ``(n_points,)`` int64, the cluster of each point
    """
    # In a unit square, so that squares of very small or large coordinates neither vanish nor overflow.
    points = points - points.min(0)
    points = points / (points.max() or 1.0)
    best: tuple[float, np.ndarray] | None = None
    for _ in range(restarts):
        labels, inertia = _lloyd(points, _spread_centres(points, n_clusters, rng))
        if best is None or inertia < best[0]:
            best = inertia, labels
    assert best is not None
    return best[1]


def _spread_centres(points: np.ndarray, n_clusters: int, rng: np.random.Generator) -> np.ndarray:
    """
    k-means++: each next centre is a point drawn with probability proportional to its squared distance to the centres so far.

    :return: ``(n_clusters, 2)``
    """
    centres = points[rng.integers(len(points))][None]
    nearest = np.full(len(points), np.inf)
    while len(centres) < n_clusters:
        nearest = np.minimum(nearest, np.square(points - centres[-1]).sum(-1))
        cumulated = nearest.cumsum()
        # One past the end if every point is a centre already; its cluster then stays empty.
        drawn = np.searchsorted(cumulated, rng.random() * cumulated[-1], side="right")
        centres = np.vstack([centres, points[min(drawn, len(points) - 1)]])
    return centres


def _lloyd(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, float]:
    """
    :param points: ``(n_points, 2)``
    :param centres: ``(n_clusters, 2)``
    :return: The cluster of each point, ``(n_points,)`` int64, and the sum of squared distances to their centres
    """
    labels = np.full(len(points), -1)
    for _ in range(MAX_LLOYD_ITERATIONS):
        distances = np.square(points[:, None] - centres).sum(-1)
        previous, labels = labels, distances.argmin(1)
        if np.array_equal(labels, previous):
            break
        counts = np.bincount(labels, minlength=len(centres))
        sums = np.stack([np.bincount(labels, weights=axis, minlength=len(centres)) for axis in points.T], axis=1)
        # A cluster that has lost all its points keeps its centre.
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], centres)
    return labels, float(np.square(points - centres[labels]).sum())

"""Simple splits of the tasks, each followed by flights to the nearest feasible task, as baselines."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import nearest_feasible
from sb3_uav.envs.schedule import Schedule
from sb3_uav.solvers.base import OneByOneSolver, Solution
from sb3_uav.solvers.kmeans import checked_restarts, clusters_of_uavs


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
    solves_whole_problem = True
    uses_time_limit = False

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        return Solution(nearest_feasible_schedule(instance, rng.integers(instance.n_uavs, size=instance.n_tasks)))


class KMeansNearest(OneByOneSolver):
    """
    K-means clusters of the tasks, one for every UAV, and every UAV flies to its nearest feasible task.

    :param restarts: Number of starts of K-means; the most compact clusters are kept
    :raises ValueError: If there is not at least one start
    """

    name = "kmeans-nearest"
    solves_whole_problem = True
    uses_time_limit = False

    def __init__(self, restarts: int = 10) -> None:
        self.restarts = checked_restarts(restarts, self.name)

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        return Solution(nearest_feasible_schedule(instance, clusters_of_uavs(instance, rng, self.restarts)))

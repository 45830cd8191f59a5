"""K-means and variable neighborhood descent: the paper's conventional baseline in a fast form."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch as th

from sb3_uav.common.optional import require
from sb3_uav.envs.allocation import Subsets, split_tasks
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.solvers.base import OneByOneSolver, Solution
from sb3_uav.solvers.kmeans import checked_restarts, clusters_of_uavs
from sb3_uav.solvers.nearest_task import nearest_feasible_schedule


class KMeansVND(OneByOneSolver):
    """
    K-means clusters of the tasks, one for every UAV, and variable neighborhood descent on each (the paper's K-means+VND).

    Every tour starts with the nearest feasible tasks of its cluster. Three neighborhoods are searched in turn until none has
    an improvement: shorter tours (2-opt, or-opt), insertion of an unvisited task, and replacement of a visited task by one
    that is worth more, or as much on a shorter tour. Tours exchange no tasks.

    :param restarts: Number of starts of K-means; the most compact clusters are kept
    :raises ValueError: If there is not at least one start
    :raises ImportError: If numba is not installed
    """

    name = "kmeans-vnd"
    solves_whole_problem = True
    uses_time_limit = False

    def __init__(self, restarts: int = 10) -> None:
        self.restarts = checked_restarts(restarts, self.name)
        require("numba", f"Solver {self.name}", "solvers")

    def prepare(self) -> None:
        _warm_up()

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        clusters = clusters_of_uavs(instance, rng, self.restarts)
        start = nearest_feasible_schedule(instance, clusters)
        subsets = split_tasks(instance, th.from_numpy(clusters)[None, None])
        return Solution(Schedule(_descend(subsets, uav, route) for uav, route in enumerate(start.routes)))


@cache
def _warm_up() -> None:
    """Run once per process. Imported on use, because this module must load even without numba."""
    from sb3_uav.local_search.search import warm_up

    warm_up()


def _descend(subsets: Subsets, uav: int, route: tuple[int, ...]) -> tuple[int, ...]:
    """
    :param subsets: The tasks that every UAV may visit
    :param uav: One of them
    :param route: Some of its tasks, in flying order
    :return: A better route over them
    """
    alone = subsets.instances[uav]
    n_tasks = int(alone.task_mask.sum())
    if n_tasks == 0:
        return ()
    from sb3_uav.local_search.search import LocalSearch

    # In ascending order, see split_tasks.
    tasks = subsets.task_index[uav, :n_tasks].numpy()
    start = Schedule([np.searchsorted(tasks, route)])
    found = LocalSearch(alone.trim(n_tasks)).repair(start, max_string=0)
    return tuple(tasks[list(found.routes[0])].tolist())

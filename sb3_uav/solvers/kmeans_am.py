"""K-means clusters of the tasks, and a trained router for every UAV's tour: the paper's K-means+AM (section V-B)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th

from sb3_uav.common.random_streams import keyed_generator
from sb3_uav.envs.allocation import UNASSIGNED, plan_tours, schedules
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.solvers.kmeans import checked_restarts, clusters_of_uavs
from sb3_uav.solvers.network_solver import BatchedSolver, parameters_hash


class KMeansAM(BatchedSolver):
    """
    K-means gives every UAV a cluster of tasks, the trained router plans its tour, greedily.

    With the same seed and number of restarts, the clusters are those of ``kmeans-nearest``.

    :param router: The lower level's policy
    :param restarts: Number of starts of K-means; the most compact clusters are kept
    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :raises ValueError: If an argument is not allowed
    """

    name = "K-means+AM"

    def __init__(self, router: RouterPolicy, restarts: int = 10, batch_size: int | None = None) -> None:
        super().__init__(batch_size)
        self.router = router
        self.solves_whole_problem = router.settings.whole
        self.restarts = checked_restarts(restarts, "kmeans-am")

    def settings(self) -> dict[str, Any]:
        return {"router": parameters_hash(self.router), "restarts": self.restarts}

    def rows_that_fit(self, instances: Instances) -> int:
        return self.router.rows_that_fit(instances.n_tasks + 1, instances.n_uavs)

    def solve_batch(
        self, instances: Instances, rows: Sequence[int], seed: int, time_limit: float | None = None
    ) -> list[Schedule]:
        assignment = kmeans_assignment(instances, rows, seed, self.restarts)
        return schedules(plan_tours(instances, assignment, self.router.plan).tours[:, 0])


def kmeans_assignment(instances: Instances, rows: Sequence[int], seed: int, restarts: int) -> th.Tensor:
    """
    :param instances: ``batch`` instances on the CPU, real tasks first
    :param rows: Their row indices in the solved batch
    :param seed: Seed for all random numbers
    :param restarts: Number of starts of K-means
    :return: ``(batch, 1, n_tasks)`` int64, the UAV of each task by its cluster
    """
    assignment = th.full((len(rows), 1, instances.n_tasks), UNASSIGNED, device=instances.device)
    for i, (row, n_tasks) in enumerate(zip(rows, instances.task_mask.sum(1).tolist(), strict=True)):
        if n_tasks > 0:
            clusters = clusters_of_uavs(instances[i].trim(n_tasks), keyed_generator(seed, row), restarts)
            assignment[i, 0, :n_tasks] = th.from_numpy(clusters)
    return assignment


def load_kmeans_am(router: str, restarts: int = 10, device: str = "auto", batch_size: int | None = None) -> KMeansAM:
    """
    :param router: SB3 zip of the router
    :param restarts: Number of starts of K-means
    :param device: Device of the network
    :param batch_size: How many instances to solve at once; as many as memory allows when None
    :return: The solver
    :raises FileNotFoundError: If the zip is missing
    :raises ValueError: If the zip is damaged or holds another policy, or an argument is not allowed
    """
    solver = KMeansAM(load_policy(router, device, RouterPolicy), restarts, batch_size)
    solver.files = {"router": Path(router)}
    return solver

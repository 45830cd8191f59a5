"""Leaving out what cannot count, before any solver sees it: tasks out of reach or without value, and UAVs without a task."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch as th

from sb3_uav.envs.compaction import compact
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule

# Schedules list all UAVs of a fleet up to this size; of a larger one, idle UAVs are left out.
LARGEST_LISTED_FLEET = 1000


@dataclass(frozen=True)
class CountingTasks:
    """
    Instances without the tasks that no UAV can reach or that are worth nothing.

    What must be served has become a matter of value, see :attr:`~sb3_uav.envs.instances.Instances.prizes`.

    :param original: ``batch`` instances
    :param instances: The same with the remaining tasks at the beginning of each row; the original itself if all tasks count
        and none must be served
    :param index: ``(batch, n_slots)`` int64, the original task in each slot
    """

    original: Instances
    instances: Instances
    index: th.Tensor

    @classmethod
    def of(cls, instances: Instances) -> CountingTasks:
        """
        :param instances: ``batch`` instances, possibly padded
        :return: What counts of them
        """
        original = instances
        if instances.must_serve is not None:
            instances = replace(instances, values=instances.prizes, must_serve=None)
        counts = instances.reachable() & (instances.values > 0)
        if th.equal(counts, instances.task_mask):
            index = th.arange(instances.n_tasks, device=instances.device).expand(len(instances), -1)
            return cls(original, instances, index)
        return cls(original, *compact(instances, counts))

    def n_useful_uavs(self) -> list[int]:
        """:return: How many UAVs of each instance can be of use: of equal ones at most one per task, and at least one"""
        if not self.instances.has_equal_uavs:
            return [self.instances.n_uavs] * len(self.instances)
        return [min(self.instances.n_uavs, max(n_tasks, 1)) for n_tasks in self.instances.task_mask.sum(1).tolist()]

    def schedule(self, row: int, found: Schedule) -> Schedule:
        """
        :param row: Row of an instance
        :param found: A schedule of what counts of it
        :return: The schedule of the original instance, with one route for each UAV, but not for more than
            :data:`LARGEST_LISTED_FLEET` or than there are tasks. It is at least as good as visiting the most valuable tasks
            one by one: where the solver found less, it is just that
        """
        n_useful = self.original.n_uavs
        if self.original.has_equal_uavs:
            n_useful = min(n_useful, int(self.original.task_mask[row].sum()))
        n_routes = min(self.original.n_uavs, max(n_useful, LARGEST_LISTED_FLEET))
        tasks = self.index[row].tolist()
        n_tasks = int(self.instances.task_mask[row].sum())
        if any(not 0 <= task < n_tasks for route in found.routes for task in route):
            # A faulty schedule stays what it is, for the checker to refuse.
            return found
        values = self.instances.values[row].tolist()
        single = self._one_each(row, n_useful)
        visited = (task for route in found.routes for task in route)
        if math.fsum(values[task] for task in visited) < math.fsum(values[task] for route in single for task in route):
            found = Schedule(single)
        routes = [[tasks[task] for task in route] for route in found.routes]
        return Schedule(routes + [[]] * (n_routes - len(routes)))

    def _one_each(self, row: int, n_useful: int) -> list[list[int]]:
        """
        :param row: Row of an instance
        :param n_useful: Number of UAVs
        :return: Routes of one task each, the most valuable ones; a UAV of an unequal fleet gets the most valuable that it can
            reach and that the UAVs before it have left
        """
        values = self.instances.values[row].tolist()
        ranked = sorted(range(int(self.instances.task_mask[row].sum())), key=lambda task: -values[task])
        if self.instances.has_equal_uavs:
            return [[task] for task in ranked[:n_useful]]
        routes: list[list[int]] = []
        for reach in self.instances[row].reachable_by_uav()[0].tolist():
            route = [task for task in ranked if reach[task]][:1]
            ranked = [task for task in ranked if task not in route]
            routes.append(route)
        return routes

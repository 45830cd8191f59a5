"""Why tasks are left out of a plan."""

from __future__ import annotations

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.plan import Skipped

# So many tasks are compared with all stops of a route at once.
_BLOCK = 512


def skipped_tasks(instance: Instances, schedule: Schedule) -> tuple[Skipped, ...]:
    """
    :param instance: A batch of one, in meters
    :param schedule: A feasible schedule
    :return: The tasks that it does not serve, in the order of the input. For a task out of reach, ``missing_m`` is what the
        UAV nearest to serving it alone lacks; for one that did not fit, what the UAV nearest to serving it on its route lacks
    """
    points, service = instance.tasks[0].numpy(), instance.service_cost[0].numpy()
    prizes = instance.prizes[0].numpy()
    starts, ends, limits = (field[0].numpy() for field in (instance.uav_start, instance.uav_end, instance.uav_distance))
    served = {task for route in schedule.routes for task in route}
    left = np.array([task for task in range(instance.n_tasks) if task not in served], int)
    alone = np.full(len(left), np.inf)
    on_route = np.full(len(left), np.inf)
    for uav in range(instance.n_uavs):
        route = schedule.routes[uav] if uav < len(schedule.routes) else ()
        detour = _lengths(points[left], starts[uav]) + _lengths(points[left], ends[uav]) + service[left]
        alone = np.minimum(alone, detour - limits[uav])
        stops = np.array([starts[uav], *points[list(route)], ends[uav]])
        used = _lengths(stops[1:], stops[:-1]).sum() + service[list(route)].sum()
        on_route = np.minimum(on_route, used + _detours(points[left], stops) + service[left] - limits[uav])
    return tuple(_skipped(int(task), prizes[task], *pair) for task, *pair in zip(left, alone, on_route, strict=True))


def _skipped(task: int, prize: float, alone: float, on_route: float) -> Skipped:
    if prize <= 0:
        return Skipped(task, "worth nothing")
    if alone > 0:
        return Skipped(task, "out of reach", float(alone))
    return Skipped(task, "did not fit", max(float(on_route), 0.0))


def _detours(points: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """
    :param points: ``(n, 2)``
    :param stops: ``(m, 2)``, a route from its start to its end
    :return: ``(n,)``, how much longer the route gets by each of the points alone, where that is least
    """
    legs, detours = _lengths(stops[1:], stops[:-1]), np.empty(len(points))
    for begin in range(0, len(points), _BLOCK):
        to_stops = np.hypot(*(points[begin : begin + _BLOCK, None] - stops).transpose(2, 0, 1))
        detours[begin : begin + _BLOCK] = (to_stops[:, :-1] + to_stops[:, 1:] - legs).min(axis=1)
    return detours


def _lengths(points: np.ndarray, other: np.ndarray) -> np.ndarray:
    lengths: np.ndarray = np.hypot(*(points - other).T)
    return lengths

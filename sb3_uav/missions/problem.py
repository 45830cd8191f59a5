"""The problem that solvers see: tasks and fleet as an instance in meters."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.missions.checks import check_fits
from sb3_uav.missions.fleet import Fleet
from sb3_uav.missions.tasks import TaskList


def service_speed(tasks: TaskList, fleet: Fleet) -> float:
    """
    The speed that turns seconds of service into meters of range: that of the fastest UAV, so that no slower one is promised
    too much.

    :param tasks: The tasks
    :param fleet: The UAVs
    :return: Meters per second; 0 if no task takes time
    :raises ValueError: If a task takes time and the speed of a UAV is not known
    """
    if not (tasks.service_s > 0).any():
        return 0.0
    unknown = [uav.id for uav in fleet if uav.speed_mps is None]
    if unknown:
        first = int(np.flatnonzero(tasks.service_s > 0)[0])
        raise ValueError(
            f"{tasks.source}: {tasks.places[first]}: task {tasks.ids[first]} takes {tasks.service_s[first]:g} s, but the "
            f"speed of UAV {unknown[0]} is not known; give --speed, or speed_mps in the file of the fleet."
        )
    return max(uav.speed_mps for uav in fleet if uav.speed_mps is not None)


def make_instance(tasks: TaskList, fleet: Fleet) -> Instances:
    """
    :param tasks: ``n`` tasks with a depot
    :param fleet: ``V`` UAVs
    :return: One instance in meters, the depot at the origin for latitudes and longitudes
    :raises ValueError: If there is no depot, the speed of a UAV is needed and not known, or starts or ends of UAVs are not
        in the coordinates of the tasks
    """
    check_fits(tasks, fleet)
    if tasks.depot is None:
        raise ValueError(f"{tasks.source}: there is no depot; flag a row as the depot, or give --depot.")
    coordinates = tasks.coordinates()
    own = {name: [getattr(uav, name) for uav in fleet] for name in ("start", "end")}
    fields: dict[str, Any] = {
        name: coordinates.to_plane(np.array([tasks.depot if point is None else point for point in points], float))
        for name, points in own.items()
        if any(point is not None for point in points)
    }
    return Instances.from_arrays(
        coordinates.to_plane(tasks.depot[None])[0],
        coordinates.to_plane(tasks.points),
        values=tasks.values,
        max_distance=np.array([[uav.usable_m for uav in fleet]]),
        n_uavs=len(fleet),
        service=tasks.service_s * service_speed(tasks, fleet),
        must_serve=tasks.must,
        source=tasks.source,
        **fields,
    )

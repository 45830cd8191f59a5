"""Tasks as GeoJSON, with every field that a list of tasks has."""

from __future__ import annotations

from pathlib import Path

from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.geojson_routes import point_feature, task_properties, write_collection


def write_tasks_geojson(tasks: TaskList, path: Path) -> None:
    """
    Write a collection of Points with the properties ``id``, ``value``, ``service_s``, ``must`` and, where it matters, ``alt``;
    the depot has ``"depot": true``. :func:`~sb3_uav.missions.readers.geojson.read_geojson` reads it back unchanged.

    :param tasks: The tasks, in latitudes and longitudes or in a plane (see
        :func:`~sb3_uav.missions.writers.geojson_routes.write_routes_geojson`)
    :param path: The file to write
    :raises OSError: If it cannot be written
    """
    features = [] if tasks.depot is None else [point_feature(tasks, tasks.depot, {"depot": True})]
    features += [point_feature(tasks, tasks.points[task], task_properties(tasks, task)) for task in range(len(tasks))]
    write_collection(tasks, features, path)

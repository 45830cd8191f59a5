"""Tasks as CSV, which :mod:`sb3_uav.missions.readers.csv_tasks` reads again without any loss."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sb3_uav.common.files import write_atomically, write_csv
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.units import LENGTHS


def tasks_to_csv(tasks: TaskList) -> str:
    """
    The depot, where there is one, is the first row. Numbers have as many digits as they need to be read without loss. Columns
    that say nothing are left out.

    :param tasks: The tasks; their fleet is not written
    :return: A CSV in the coordinates of the tasks; in meters, if the unit of their plane has no name
    """
    points, axes = _points(tasks)
    columns: list[tuple[str, Callable[[int], str], str]] = [
        ("id", lambda task: tasks.ids[task], "depot"),
        *((name, _numbers(points[1:, axis]), _number(points[0, axis])) for axis, name in enumerate(axes)),
        ("value", _numbers(tasks.values), ""),
    ]
    if tasks.service_s.any():
        columns.append(("service_s", _numbers(tasks.service_s), ""))
    if tasks.must.any():
        columns.append(("must", lambda task: "yes" if tasks.must[task] else "", ""))
    if not np.isnan(tasks.altitudes).all():
        columns.append(("alt_m", _numbers(tasks.altitudes), ""))
    rows = [[cell(task) for _, cell, _ in columns] for task in range(len(tasks))]
    header = [name for name, _, _ in columns]
    if tasks.depot is not None:
        header.append("depot")
        rows = [[*(cell for _, _, cell in columns), "yes"], *([*row, ""] for row in rows)]
    text = io.StringIO()
    write_csv(text, header, rows)
    return text.getvalue()


def write_tasks_csv(tasks: TaskList, path: Path) -> None:
    """
    :param tasks: The tasks, as of :func:`tasks_to_csv`
    :param path: The file to write
    :raises OSError: If it cannot be written
    """
    write_atomically(path, tasks_to_csv(tasks))


def _points(tasks: TaskList) -> tuple[np.ndarray, tuple[str, str]]:
    """:return: ``(n + 1, 2)``, the depot or anything, and the tasks; and the names of the two columns"""
    points = np.vstack([np.zeros(2) if tasks.depot is None else tasks.depot, tasks.points])
    if tasks.system == "wgs84":
        return points, ("lat", "lon")
    name = next((name for name, meters in LENGTHS.items() if meters == tasks.meters_per_unit), None)
    if name is None:
        return points * tasks.meters_per_unit, ("x_m", "y_m")
    return points, (f"x_{name}", f"y_{name}")


def _numbers(array: np.ndarray) -> Callable[[int], str]:
    return lambda task: _number(array[task])


def _number(number: float) -> str:
    return "" if np.isnan(number) else repr(float(number))

"""The tasks of a mission, in the coordinates and with the names of the user."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sb3_uav.missions.coordinates import Coordinates, Geographic, Plane, System
from sb3_uav.missions.fleet import Fleet


@dataclass(frozen=True, eq=False)
class TaskList:
    """
    What a file of tasks says.

    :param ids: Name of every task, unique
    :param points: ``(n, 2)``, latitude and longitude in degrees, or x and y in units of the plane, as the file has them
    :param system: ``"wgs84"`` or ``"plane"``
    :param values: ``(n,)``, value of every task, 0 or more
    :param service_s: ``(n,)``, seconds that a UAV stays at every task
    :param must: ``(n,)`` bool, tasks that come first
    :param depot: ``(2,)``, where the UAVs start and land; None if the file does not say
    :param altitudes: ``(n,)``, meters above the depot at which a task is to be served; NaN where it does not matter
    :param meters_per_unit: Length of one unit of the plane
    :param fleet: The UAVs, if the file says which there are
    :param places: Where in the file every task stands, such as ``"row 7"``, for messages
    :param source: Name of the file, for messages
    :param sha256: Digest of the file in hexadecimal digits; empty if there is none
    :param notes: What the file says and the tasks do not, a sentence each
    """

    ids: tuple[str, ...]
    points: np.ndarray
    system: System
    values: np.ndarray
    service_s: np.ndarray
    must: np.ndarray
    depot: np.ndarray | None = None
    altitudes: np.ndarray = field(default_factory=lambda: np.zeros(0))
    meters_per_unit: float = 1.0
    fleet: Fleet | None = None
    places: tuple[str, ...] = ()
    source: str = "tasks"
    sha256: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.altitudes) != len(self.ids):
            object.__setattr__(self, "altitudes", np.full(len(self.ids), np.nan))
        if len(self.places) != len(self.ids):
            object.__setattr__(self, "places", tuple(f"task {number}" for number in range(1, len(self.ids) + 1)))

    @classmethod
    def of(
        cls,
        ids: Any,
        points: Any,
        system: System,
        values: Any = None,
        service_s: Any = None,
        must: Any = None,
        **others: Any,
    ) -> TaskList:
        """
        :param ids: As of the class; numbers become text
        :param points: ``(n, 2)``
        :param system: As of the class
        :param values: ``(n,)``; 1 for every task when None
        :param service_s: ``(n,)``; 0 when None
        :param must: ``(n,)``; False when None
        :param others: Other fields of the class
        :return: The tasks, arrays converted, contents not checked
        """
        names = tuple(str(name) for name in ids)
        if others.get("depot") is not None:
            others["depot"] = np.asarray(others["depot"], float).reshape(2)
        return cls(
            names,
            np.asarray(points, float).reshape(len(names), 2),
            system,
            np.ones(len(names)) if values is None else np.asarray(values, float),
            np.zeros(len(names)) if service_s is None else np.asarray(service_s, float),
            np.zeros(len(names), bool) if must is None else np.asarray(must, bool),
            **others,
        )

    def __len__(self) -> int:
        return len(self.ids)

    def coordinates(self) -> Coordinates:
        """
        :return: Their system of coordinates; the plane of latitudes and longitudes lies around the depot
        :raises ValueError: If there is no depot
        """
        if self.system == "plane":
            return Plane(self.meters_per_unit)
        if self.depot is None:
            raise ValueError(f"{self.source}: there is no depot; flag a row as the depot, or give --depot LAT,LON.")
        return Geographic(self.depot)

    def with_depot(self, depot: Any) -> TaskList:
        """:return: The same tasks with another depot, ``(2,)``"""
        return replace(self, depot=np.asarray(depot, float).reshape(2))

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from sb3_uav.missions.drawing import tasks_html

        return tasks_html(self)

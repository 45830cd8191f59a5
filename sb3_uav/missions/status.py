"""What has happened since a mission was planned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from sb3_uav.missions.coordinates import System

RemainingUnit = Literal["m", "percent", "min"]
# What a row of a status file may be about.
KINDS = ("uav", "done", "lost", "task", "drop")


@dataclass(frozen=True)
class UavReport:
    """
    Where a UAV is, and how far it still flies.

    :param id: Name of the UAV
    :param position: Where it is, in the user's coordinates; where its route begins if None
    :param remaining: How far it still flies down to an empty battery, reserve included; as planned if None
    :param unit: Unit of that: meters, percent of its whole range, or minutes at cruise speed
    """

    id: str
    position: tuple[float, float] | None = None
    remaining: float | None = None
    unit: RemainingUnit = "m"


@dataclass(frozen=True)
class NewTask:
    """
    A task that is not in the plan.

    :param id: Its name, which no other task has
    :param point: Where it is, in the user's coordinates
    :param value: Its value
    :param service_s: Seconds that a UAV stays
    :param must: Whether it comes first
    :param altitude_m: Altitude above the depot in meters; NaN where it does not matter
    """

    id: str
    point: tuple[float, float]
    value: float = 1.0
    service_s: float = 0.0
    must: bool = False
    altitude_m: float = math.nan


@dataclass(frozen=True)
class Status:
    """
    What has happened since a mission was planned. What is not named is as planned.

    :param uavs: UAVs that report
    :param done: Names of tasks that are done
    :param lost: Names of UAVs that fly no more; their tasks are free again
    :param tasks: New tasks
    :param dropped: Names of tasks that nobody wants any more
    :param system: System of the coordinates; that of the plan if None
    :param places: Where in the file a row stands, by its kind, see :data:`KINDS`, and its name
    :param source: Name of the file, for messages
    """

    uavs: tuple[UavReport, ...] = ()
    done: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    tasks: tuple[NewTask, ...] = ()
    dropped: tuple[str, ...] = ()
    system: System | None = None
    places: Mapping[tuple[str, str], str] = field(default_factory=dict)
    source: str = "status"

    def place(self, kind: str, name: str) -> str:
        """
        :param kind: One of :data:`KINDS`
        :param name: The name in that row
        :return: Where it stands, for messages, such as ``"status.csv: row 7"``
        """
        return f"{self.source}: {self.places.get((kind, name), f'{kind} {name}')}"

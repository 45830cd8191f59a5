"""A plan: which UAV serves which tasks in which order, and why the others are left out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.tasks import TaskList

Reason = Literal["out of reach", "worth nothing", "did not fit"]


@dataclass(frozen=True, eq=False)
class Route:
    """
    What one UAV does.

    :param uav: The UAV
    :param stops: Indices of tasks from 0, in flying order; empty if the UAV stays where it is
    :param points: ``(n_stops + 2, 2)``, start, stops and end in the user's coordinates
    :param legs_m: ``(n_stops + 1,)``, length of every leg in meters, geodesic for latitudes and longitudes; 0 where the UAV
        stays on the ground
    :param service_m: What serving the stops costs, in meters of its range
    :param service_s: How long serving the stops takes, in seconds
    """

    uav: Uav
    stops: tuple[int, ...]
    points: np.ndarray
    legs_m: np.ndarray
    service_m: float
    service_s: float = 0.0

    @property
    def flies(self) -> bool:
        """Whether the UAV leaves its place: it has stops, or it has to get to where it lands."""
        return bool(self.stops) or self.length_m > 0

    @property
    def length_m(self) -> float:
        """Meters flown."""
        return math.fsum(self.legs_m)

    @property
    def used_m(self) -> float:
        """Meters of the range that are used, with the service of the stops."""
        return self.length_m + self.service_m

    @property
    def share_of_range(self) -> float:
        """Part of the range that is used; of the whole range, not of what the reserve leaves."""
        return self.used_m / self.uav.range_m if self.uav.range_m > 0 else 0.0

    @property
    def seconds(self) -> float | None:
        """Time in the air, without takeoff and landing; None if nobody said how fast it flies."""
        return None if self.uav.speed_mps is None else self.length_m / self.uav.speed_mps + self.service_s


@dataclass(frozen=True)
class Skipped:
    """
    A task that no UAV serves.

    :param task: Index of the task
    :param reason: Why
    :param missing_m: How many more meters the UAV that is nearest to serving it would have to be allowed to use, see
        :attr:`~sb3_uav.missions.fleet.Uav.usable_m`; None where it does not apply
    """

    task: int
    reason: Reason
    missing_m: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """
    A plan that the checker has accepted.

    :param tasks: The tasks
    :param fleet: The UAVs
    :param routes: One route per UAV, in the order of the fleet
    :param skipped: The tasks that no UAV serves
    :param objective: Total value of the tasks that are served
    :param unserved: Tasks that must be served and are not
    :param solver: Name of the solver
    :param seed: Seed of the solver
    :param seconds: Wall time of the solver
    :param bound: A proven upper bound of the objective; None if there is none
    :param past_tasks: Names of tasks that earlier plans of this mission had, done or dropped since
    :param past_uavs: Names of UAVs that earlier plans had, lost since
    :param notes: What had to be assumed in making it, a sentence each; remarks begin with them
    :param remarks: What a person should know before flying it, a sentence each
    :param time_limit: Seconds that the solver was given; None if nobody said
    """

    tasks: TaskList
    fleet: Fleet
    routes: tuple[Route, ...]
    skipped: tuple[Skipped, ...]
    objective: float
    unserved: tuple[int, ...]
    solver: str
    seed: int
    seconds: float
    bound: float | None = None
    past_tasks: tuple[str, ...] = ()
    past_uavs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    time_limit: float | None = None

    @property
    def gap(self) -> float | None:
        """How far the objective may be from the best possible, as a part of the bound; None without a bound."""
        return None if not self.bound else (self.bound - self.objective) / self.bound

    @property
    def n_served(self) -> int:
        return sum(len(route.stops) for route in self.routes)

    @property
    def length_m(self) -> float:
        """Meters flown by all UAVs."""
        return math.fsum(route.length_m for route in self.routes)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from sb3_uav.missions.drawing import plan_html

        return plan_html(self)

"""How missions are flown: what the mission files say beside the waypoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Firmware = Literal["px4", "ardupilot"]
Vehicle = Literal["multirotor", "fixed-wing"]
Landing = Literal["rtl", "land"]


@dataclass(frozen=True)
class FlightOptions:
    """
    :param altitude_m: Altitude of the first UAV in meters above the depot, for tasks that do not name one
    :param altitude_step_m: How much higher every further UAV flies, so that tours may cross
    :param firmware: Autopilot
    :param vehicle: Type of the UAVs
    :param landing: ``"rtl"`` to return to launch, ``"land"`` to land at the end of the route
    :raises ValueError: If an option is not allowed
    """

    altitude_m: float = 50.0
    altitude_step_m: float = 10.0
    firmware: Firmware = "px4"
    vehicle: Vehicle = "multirotor"
    landing: Landing = "rtl"

    def __post_init__(self) -> None:
        for name, allowed in (("firmware", Firmware), ("vehicle", Vehicle), ("landing", Landing)):
            if getattr(self, name) not in get_args(allowed):
                raise ValueError(f"{name} is {getattr(self, name)!r}; choose one of {', '.join(get_args(allowed))}.")
        if not 0 < self.altitude_m <= 10_000:
            raise ValueError(f"altitude_m is {self.altitude_m:g}; give meters above the depot, above 0 and at most 10000.")
        if not 0 <= self.altitude_step_m <= 1_000:
            raise ValueError(f"altitude_step_m is {self.altitude_step_m:g}; give meters from 0 to 1000.")

    def altitude_of(self, level: int) -> float:
        """:return: Altitude in meters above the depot, by its number, see :meth:`~sb3_uav.missions.fleet.Fleet.level_of`"""
        return self.altitude_m + level * self.altitude_step_m

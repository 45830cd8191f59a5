"""The UAVs of a mission."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sb3_uav.missions.coordinates import System


@dataclass(frozen=True)
class Uav:
    """
    One UAV.

    :param id: Its name, unique
    :param range_m: How far it flies in meters, before the reserve is taken off
    :param speed_mps: Cruise speed in meters per second; None if nobody said
    :param start: Where it is, in the user's coordinates; at the depot when None
    :param end: Where it has to land, in the user's coordinates; at the depot when None
    :param reserve_percent: Part of the range that no plan may use
    :param full_range_m: How far it flies with a full battery, in meters, if that is more than ``range_m``
    :param level: Number of its altitude among those of the fleet, from 0; its place in the fleet when None
    """

    id: str
    range_m: float
    speed_mps: float | None = None
    start: tuple[float, float] | None = None
    end: tuple[float, float] | None = None
    reserve_percent: float = 0.0
    full_range_m: float | None = None
    level: int | None = None

    @property
    def usable_m(self) -> float:
        """Meters that a plan may use."""
        return self.range_m * (1.0 - self.reserve_percent / 100.0)


@dataclass(frozen=True)
class Fleet:
    """
    :param uavs: The UAVs, at least one
    :param source: Name of the file, for messages
    :param system: Coordinates of their starts and ends, if the file says which; those of the tasks when None
    :param sha256: Digest of the file in hexadecimal digits; empty if there is none
    """

    uavs: tuple[Uav, ...]
    source: str = "fleet"
    system: System | None = None
    sha256: str = ""

    def __len__(self) -> int:
        return len(self.uavs)

    def __iter__(self) -> Iterator[Uav]:
        return iter(self.uavs)

    def level_of(self, place: int) -> int:
        """
        :param place: Place of a UAV in the fleet, from 0
        :return: Number of its altitude, which stays the same when others are lost
        """
        level = self.uavs[place].level
        return place if level is None else level

    @classmethod
    def of_equal(
        cls, n_uavs: int, range_m: float, speed_mps: float | None = None, reserve_percent: float = 0.0, source: str = "fleet"
    ) -> Fleet:
        """
        :param n_uavs: Number of UAVs
        :param range_m: As of :class:`Uav`
        :param speed_mps: As of :class:`Uav`
        :param reserve_percent: As of :class:`Uav`
        :param source: As of the class
        :return: UAVs named ``uav-1``, ``uav-2``, ..., which start and land at the depot
        """
        uavs = (Uav(f"uav-{n}", range_m, speed_mps, reserve_percent=reserve_percent) for n in range(1, n_uavs + 1))
        return cls(tuple(uavs), source)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from sb3_uav.missions.drawing import fleet_html

        return fleet_html(self)

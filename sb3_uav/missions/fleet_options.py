"""The UAVs that a few options describe, with or without a file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from sb3_uav.missions.checks import check_fits, check_fleet, check_fleet_size
from sb3_uav.missions.fleet import Fleet
from sb3_uav.missions.read import read_fleet
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.units import parse_duration, parse_length, parse_speed

_SAY_IT = "say --uavs 4 --range 12km (or --endurance 25min --speed 12m/s), or give a --fleet file"


@dataclass(frozen=True)
class FleetOptions:
    """
    What a command line or a form says about the fleet, as text with units where it is a quantity.

    :param file: CSV file of the fleet
    :param uavs: Number of equal UAVs
    :param range: How far each flies, such as ``"12km"``
    :param endurance: How long each flies, such as ``"25min"``
    :param speed: Cruise speed, such as ``"12m/s"``; with a file, that of UAVs whose speed it does not say
    :param reserve_percent: Part of the range that no plan may use; with a file, at least this much
    """

    file: Path | None = None
    uavs: int | None = None
    range: str | None = None
    endurance: str | None = None
    speed: str | None = None
    reserve_percent: float = 0.0

    def fleet(self, tasks: TaskList) -> Fleet:
        """
        :param tasks: The tasks, whose file may say which UAVs there are
        :return: The fleet, checked
        :raises OSError: If the file cannot be read
        :raises ValueError: If an option or the file is wrong, or nothing says which UAVs there are
        """
        fleet = self._fleet(tasks)
        check_fleet(fleet)
        check_fits(tasks, fleet)
        return fleet

    def _fleet(self, tasks: TaskList) -> Fleet:
        if not 0 <= self.reserve_percent < 100:
            raise ValueError(f"--reserve is {self.reserve_percent:g}; give a percentage of the range from 0 to below 100.")
        speed = _positive("--speed", self.speed, parse_speed)
        is_described = any(option is not None for option in (self.uavs, self.range, self.endurance))
        if self.file is not None:
            if is_described:
                raise ValueError("--fleet says it all; leave out --uavs, --range and --endurance.")
            return self._completed(read_fleet(self.file), speed)
        if is_described:
            return self._equal(speed)
        if tasks.fleet is None:
            raise ValueError(f"Nothing says which UAVs there are; {_SAY_IT}.")
        return self._completed(tasks.fleet, speed)

    def _completed(self, fleet: Fleet, speed: float | None) -> Fleet:
        uavs = (
            replace(
                uav,
                speed_mps=speed if uav.speed_mps is None else uav.speed_mps,
                reserve_percent=max(uav.reserve_percent, self.reserve_percent),
            )
            for uav in fleet
        )
        return replace(fleet, uavs=tuple(uavs))

    def _equal(self, speed: float | None) -> Fleet:
        if self.uavs is None:
            raise ValueError(f"--uavs, the number of UAVs, is missing; {_SAY_IT}.")
        check_fleet_size(self.uavs, "--uavs")
        reach = _positive("--range", self.range, parse_length)
        endurance = _positive("--endurance", self.endurance, parse_duration)
        if reach is not None and endurance is not None:
            raise ValueError("--range and --endurance say the same; give one of them.")
        if reach is None:
            if endurance is None:
                raise ValueError(f"--range, how far every UAV flies, is missing; {_SAY_IT}.")
            if speed is None:
                raise ValueError(f"--endurance needs --speed; {_SAY_IT}.")
            reach = endurance * speed
        return Fleet.of_equal(self.uavs, reach, speed, self.reserve_percent, source="options")


def _positive(option: str, text: str | None, parse: Callable[[str], float]) -> float | None:
    """
    :param option: Name of the option
    :param text: Its value
    :param parse: Returns the quantity in SI units
    :return: The quantity; None without a text
    :raises ValueError: If it is not a finite quantity above 0
    """
    if text is None:
        return None
    try:
        value = parse(text)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from error
    if not 0 < value < math.inf:
        raise ValueError(f"{option} is {text}; give a finite quantity above 0.")
    return value

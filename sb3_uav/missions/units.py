"""Lengths, speeds, durations and positions as people write them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

#: Meters per unit. ``nm`` is the nautical mile of aviation.
LENGTHS: Mapping[str, float] = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("yd", "yard", "yards"), 0.9144),
    **dict.fromkeys(("mi", "mile", "miles"), 1609.344),
    **dict.fromkeys(("nmi", "nm"), 1852.0),
}
#: Meters per second per unit
SPEEDS: Mapping[str, float] = {
    **dict.fromkeys(("mps", "m/s", "m_s", "ms"), 1.0),
    **dict.fromkeys(("kmh", "kph", "km/h", "km_h"), 1 / 3.6),
    "mph": 1609.344 / 3600,
    **dict.fromkeys(("kn", "kt", "kts", "knot", "knots"), 1852 / 3600),
    **dict.fromkeys(("fps", "ft/s", "ft_s"), 0.3048),
}
#: Seconds per unit
DURATIONS: Mapping[str, float] = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
}
# Those that messages offer, of many spellings.
_OFFERED = {"length": "m, km, ft, yd, mi, nmi", "speed": "m/s, km/h, mph, kn, ft/s", "duration": "s, min, h"}
_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,9})?", re.ASCII)
_WITH_UNIT = re.compile(rf"({_NUMBER.pattern})\s*(\D.*)?", re.ASCII)


def number_of(text: str) -> float:
    """
    :param text: A decimal number with a decimal point, and nothing else
    :return: The number, possibly infinite if it is too great
    :raises ValueError: If it is no number; also for ``nan``, ``inf`` and ``1_000``, which Python reads
    """
    if len(text) > 100 or not _NUMBER.fullmatch(text):
        raise ValueError(f"{text!r:.60} is no number")
    return float(text)


def length_unit(name: str) -> float:
    """
    :param name: A unit, such as ``"km"``
    :return: Its length in meters
    :raises ValueError: If it is not known
    """
    try:
        return LENGTHS[name.strip().lower()]
    except KeyError:
        raise ValueError(f"{name!r:.60} is no unit of length; give one of {_OFFERED['length']}.") from None


def parse_length(text: str) -> float:
    """
    :param text: Such as ``"12km"``, ``"12 km"`` or ``"12000"``; meters where nothing is said
    :return: Meters; the sign is not checked
    :raises ValueError: If there is no number, or the unit is not known
    """
    return _parse(text, "length", LENGTHS, "12km")


def parse_speed(text: str) -> float:
    """
    :param text: Such as ``"10"``, ``"10 m/s"`` or ``"36km/h"``; meters per second where nothing is said
    :return: Meters per second; the sign is not checked
    :raises ValueError: If there is no number, or the unit is not known
    """
    return _parse(text, "speed", SPEEDS, "36km/h")


def parse_duration(text: str) -> float:
    """
    :param text: Such as ``"90"``, ``"90 s"`` or ``"1.5min"``; seconds where nothing is said
    :return: Seconds; the sign is not checked
    :raises ValueError: If there is no number, or the unit is not known
    """
    return _parse(text, "duration", DURATIONS, "25min")


def _parse(text: str, what: str, units: Mapping[str, float], example: str) -> float:
    found = _WITH_UNIT.fullmatch(text.strip()) if len(text) <= 100 else None
    if found is None:
        raise ValueError(f"{text!r:.60} is no {what}; write it like {example}, decimals with a point.")
    number, unit = found.groups()
    factor = 1.0 if unit is None else units.get(unit.strip().lower())
    if factor is None:
        hint = " (m are meters; minutes are min)" if what == "duration" and unit.strip().lower() == "m" else ""
        raise ValueError(
            f"{text!r:.60}: {unit.strip()!r:.40} is no unit of {what}{hint}; write one of {_OFFERED[what]} after the number."
        )
    value = float(number) * factor
    if not math.isfinite(value):
        raise ValueError(f"{text!r:.60} is no finite {what}.")
    return value


def parse_point(text: str) -> tuple[float, float]:
    """
    :param text: Two numbers with a comma, a semicolon or spaces between them: ``"LAT,LON"`` in degrees, or ``"X,Y"``
    :return: The two numbers, ranges not checked
    :raises ValueError: If these are not two finite numbers
    """
    words = re.split(r"\s*[,;]\s*|\s+", text.strip()) if len(text) <= 100 else []
    try:
        first, second = (number_of(word) for word in words)
        if not (math.isfinite(first) and math.isfinite(second)):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{text!r:.60} is no position; write two numbers, LAT,LON in degrees or X,Y, decimals with a point."
        ) from None
    return first, second

"""Words, numbers and colors that all drawings of a mission share."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from sb3_uav.envs.render import UAV_COLORS
from sb3_uav.missions.coordinates import System
from sb3_uav.missions.plan import Plan, Route, Skipped

_MAX_CHARACTERS = 60
# Joiners without which scripts such as Persian, and some emoji, fall apart.
_JOINERS = "\u200c\u200d"
# Below this luminance white letters are easier to read than black ones: both have the same contrast there, see
# https://www.w3.org/TR/WCAG21/#dfn-contrast-ratio.
_MIDDLE_LUMINANCE = 0.179


def shown(text: str, limit: int = _MAX_CHARACTERS) -> str:
    """
    :param text: A name from a file
    :param limit: Characters that fit
    :return: The name, cut if it is too long, without control characters and those that turn the direction of writing
    """
    cut = text if len(text) <= limit else f"{text[: limit - 1]}…"
    return "".join(letter if letter.isprintable() or letter in _JOINERS else "\ufffd" for letter in cut)


def escaped(text: str, limit: int = _MAX_CHARACTERS) -> str:
    """
    :param text: A name from a file, or a sentence with one in it
    :param limit: Characters that fit
    :return: The same for HTML, between tags or in a quoted attribute
    """
    return html.escape(shown(text, limit))


def uav_color(uav: int) -> str:
    """:return: The color of a UAV, by its number from 0"""
    return UAV_COLORS[uav % len(UAV_COLORS)]


class Look(NamedTuple):
    """
    How a UAV is drawn. There are eight colors that people of any color vision tell apart; the ninth UAV has the first color
    again, with hollow stops, the seventeenth with a dashed line, and so on.

    :param dash: Of its line, as plotly names it
    :param fill: Color of its stops
    :param edge: Color around its stops
    :param edge_width: Pixels
    """

    dash: str
    fill: str
    edge: str
    edge_width: float

    @property
    def dash_array(self) -> str:
        """The dash for SVG; empty for a solid line."""
        return _DASHES[self.dash]


_DASHES = {"solid": "", "dash": "7 4", "dot": "2 3", "dashdot": "8 3 2 3"}


def uav_look(uav: int) -> Look:
    """:return: How a UAV is drawn, by its number from 0"""
    color, style = uav_color(uav), uav // len(UAV_COLORS)
    dash = list(_DASHES)[style // 2 % len(_DASHES)]
    return Look(dash, "#ffffff", color, 2.0) if style % 2 else Look(dash, color, "#ffffff", 1.0)


def ink_on(color: str) -> str:
    """
    :param color: A color such as ``"#0072B2"``
    :return: Black or white, whichever is easier to read on it
    """
    parts = [int(color[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    luminance = sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return "#ffffff" if luminance < _MIDDLE_LUMINANCE else "#000000"


def number(value: float) -> str:
    """:return: A value, with at most six digits that count"""
    return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:,.6g}"


def meters(length: float) -> str:
    """:return: A length in meters, or in kilometers where that is shorter"""
    if length < 999.5:
        return f"{length:.0f} m"
    kilometers = length / 1000
    return f"{kilometers:.2f} km" if kilometers < 99.995 else f"{kilometers:,.0f} km"


def percent(share: float) -> str:
    """:return: A share, never rounded up to all of it"""
    return "100 %" if share >= 1 else f"{min(100 * share, 99.9):.1f} %"


def duration(seconds: float) -> str:
    """:return: Minutes and seconds"""
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60:02d} s"


def count(n: int, what: str) -> str:
    """:return: ``"1 task"``, ``"2 tasks"``"""
    return f"{n:,} {what}" if n == 1 else f"{n:,} {what}s"


def position(system: System, point: Sequence[float] | Any) -> str:
    """:return: A position in the user's coordinates, with centimeters for degrees"""
    first, second = (float(value) for value in point)
    return f"lat {first:.7f}, lon {second:.7f}" if system == "wgs84" else f"x {first:.10g}, y {second:.10g}"


def why_skipped(skipped: Skipped) -> str:
    """:return: Why a task is left out, and how much range is missing"""
    if skipped.missing_m is None:
        return skipped.reason
    missing = "less than 1 m" if skipped.missing_m < 1 else at_least(skipped.missing_m)
    return f"{skipped.reason}: {missing} of range missing"


def at_least(length: float) -> str:
    """:return: A length in meters or kilometers, rounded up, so that so much more range is enough"""
    return f"{math.ceil(length)} m" if length < 10_000 else f"{math.ceil(length / 100) / 10:,.1f} km"


def proof(plan: Plan) -> str:
    """:return: The proven bound and how far the objective may be from it; empty without a bound"""
    if plan.bound is None or plan.gap is None:
        return ""
    return f"proven bound {number(plan.bound)}, gap {100 * max(plan.gap, 0.0):.1f} %"


def route_facts(route: Route) -> str:
    """:return: Stops, length and share of the range of a route, in short"""
    if not route.flies:
        return "stays on the ground"
    return f"{count(len(route.stops), 'stop')}, {meters(route.length_m)}, {percent(route.share_of_range)} of range"


def headline(plan: Plan) -> str:
    """:return: What a plan achieves, in one line"""
    total = float(plan.tasks.values.sum())
    share = f" ({percent(plan.objective / total)})" if total > 0 else ""
    parts = [
        f"Objective {number(plan.objective)} of {number(total)}{share}",
        f"{plan.n_served:,} of {count(len(plan.tasks), 'task')} served",
        f"{count(len(plan.fleet), 'UAV')}, {meters(plan.length_m)} in all",
    ]
    if proof(plan):
        parts.append(proof(plan))
    if plan.unserved:
        parts.append(f"{count(len(plan.unserved), 'task')} that must be served left out")
    return " · ".join(parts)

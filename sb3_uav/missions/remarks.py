"""What a person should know before flying a plan."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from sb3_uav.missions.crossings import SEPARATION_M, find_crossings
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.labels import position, shown
from sb3_uav.missions.plan import Plan

REVIEW = "A person must review this plan before it is flown. Wind, terrain, obstacles and no-fly zones are not modeled."
# More names than these do not help a reader.
_MAX_NAMED = 5
_LONG_LEG_M = 100_000.0
_DISTORTION = 1e-3
# What the rules for open categories allow in many countries: 120 m (EU), 400 ft (USA).
_HIGH_M = 122.0


def remarks_on(plan: Plan, flight: FlightOptions | None = None) -> tuple[str, ...]:
    """
    :param plan: The plan
    :param flight: How it is flown; without it, nothing is said about altitudes
    :return: A sentence for everything that is out of the ordinary, and at the end what no plan takes into account
    """
    remarks = [*plan.notes, *_of_tasks(plan), *plan.tasks.notes, *_of_fleet(plan), *_of_lengths(plan), *_of_launches(plan)]
    if flight is not None:
        remarks += [*_of_crossings(plan, flight), *_of_altitudes(plan, flight), *_of_return(plan, flight)]
    return (*remarks, REVIEW)


def named(names: Sequence[str], most: int = _MAX_NAMED) -> str:
    """
    :param names: Names
    :param most: How many to write out
    :return: The first ones, fit to be printed, and how many more there are
    """
    more = len(names) - most
    return ", ".join(map(shown, names[:most])) + (f" and {more} more" if more > 0 else "")


def _of_tasks(plan: Plan) -> list[str]:
    if not plan.unserved:
        return []
    names = named([plan.tasks.ids[task] for task in plan.unserved])
    return [f"Not served, though it must be: {names}."]


def _of_fleet(plan: Plan) -> list[str]:
    remarks = []
    without = [uav.id for uav in plan.fleet if uav.reserve_percent == 0]
    if without:
        remarks.append(f"No reserve is kept ({named(without)}); --reserve PERCENT keeps a part of the range.")
    grounded = [route.uav.id for route in plan.routes if not route.flies and (route.points[0] != route.points[-1]).any()]
    if grounded:
        remarks.append(f"Without a route, because the place where it has to land is out of its reach: {named(grounded)}.")
    speeds = {uav.speed_mps for uav in plan.fleet if uav.speed_mps is not None}
    if len(speeds) > 1 and (plan.tasks.service_s > 0).any():
        remarks.append(
            f"Speeds differ: a second of service costs every UAV {max(speeds):g} m of its range, what the fastest flies; "
            f"slower ones are charged too much, never too little."
        )
    return remarks


def _of_lengths(plan: Plan) -> list[str]:
    remarks = []
    longest = max(plan.routes, key=lambda route: route.legs_m.max())
    if longest.legs_m.max() > _LONG_LEG_M:
        remarks.append(
            f"A leg of UAV {shown(longest.uav.id)} is {longest.legs_m.max() / 1000:.0f} km long; check coordinates, units and "
            f"ranges."
        )
    if plan.tasks.system == "wgs84":
        coordinates = plan.tasks.coordinates()
        legs = np.concatenate([route.legs_m for route in plan.routes])
        in_plane = np.concatenate([np.hypot(*np.diff(coordinates.to_plane(route.points), axis=0).T) for route in plan.routes])
        flown = legs > 0
        distortion = float((in_plane[flown] / legs[flown]).max(initial=1.0) - 1.0)
        if distortion > _DISTORTION:
            remarks.append(
                f"So far from the depot the plane of the solver is up to {distortion:.1%} too long; the lengths in this plan "
                f"are right, but a UAV may reach more than the solver took into account."
            )
    return remarks


def _of_launches(plan: Plan) -> list[str]:
    """Who takes off first, where several start at one place."""
    at_place: dict[tuple[float, ...], list[int]] = defaultdict(list)
    for number, route in enumerate(plan.routes):
        if route.flies:
            at_place[tuple(route.points[0])].append(number)
    remarks = []
    for uavs in at_place.values():
        if len(uavs) < 2:
            continue
        routes = [plan.routes[number] for number in uavs]
        is_timed = all(route.seconds is not None for route in routes)
        longest_first = sorted(routes, key=lambda route: -((route.seconds or 0.0) if is_timed else route.used_m))
        order = ", ".join(shown(route.uav.id) for route in longest_first[: 2 * _MAX_NAMED])
        more = len(routes) - 2 * _MAX_NAMED
        measure = "longest time in the air" if is_timed else "longest route"
        place = "" if len(at_place) == 1 else f" at {position(plan.tasks.system, routes[0].points[0])}"
        remarks.append(
            f"Launch one after the other{place}, the {measure} first: {order}"
            f"{f' and {more} more by the length of their routes' if more > 0 else ''}."
        )
    return remarks


def _of_crossings(plan: Plan, flight: FlightOptions) -> list[str]:
    crossings = find_crossings(plan, flight)
    if not crossings:
        return []
    ids = [uav.id for uav in plan.fleet]
    pairs = dict.fromkeys(f"{ids[crossing.uavs[0]]} with {ids[crossing.uavs[1]]}" for crossing in crossings)
    count = "1 pair of legs crosses" if len(crossings) == 1 else f"{len(crossings)} pairs of legs cross"
    advice = (
        f"--altitude-step {2 * SEPARATION_M:g} keeps the UAVs apart"
        if flight.altitude_step_m < SEPARATION_M
        else "tasks with altitudes of their own bring UAVs to one level"
    )
    return [f"At one altitude (less than {SEPARATION_M:g} m apart) {count}: {named(list(pairs))}; {advice}."]


def _of_altitudes(plan: Plan, flight: FlightOptions) -> list[str]:
    high = []
    for number, route in enumerate(plan.routes):
        if route.flies:
            wanted = plan.tasks.altitudes[list(route.stops)]
            if np.nanmax(np.array([flight.altitude_of(plan.fleet.level_of(number)), *wanted])) > _HIGH_M:
                high.append(route.uav.id)
    if not high:
        return []
    return [f"Above 120 m, which many countries do not allow without a permit: {named(high)}."]


def _of_return(plan: Plan, flight: FlightOptions) -> list[str]:
    """
    Autopilots return at an altitude of their own, where that is higher: see RTL_RETURN_ALT of
    https://docs.px4.io/main/en/flight_modes/return.html and RTL_ALT of https://ardupilot.org/copter/docs/rtl-mode.html.
    """
    flying = [number for number, route in enumerate(plan.routes) if route.flies]
    if plan.tasks.system != "wgs84" or flight.landing != "rtl" or len(flying) < 2:
        return []
    name = "RTL_RETURN_ALT" if flight.firmware == "px4" else "RTL_ALT"
    lowest = min(flight.altitude_of(plan.fleet.level_of(number)) for number in flying)
    return [
        f"UAVs below the return altitude of their autopilot ({name}) climb to it on the way back; set it to {lowest:g} m or "
        f"less, or their legs home are at one altitude."
    ]

"""What tasks and fleets from outside must be like, whatever the format of their file."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator, Sequence

import numpy as np

from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.tasks import TaskList

#: Most bytes of a file that are read.
MAX_BYTES = 32 * 2**20
#: Most tasks of a file.
MAX_TASKS = 100_000
#: Most UAVs of a fleet. Every one is an object in memory, so this is far below what instances allow.
MAX_FLEET = 10_000
#: Most characters of a name.
MAX_NAME = 200
#: What is said of tasks without names, which may have one where nothing looks for it.
UNNAMED = (
    "No id or name is given, so the tasks are called 1, 2, ... in the order of the file; if something else in it names them, "
    "call that id."
)
# Far beyond what flies, and far within what float32 and sums of squares can hold.
_MOST_METERS = 1e9
_MOST_VALUE = 1e12
_MOST_SECONDS = 1e9
_MOST_SPEED = 1e4
_ALTITUDES = (-1_000.0, 10_000.0)
# Tasks this far from the depot are beyond what flies, and this near to it they are not.
_FAR_DEGREES, _NEAR_DEGREES = 5.0, 2.0
# Text that reverses what follows makes a name look like another one.
_BIDI = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
# Control characters, halves of characters that UTF-8 cannot hold, and separators of lines.
_FORBIDDEN = frozenset(("Cc", "Cs", "Zl", "Zp"))


def check_tasks(tasks: TaskList, allow_duplicates: bool = False) -> None:
    """
    :param tasks: The tasks, possibly from somebody else's file
    :param allow_duplicates: Whether two tasks may be at the same place
    :raises ValueError: If there are none or too many, a name is empty, doubled or not printable, a number is not finite or out
        of its range, latitude and longitude seem to be swapped or meters, or two tasks are at the same place; the message
        names the file, the place in it, the field and what was found
    """
    source = tasks.source
    if len(tasks) == 0:
        raise ValueError(f"{source}: there is no task; give at least one.")
    if len(tasks) > MAX_TASKS:
        raise ValueError(f"{source}: there are {len(tasks)} tasks, but at most {MAX_TASKS} are read; divide the file.")
    if not (math.isfinite(tasks.meters_per_unit) and tasks.meters_per_unit > 0):
        raise ValueError(f"{source}: a unit of {tasks.meters_per_unit:g} m is none; give a length above 0.")
    check_names(tasks.ids, tasks.places, source)
    _check_points(tasks)
    _check_depot_is_near(tasks)
    _check_range(tasks, "value", tasks.values, 0.0, _MOST_VALUE)
    _check_range(tasks, "service_s", tasks.service_s, 0.0, _MOST_SECONDS)
    given = ~np.isnan(tasks.altitudes)
    _check_range(tasks, "alt_m", np.where(given, tasks.altitudes, 0.0), *_ALTITUDES)
    if not allow_duplicates:
        _check_places(tasks)


def check_names(names: Sequence[str], places: Sequence[str], source: str) -> None:
    """
    :param names: Names, all of one kind
    :param places: Where in the file every one stands
    :param source: Name of the file
    :raises ValueError: If a name is empty, too long, not printable, or there twice
    """
    first: dict[str, int] = {}
    for row, (name, place) in enumerate(zip(names, places, strict=True)):
        where = f"{source}: {place}"
        if not name or name != name.strip():
            raise ValueError(f"{where}: id is {name!r:.60}; give a name that neither begins nor ends with a space.")
        if len(name) > MAX_NAME:
            raise ValueError(f"{where}: id {name!r:.60} has {len(name)} characters; give a name of at most {MAX_NAME}.")
        if not name.isprintable() and any(unicodedata.category(char) in _FORBIDDEN or char in _BIDI for char in name):
            raise ValueError(f"{where}: id is {name!a:.60}, with a control character; remove it.")
        other = first.setdefault(name, row)
        if other != row:
            raise ValueError(f"{where}: id {name!r:.60} is that of {places[other]} too; give every one a name of its own.")


def check_not_degrees(tasks: TaskList) -> None:
    """
    :param tasks: Tasks in a plane whose file does not say the unit
    :raises ValueError: If their coordinates may well be degrees
    """
    x, y = np.abs(tasks.points if tasks.depot is None else np.vstack([tasks.points, tasks.depot])).T
    if len(tasks) and (x <= 180).all() and (y <= 90).all() and ((x % 1 != 0) | (y % 1 != 0)).any():
        x, y = tasks.points[0]
        raise ValueError(
            f"{tasks.source}: {tasks.places[0]}: x, y are {_text(x)}, {_text(y)}, and all points look like degrees; if so, "
            "name the columns lon and lat; if not, say the unit (--unit m, or columns x_m and y_m)."
        )


def _check_points(tasks: TaskList) -> None:
    points = tasks.points if tasks.depot is None else np.vstack([tasks.points, tasks.depot])
    names = ("lat", "lon") if tasks.system == "wgs84" else ("x", "y")
    limits = (90.0, 180.0) if tasks.system == "wgs84" else (_MOST_METERS / max(tasks.meters_per_unit, 1.0),) * 2
    # NaN is within no limits.
    bad = ~(np.abs(points) <= limits)
    is_unset = (points == 0).all(1) & (tasks.system == "wgs84")
    wrong = np.flatnonzero(bad.any(1) | is_unset)
    if len(wrong) == 0:
        return
    row = int(wrong[0])
    where = f"{tasks.source}: {tasks.places[row] if row < len(tasks) else 'depot'}: "
    if is_unset[row]:
        raise ValueError(f"{where}lat and lon are both 0, which is the sea off Africa; give the position.")
    axis = int(np.flatnonzero(bad[row])[0])
    raise ValueError(f"{where}{names[axis]} is {_text(points[row, axis])}; {_advice(points[row], axis, tasks.system, limits)}")


def _check_depot_is_near(tasks: TaskList) -> None:
    """
    :raises ValueError: If all tasks are far from the depot, but near it once latitude and longitude change places
    """
    if tasks.system != "wgs84" or tasks.depot is None:
        return
    near, swapped = (np.abs(points - tasks.depot).max(axis=1) for points in (tasks.points, tasks.points[:, ::-1]))
    if near.min() > _FAR_DEGREES and swapped.max() < _NEAR_DEGREES:
        latitude, longitude = tasks.points[0]
        raise ValueError(
            f"{tasks.source}: {tasks.places[0]}: lat, lon are {_text(latitude)}, {_text(longitude)}, but the depot is at "
            f"{_text(tasks.depot[0])}, {_text(tasks.depot[1])}: latitude and longitude look swapped in one of the two; "
            "exchange them there."
        )


def _advice(point: np.ndarray, axis: int, system: str, limits: tuple[float, float]) -> str:
    """:return: What may be wrong with the coordinates of a point, one of which is out of its range"""
    if not np.isfinite(point[axis]):
        return "give a finite number."
    if system == "plane":
        return f"coordinates must be within {limits[axis]:g} of the origin."
    latitude, longitude = np.abs(point)
    if 90 < latitude <= 180 and longitude <= 90:
        return f"latitudes are within 90 degrees, and lon is {_text(point[1])}: are they swapped?"
    if max(latitude, longitude) > 360:
        return f"that looks like meters, not degrees (within {limits[axis]:g}); name the columns x and y if it is."
    if axis == 1 and longitude <= 360:
        return "longitudes are from -180 to 180 degrees; add or subtract 360."
    return f"degrees must be within {limits[axis]:g}."


def _check_range(tasks: TaskList, name: str, numbers: np.ndarray, least: float, most: float) -> None:
    wrong = np.flatnonzero(~((numbers >= least) & (numbers <= most)))
    if len(wrong):
        row = int(wrong[0])
        raise ValueError(
            f"{tasks.source}: {tasks.places[row]}: {name} is {_text(numbers[row])}; give a number from {least:g} to {most:g}."
        )


def _check_places(tasks: TaskList) -> None:
    points = tasks.points + 0.0
    if tasks.system == "wgs84":
        points[:, 1] = np.where(points[:, 1] == 180.0, -180.0, points[:, 1])
    first: dict[tuple[float, ...], int] = {}
    for row, point in enumerate(map(tuple, points.tolist())):
        other = first.setdefault(point, row)
        if other != row:
            raise ValueError(
                f"{tasks.source}: {tasks.places[row]}: task {tasks.ids[row]} is where task {tasks.ids[other]} "
                f"({tasks.places[other]}) is, at {_text(point[0])}, {_text(point[1])}; remove one, or give --allow-duplicates."
            )


def check_fleet_size(n_uavs: int, source: str = "fleet") -> None:
    """
    Call it before building that many UAVs.

    :param n_uavs: Number of UAVs
    :param source: Name of the file or option, for errors
    :raises ValueError: If there are none or too many
    """
    if not 1 <= n_uavs <= MAX_FLEET:
        raise ValueError(f"{source}: there are {n_uavs} UAVs; give at least 1, and {MAX_FLEET} at most.")


def check_fleet(fleet: Fleet, places: Sequence[str] = (), is_flying: bool = False) -> None:
    """
    :param fleet: UAVs from a file or from options
    :param places: Where in the file every one stands, for errors
    :param is_flying: Whether they may be in the air, with no range left, or nothing but their reserve
    :raises ValueError: If there are none or too many, a name is doubled, or a range, a speed, a reserve or a place is not
        allowed; the message names the UAV and what was found
    """
    check_fleet_size(len(fleet), fleet.source)
    places = places or [f"UAV {number}" for number in range(1, len(fleet) + 1)]
    for uav, place in zip(fleet, places, strict=True):
        wrong = next(_wrong_with(uav, is_flying), None)
        if wrong is not None:
            raise ValueError(f"{fleet.source}: {place}: {wrong}")
    check_names([uav.id for uav in fleet], places, fleet.source)


def check_fits(tasks: TaskList, fleet: Fleet) -> None:
    """
    :param tasks: The tasks
    :param fleet: The UAVs
    :raises ValueError: If starts or ends of UAVs cannot be in the coordinates of the tasks
    """
    has_places = any(uav.start is not None or uav.end is not None for uav in fleet)
    if has_places and fleet.system is not None and fleet.system != tasks.system:
        named = {"wgs84": "lat and lon", "plane": "x and y"}
        raise ValueError(
            f"{fleet.source}: UAVs start or end at {named[fleet.system]}, but {tasks.source} has {named[tasks.system]}; "
            "use one system in both."
        )
    if tasks.system == "plane":
        return
    for uav in fleet:
        for name, point in (("start", uav.start), ("end", uav.end)):
            if point is not None and not (abs(point[0]) <= 90 and abs(point[1]) <= 180):
                raise ValueError(
                    f"{fleet.source}: UAV {uav.id}: {name} is {_text(point[0])}, {_text(point[1])}; give LAT,LON in degrees, "
                    "within 90 and 180."
                )


def _wrong_with(uav: Uav, is_flying: bool) -> Iterator[str]:
    """:return: What is wrong with a UAV"""
    if not (0 < uav.range_m <= _MOST_METERS or (is_flying and uav.range_m == 0)):
        yield f"the range is {_text(uav.range_m)} m; give one above 0, and {_MOST_METERS:g} m at most."
    if uav.speed_mps is not None and not 0 < uav.speed_mps <= _MOST_SPEED:
        yield f"the speed is {_text(uav.speed_mps)} m/s; give one above 0, and {_MOST_SPEED:g} m/s at most."
    if uav.full_range_m is not None and not 0 < uav.full_range_m <= _MOST_METERS:
        yield f"the full range is {_text(uav.full_range_m)} m; give one above 0, and {_MOST_METERS:g} m at most."
    if uav.level is not None and not 0 <= uav.level < MAX_FLEET:
        yield f"the level is {uav.level}; give a whole number from 0 to below {MAX_FLEET}."
    if not (0 <= uav.reserve_percent < 100 or (is_flying and uav.reserve_percent == 100)):
        yield f"the reserve is {_text(uav.reserve_percent)} %; give a percentage from 0 to below 100."
    for name, point in (("start", uav.start), ("end", uav.end)):
        if point is not None and not all(abs(number) <= _MOST_METERS for number in point):
            yield f"{name} is {_text(point[0])}, {_text(point[1])}; give two finite numbers."


def _text(number: float) -> str:
    return f"{float(number):.12g}"

"""
Tasks in GeoJSON.

Format: https://www.rfc-editor.org/rfc/rfc7946. Positions are longitude, latitude and, possibly, height.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sb3_uav.missions.checks import UNNAMED
from sb3_uav.missions.coordinates import System
from sb3_uav.missions.readers.json_file import flag_of, id_of, number_of, parse_json, shown
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.geojson_routes import PLANE_MEMBER

# Names of longitude and latitude on WGS84 in the "crs" member of GeoJSON before the RFC.
_CRS84 = frozenset({"urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:OGC::CRS84", "OGC:CRS84"})
_ALTITUDE_NAMES = ("alt", "altitude", "altitude_m")
_HEIGHTS = (
    "The third coordinates of the file are heights above the ellipsoid and are not flown; a property alt gives a task an "
    "altitude in meters above the depot."
)


def read_geojson(data: bytes, source: str) -> TaskList:
    """
    Read a FeatureCollection of Points, or a single Feature.

    Properties, in any case of letters: ``id`` or ``name`` (or else the ``id`` of the feature, or its number), ``value`` or
    ``priority`` (1 by default), ``service_s`` (0), ``must`` (false), and ``alt``, ``altitude`` or ``altitude_m``, meters above
    the depot. A third coordinate is a height above the ellipsoid (RFC 7946, section 3.1.1), often that of the ground, so it is
    no altitude to fly at; a note says that it is not used. At most one feature has ``"depot": true``. Other properties and
    bounding boxes are not looked at.

    Anything but a Point is refused, a MultiPoint too, whose points have no names. So is any coordinate reference system but
    longitude and latitude on WGS84 (CRS84). A collection with the member ``sb3_uav_plane``, as
    :func:`~sb3_uav.missions.writers.geojson_tasks.write_tasks_geojson` writes it, has coordinates of a plane.

    :param data: The file
    :param source: Its name, for errors
    :return: The tasks in the order of the file, coordinates not checked for their range
    :raises ValueError: If something is wrong or not known; the message names the feature, counted from 1
    """
    content = parse_json(data, source)
    _check_crs(content, source)
    system, unit = _plane_of(content, source)
    rows: list[dict[str, Any]] = []
    depot: list[float] | None = None
    has_heights = has_names = False
    for number, feature in enumerate(_features_of(content, source), 1):
        where = f"{source}: feature {number}"
        position = _position_of(feature, where)
        point = position[:2] if system == "plane" else position[1::-1]
        properties = _properties_of(feature, where)
        if flag_of(properties.get("depot"), "depot", where):
            if depot is not None:
                raise ValueError(f"{where}: this is the second depot; flag one feature as the depot.")
            depot = point
            continue
        altitude = _first(properties, _ALTITUDE_NAMES)
        has_heights |= altitude is None and len(position) == 3 and position[2] != 0
        name = _id_of(feature, properties, where)
        has_names |= name is not None
        rows.append(
            {
                "id": str(number) if name is None else name,
                "point": point,
                "value": _number(properties, ("value", "priority"), 1.0, where),
                "service_s": _number(properties, ("service_s",), 0.0, where),
                "must": flag_of(properties.get("must"), "must", where),
                "altitude": math.nan if altitude is None else number_of(altitude, "altitude", where),
                "place": f"feature {number}",
            }
        )
    if not rows:
        raise ValueError(f"{source}: there are no tasks; write a Point for every task.")
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return TaskList.of(
        columns["id"],
        columns["point"],
        system,
        columns["value"],
        columns["service_s"],
        columns["must"],
        depot=depot,
        altitudes=np.array(columns["altitude"], float),
        meters_per_unit=unit,
        places=tuple(columns["place"]),
        source=source,
        notes=(*((_HEIGHTS,) if has_heights else ()), *(() if has_names else (UNNAMED,))),
    )


def _features_of(content: dict[str, Any], source: str) -> list[Any]:
    kind = content.get("type")
    if kind == "Feature":
        return [content]
    if kind is None and "plannedHomePosition" in content:
        raise ValueError(f"{source}: this is a mission of an old QGroundControl; open it there and save it as .plan.")
    if kind != "FeatureCollection":
        raise ValueError(f"{source}: type is {shown(kind)}; write a FeatureCollection of Points.")
    features = content.get("features")
    if not isinstance(features, list):
        raise ValueError(f"{source}: features is {shown(features)}; write a list of features.")
    return features


def _check_crs(content: dict[str, Any], source: str) -> None:
    if "crs" not in content:
        return
    crs = content["crs"]
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str) or name not in _CRS84:
        # By its definition latitudes come first there, but most programs write them second.
        more = ", or delete crs if longitudes come first in the coordinates" if str(name).endswith(":4326") else ""
        raise ValueError(
            f"{source}: crs is {shown(crs if name is None else name)}; export longitudes and latitudes on WGS84 (CRS84){more}."
        )


def _plane_of(content: dict[str, Any], source: str) -> tuple[System, float]:
    if PLANE_MEMBER not in content:
        return "wgs84", 1.0
    plane = content[PLANE_MEMBER]
    unit = plane.get("meters_per_unit") if isinstance(plane, dict) else None
    meters = number_of(unit, f"meters_per_unit of {PLANE_MEMBER}", source, 0.0)
    if meters == 0:
        raise ValueError(f"{source}: meters_per_unit of {PLANE_MEMBER} is 0; write the length of one unit.")
    return "plane", meters


def _position_of(feature: Any, where: str) -> list[float]:
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise ValueError(f"{where} is {shown(feature)}; write a Feature with a Point.")
    geometry = feature.get("geometry")
    if not isinstance(geometry, dict):
        raise ValueError(f"{where}: geometry is {shown(geometry)}; write a Point.")
    if geometry.get("type") != "Point":
        raise ValueError(
            f"{where} is a {shown(geometry.get('type'))}; only Points are tasks: make points of it in your GIS, or delete it."
        )
    position = geometry.get("coordinates")
    if not isinstance(position, list) or len(position) not in (2, 3):
        raise ValueError(
            f"{where}: coordinates is {shown(position)}; write [longitude, latitude] or [longitude, latitude, height]."
        )
    return [number_of(value, f"coordinate {axis}", where) for axis, value in enumerate(position, 1)]


def _properties_of(feature: dict[str, Any], where: str) -> dict[str, Any]:
    properties = feature.get("properties")
    if properties is None:
        return {}
    if not isinstance(properties, dict):
        raise ValueError(f"{where}: properties is {shown(properties)}; write an object.")
    return {**{name.lower(): value for name, value in properties.items()}, **properties}


def _id_of(feature: dict[str, Any], properties: dict[str, Any], where: str) -> str | None:
    for holder, name in ((properties, "id"), (properties, "name"), (feature, "id")):
        if holder.get(name) not in (None, ""):
            return id_of(holder[name], name, where)
    return None


def _first(properties: dict[str, Any], names: tuple[str, ...]) -> Any:
    return next((properties[name] for name in names if properties.get(name) is not None), None)


def _number(properties: dict[str, Any], names: tuple[str, ...], default: float, where: str) -> float:
    name = next((name for name in names if properties.get(name) is not None), None)
    return default if name is None else number_of(properties[name], name, where, 0.0)

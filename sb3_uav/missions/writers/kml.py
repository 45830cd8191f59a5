"""
Routes as KML, for Google Earth and other globes.

Format: OGC KML 2.3, https://docs.ogc.org/is/12-007r2/12-007r2.html (its elements used here are those of 2.2).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from pathlib import Path

from sb3_uav.common.files import write_atomically
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.writers.lines import split_at_antimeridian
from sb3_uav.missions.writers.mission_items import altitudes_of, check_is_geographic

_NAMESPACE = "http://www.opengis.net/kml/2.2"
# Colors of lines as KML has them: opacity, blue, green, red.
_COLORS = ("ff3c14dc", "ffc77a1f", "ff4b8f22", "ff00a5ff", "ff9e2d8b", "ffb0a000", "ff1f4fa8", "ff7f5f00")
# What XML 1.0 has no way to write (https://www.w3.org/TR/xml/#charsets), with the surrogates that UTF-8 cannot encode.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_kml(plan: Plan, path: Path, flight: FlightOptions) -> None:
    """
    Write a folder per UAV with its line and its numbered stops, one folder of skipped tasks, and the depot. Altitudes are
    drawn above the ground at every point; flown they are above the depot, which is not the same in hills.

    :param plan: A plan in latitudes and longitudes
    :param path: The file to write
    :param flight: How it is flown; says the altitudes
    :raises ValueError: If the plan is in a plane
    :raises OSError: If the file cannot be written
    """
    tasks = plan.tasks
    check_is_geographic(tasks, "KML files")
    root = ElementTree.Element("kml", xmlns=_NAMESPACE)
    document = ElementTree.SubElement(root, "Document")
    _text(document, "name", f"Routes for {Path(tasks.source).name}")
    for number, color in enumerate(_COLORS):
        style = ElementTree.SubElement(document, "Style", id=f"uav-{number}")
        line = ElementTree.SubElement(style, "LineStyle")
        _text(line, "color", color)
        _text(line, "width", "3")
    if tasks.depot is not None:
        _point(document, "Depot", "", tasks.depot.tolist(), 0.0)
    for uav, route in enumerate(plan.routes):
        if route.flies:
            _route_folder(document, plan, uav, route, flight)
    if plan.skipped:
        folder = _folder(document, "Skipped tasks")
        for skipped in plan.skipped:
            missing = "" if skipped.missing_m is None else f", {skipped.missing_m:.0f} m of range lack"
            _point(folder, tasks.ids[skipped.task], f"{skipped.reason}{missing}", tasks.points[skipped.task].tolist(), 0.0)
    ElementTree.indent(root, " ")
    write_atomically(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _route_folder(document: ElementTree.Element, plan: Plan, uav: int, route: Route, flight: FlightOptions) -> None:
    tasks, own = plan.tasks, flight.altitude_of(plan.fleet.level_of(uav))
    altitudes = altitudes_of(plan, uav, flight)
    folder = _folder(document, route.uav.id)
    placemark = ElementTree.SubElement(folder, "Placemark")
    _text(placemark, "name", f"Route of {route.uav.id}")
    _text(
        placemark,
        "description",
        f"{len(route.stops)} stops, {route.length_m:.0f} m, {100 * route.share_of_range:.1f} % of the range used",
    )
    _text(placemark, "styleUrl", f"#uav-{uav % len(_COLORS)}")
    parent = ElementTree.SubElement(placemark, "MultiGeometry")
    vertices = [
        (longitude, latitude, altitude)
        for (latitude, longitude), altitude in zip(route.points.tolist(), [own, *altitudes, own], strict=True)
    ]
    for part in split_at_antimeridian(vertices):
        line = ElementTree.SubElement(parent, "LineString")
        _text(line, "altitudeMode", "relativeToGround")
        _text(line, "coordinates", _coordinates(part))
    for number, (task, altitude) in enumerate(zip(route.stops, altitudes, strict=True), 1):
        hold = f", {tasks.service_s[task]:g} s" if tasks.service_s[task] > 0 else ""
        description = f"stop {number} of {route.uav.id}, value {tasks.values[task]:g}{hold}"
        _point(folder, f"{number}: {tasks.ids[task]}", description, tasks.points[task].tolist(), altitude)


def _folder(parent: ElementTree.Element, name: str) -> ElementTree.Element:
    folder = ElementTree.SubElement(parent, "Folder")
    _text(folder, "name", name)
    return folder


def _point(parent: ElementTree.Element, name: str, description: str, place: Sequence[float], altitude: float) -> None:
    placemark = ElementTree.SubElement(parent, "Placemark")
    _text(placemark, "name", name)
    if description:
        _text(placemark, "description", description)
    point = ElementTree.SubElement(placemark, "Point")
    _text(point, "altitudeMode", "relativeToGround")
    _text(point, "coordinates", _coordinates([(place[1], place[0], altitude)]))


def _coordinates(vertices: Iterable[Sequence[float]]) -> str:
    return " ".join(",".join(repr(number) for number in vertex) for vertex in vertices)


def _text(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, tag).text = _NOT_XML.sub("\ufffd", text)

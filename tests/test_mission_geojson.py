"""GeoJSON: tasks in and out, routes out."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mission_format_helpers import (
    accepts_or_refuses,
    json_values,
    mutated,
    plan_at_the_antimeridian,
    plane_plan,
    read_back,
    task_lists,
)

from sb3_uav.missions.readers.geojson import read_geojson
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.geojson_routes import write_routes_geojson
from sb3_uav.missions.writers.geojson_tasks import write_tasks_geojson
from sb3_uav.missions.writers.lines import split_at_antimeridian


def feature(longitude=8.0, latitude=47.0, *height, **properties):
    geometry = {"type": "Point", "coordinates": [longitude, latitude, *height]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def collection(*features, **members):
    return {"type": "FeatureCollection", **members, "features": list(features)}


def read(content):
    return read_geojson(json.dumps(content).encode(), "map.geojson")


DOCUMENT = collection(
    feature(8.0, 47.0, depot=True),
    feature(8.1, 47.1, 30.0, id="a", value=2, service_s=5, must=True, alt=20),
    {**feature(8.2, 47.2, name="b", priority=3), "id": 7},
    crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
)


def test_fields_and_their_defaults():
    tasks = read(DOCUMENT)
    assert tasks.ids == ("a", "b")
    assert tasks.system == "wgs84"
    assert tasks.points.tolist() == [[47.1, 8.1], [47.2, 8.2]]
    assert tasks.depot is not None
    assert tasks.depot.tolist() == [47.0, 8.0]
    assert tasks.values.tolist() == [2, 3]
    assert tasks.service_s.tolist() == [5, 0]
    assert tasks.must.tolist() == [True, False]
    assert tasks.altitudes.tolist() == pytest.approx([20, np.nan], nan_ok=True)
    assert tasks.places == ("feature 2", "feature 3")


@pytest.mark.parametrize(
    ("given_feature", "name"),
    [
        (feature(id=3), "3"),
        (feature(id=3.0), "3"),
        (feature(ID="x", name="y"), "x"),
        (feature(id=None, name="y"), "y"),
        ({**feature(name=""), "id": "top"}, "top"),
        ({**feature(), "id": 12}, "12"),
        (feature(), "1"),
        ({**feature(), "properties": None}, "1"),
    ],
)
def test_names(given_feature, name):
    assert read(collection(given_feature)).ids == (name,)
    assert read(given_feature).ids == (name,)


def test_third_coordinates_are_not_flown_and_a_note_says_so():
    tasks = read(collection(feature(8, 47, 30.5), feature(8, 48, 0), feature(8, 49, 400, alt=25)))
    assert tasks.altitudes.tolist() == pytest.approx([np.nan, np.nan, 25], nan_ok=True)
    assert "not flown" in tasks.notes[0]
    assert read(collection(feature(8, 48, 0), feature(8, 49, 400, alt=25))).notes == ()


@pytest.mark.parametrize("flag", [1, 1.0, True])
def test_systems_without_flags_write_numbers(flag):
    assert read(collection(feature(must=flag))).must.tolist() == [True]
    assert read(collection(feature(must=0), feature(8, 46, depot=flag))).depot is not None


def shaped(kind, coordinates):
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": {}}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (collection(feature(), shaped("Polygon", [])), "feature 2 is a 'Polygon'; only Points are tasks"),
        (collection(shaped("LineString", [[0, 1], [2, 3]])), "feature 1 is a 'LineString'"),
        (collection(shaped("MultiPoint", [[0, 1]])), "feature 1 is a 'MultiPoint'"),
        (collection(shaped("GeometryCollection", [])), "feature 1 is a 'GeometryCollection'"),
        (collection({**feature(), "geometry": None}), "feature 1: geometry is null"),
        (collection({**feature(), "properties": []}), r"feature 1: properties is \[\]"),
        (collection(feature(), 3), "feature 2 is 3"),
        (collection(shaped("Point", [8])), r"feature 1: coordinates is \[8\]"),
        (collection(shaped("Point", [8, 47, 0, 1])), "feature 1: coordinates is"),
        (collection(shaped("Point", {"x": 1})), "feature 1: coordinates is"),
        (collection(shaped("Point", [True, 47])), "feature 1: coordinate 1 is true"),
        (collection(shaped("Point", [8, "47"])), "feature 1: coordinate 2 is '47'"),
        (collection(shaped("Point", [8, 10**400])), "feature 1: coordinate 2 is 1000"),
        (collection(feature(value=-1)), "feature 1: value is -1; write 0 or more"),
        (collection(feature(priority="high")), "feature 1: value is 'high'"),
        (collection(feature(value=True)), "feature 1: value is true"),
        (collection(feature(service_s=-0.5)), "feature 1: service_s is -0.5"),
        (collection(feature(must="yes")), "feature 1: must is 'yes'; write true or false"),
        (collection(feature(alt="30 m")), "feature 1: altitude is '30 m'"),
        (collection(feature(id="x" * 201)), "feature 1: id is 'xxx"),
        (collection(feature(id="x\0")), r"feature 1: id is 'x\\x00'"),
        (collection(feature(id="\ud800")), r"feature 1: id is '\\ud800'"),
        (collection(feature(id=[1])), r"feature 1: id is \[1\]"),
        (collection(feature(), feature(depot=True), feature(depot=True)), "feature 3: this is the second depot"),
        (collection(feature(depot=True)), "there are no tasks"),
        (collection(), "there are no tasks"),
        (collection(feature(), crs={"type": "name", "properties": {"name": "EPSG:3857"}}), "crs is 'EPSG:3857'"),
        (collection(feature(), crs=None), "crs is null"),
        (collection(feature(), crs={"properties": []}), "crs is"),
        (collection(feature(), sb3_uav_plane={"meters_per_unit": 0}), "meters_per_unit of sb3_uav_plane is 0"),
        (collection(feature(), sb3_uav_plane=None), "meters_per_unit of sb3_uav_plane is null"),
        ({"type": "Point", "coordinates": [8, 47]}, "type is 'Point'; write a FeatureCollection"),
        ({"type": "FeatureCollection"}, "features is null"),
        ([feature()], "there is .* where an object of JSON is expected"),
    ],
)
def test_what_is_refused(content, message):
    with pytest.raises(ValueError, match=f"^map.geojson: {message}"):
        read(content)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "this is not JSON"),
        (b'{"type": "Feature", ', "this is not JSON"),
        (json.dumps(collection(feature(value=float("nan")))).encode(), "this is not JSON .NaN is no number of JSON"),
        (json.dumps(collection(feature(alt=float("-inf")))).encode(), "this is not JSON .-Infinity is no number of JSON"),
        (json.dumps(collection(feature(alt=5))).replace("5", "1e999").encode(), "feature 1: altitude is inf"),
        (json.dumps(collection(feature(alt=5))).replace("5", "5" * 5000).encode(), "this is not JSON .a number has thousands"),
        (b"[" + b"," * 3_000_000, "the file has more than 3000000 values"),
        (json.dumps(DOCUMENT).encode("utf-16"), "byte 0 is not UTF-8"),
        (json.dumps(DOCUMENT).encode() + b"\0", "this is not JSON"),
        (b'{"features": ' + b"[" * 200_000, "lists or objects are nested too deeply"),
        (b'{"a": ' * 200_000, "lists or objects are nested too deeply"),
    ],
)
def test_bytes_that_are_refused(data, message):
    with pytest.raises(ValueError, match=f"^map.geojson: {message}") as refused:
        read_geojson(data, "map.geojson")
    assert len(str(refused.value)) < 300


def test_a_byte_order_mark_does_no_harm():
    assert len(read_geojson(json.dumps(DOCUMENT).encode("utf-8-sig"), "map.geojson")) == 2


@settings(max_examples=200)
@given(st.binary(max_size=60) | json_values.map(lambda value: json.dumps(value).encode()) | mutated(DOCUMENT))
def test_strangers_bring_tasks_or_an_error(data):
    accepts_or_refuses(read_geojson, data)


@settings(max_examples=100)
@given(task_lists() | task_lists("plane"))
def test_tasks_survive_their_file(tmp_path_factory, tasks):
    path = tmp_path_factory.mktemp("tasks") / "tasks.geojson"
    write_tasks_geojson(tasks, path)
    same_tasks(read_back(read_geojson, path), tasks)


def same_tasks(found: TaskList, tasks: TaskList) -> None:
    assert (found.ids, found.system, found.meters_per_unit) == (tasks.ids, tasks.system, tasks.meters_per_unit)
    for name in ("points", "values", "service_s", "must", "altitudes", "depot"):
        assert np.array_equal(getattr(found, name), getattr(tasks, name), equal_nan=name == "altitudes")


def test_tasks_without_a_depot_survive_too(tmp_path):
    tasks = TaskList.of(["a"], [(47.0, 8.0)], "wgs84")
    write_tasks_geojson(tasks, tmp_path / "tasks.geojson")
    assert read_back(read_geojson, tmp_path / "tasks.geojson").depot is None


def written(plan, tmp_path):
    write_routes_geojson(plan, tmp_path / "routes.geojson")
    content = json.loads((tmp_path / "routes.geojson").read_text())
    kinds: dict = {}
    for one in content["features"]:
        kinds.setdefault(one["properties"]["kind"], []).append(one)
    return content, kinds


def test_routes(tmp_path):
    pytest.importorskip("pyproj")
    plan = plan_at_the_antimeridian()
    content, kinds = written(plan, tmp_path)
    assert set(content) == {"type", "features"}
    assert [one["geometry"]["coordinates"] for one in kinds["depot"]] == [[179.995, -17.0]]
    assert [one["properties"]["uav"] for one in kinds["route"]] == ["one", "two", "three"]
    first = kinds["route"][0]["properties"]
    assert first["length_m"] == pytest.approx(plan.routes[0].length_m, abs=1e-3)
    assert first["used_m"] == pytest.approx(plan.routes[0].length_m + 100, abs=1e-3)
    assert first["share_of_range"] == pytest.approx(plan.routes[0].used_m / 20_000, abs=1e-6)
    assert first["seconds"] == pytest.approx(plan.routes[0].used_m / 10, abs=1e-3)
    assert (first["stops"], first["tasks"]) == (2, ["a", "b & <b>"])
    stops = [(p["uav"], p["stop"], p["id"], p.get("alt")) for p in (one["properties"] for one in kinds["stop"])]
    assert stops == [("one", 1, "a", None), ("one", 2, "b & <b>", 30.0), ("two", 1, "c", None), ("three", 1, "d", None)]
    assert kinds["stop"][1]["geometry"]["coordinates"] == [-179.99, -17.01]
    (skipped,) = kinds["skipped"]
    assert (skipped["properties"]["id"], skipped["properties"]["reason"]) == ("far", "out of reach")
    assert skipped["properties"]["missing_m"] == pytest.approx(plan.skipped[0].missing_m, abs=1e-3)


def test_a_route_over_the_antimeridian_is_cut(tmp_path):
    pytest.importorskip("pyproj")
    _, kinds = written(plan_at_the_antimeridian(), tmp_path)
    assert [one["geometry"]["type"] for one in kinds["route"]] == ["MultiLineString", "LineString", "LineString"]
    parts = kinds["route"][0]["geometry"]["coordinates"]
    assert [part[0] for part in parts[1:]] == [[-180.0, pytest.approx(-17.005)], [180.0, pytest.approx(-17.01 + 2 / 300)]]
    assert all(abs(a[0] - b[0]) < 1 for part in parts for a, b in pairwise(part))


def test_planes_say_that_they_are_planes(tmp_path):
    content, kinds = written(plane_plan(), tmp_path)
    assert content["sb3_uav_plane"]["meters_per_unit"] == 2.0
    route = kinds["route"][0]
    assert route["geometry"]["coordinates"] == [[0, 0], [300, 0], [300, 400], [0, 0]]
    assert route["properties"]["length_m"] == 2 * (300 + 400 + 500)
    assert route["properties"]["seconds"] is None


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ([[1, 2], [3, 4]], [[[1, 2], [3, 4]]]),
        ([[179, 0], [-179, 10]], [[[179, 0], [180, 5]], [[-180, 5], [-179, 10]]]),
        ([[-170, 0], [170, 20]], [[[-170, 0], [-180, 10]], [[180, 10], [170, 20]]]),
        # A vertex on the antimeridian is not doubled.
        ([[179, 0], [180, 5], [-179, 10]], [[[179, 0], [180, 5]], [[-180, 5], [-179, 10]]]),
        ([[179, 0], [-180, 5], [-179, 10]], [[[179, 0], [180, 5]], [[-180, 5], [-179, 10]]]),
        ([[180, 0], [-179, 1]], [[[-180, 0], [-179, 1]]]),
        ([[179, 0], [-180, 1]], [[[179, 0], [180, 1]]]),
        ([[180, 3], [-180, 3]], [[[180, 3], [-180, 3]]]),
        # Half around the earth, the way that is written.
        ([[-90, 0], [90, 0]], [[[-90, 0], [90, 0]]]),
        ([[0, 1], [0, 1]], [[[0, 1], [0, 1]]]),
        ([[179, 0, 10], [-179, 0, 20]], [[[179, 0, 10], [180, 0, 15]], [[-180, 0, 15], [-179, 0, 20]]]),
    ],
)
def test_cutting(line, parts):
    assert split_at_antimeridian(line) == parts


@given(st.lists(st.tuples(st.floats(-180, 180), st.floats(-90, 90)), min_size=2, max_size=6))
def test_parts_never_cross_the_antimeridian(line):
    parts = split_at_antimeridian(line)
    vertices = [tuple(vertex) for part in parts for vertex in part]
    assert all(len(part) > 1 for part in parts)
    assert all(-180 <= longitude <= 180 and -90 <= latitude <= 90 for longitude, latitude in vertices)
    if len(parts) > 1:
        assert all(abs(a[0] - b[0]) <= 180 for part in parts for a, b in pairwise(part))
    assert all(vertex in vertices or abs(vertex[0]) == 180 for vertex in line)

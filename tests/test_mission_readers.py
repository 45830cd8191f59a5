"""Which reader a file gets, instance files as missions, checks that all formats share, and hostile bytes."""

import io
import math
import tracemalloc
from typing import Any

import numpy as np
import pytest
from benchmark_files import FILES, chao_text, oplib_text
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances
from sb3_uav.missions.checks import MAX_TASKS, check_tasks
from sb3_uav.missions.fleet import Fleet
from sb3_uav.missions.read import read_fleet, read_tasks, read_tasks_from_bytes
from sb3_uav.missions.readers import instance_files
from sb3_uav.missions.tasks import TaskList

CSV = b"id,lat,lon,value\na,47.1,8.1,2\nb,47.2,8.2,1\n"


def fleet_of(tasks: TaskList) -> Fleet:
    assert tasks.fleet is not None
    return tasks.fleet


def depot_of(tasks: TaskList) -> list[float]:
    assert tasks.depot is not None
    depot: list[float] = tasks.depot.tolist()
    return depot


def npz_bytes(instances):
    file = io.BytesIO()
    fields = {name: getattr(instances, name).numpy() for name in instances.present_fields()}
    np.savez_compressed(file, n_uavs=instances.n_uavs, **fields)
    return file.getvalue()


def whole_problem(**others):
    """An instance with every field."""
    fields = {
        "depot": [0, 0],
        "tasks": [[1, 2], [3, 4], [5, 6]],
        "values": [1, 2, 3],
        "max_distance": [10, 20],
        "n_uavs": 2,
        "start": [[1, 1], [0, 0]],
        "end": [[0, 0], [2, 2]],
        "service": [0, 0.5, 0],
        "must_serve": [False, True, False],
    }
    return Instances.from_arrays(**{**fields, **others})


@pytest.mark.parametrize("name", ["t.csv", "t.TSV", "dir/t.txt"])
def test_csv_by_its_suffix(name):
    assert read_tasks_from_bytes(name, CSV).ids == ("a", "b")


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("t", CSV, "t: files that end in 'nothing' are not read, but .csv .tsv .txt .geojson"),
        ("t.mission", b"{}", "t.mission: files that end in '.mission' are not read, .* save it as .plan"),
        ("t.xlsx", b"PK\x03\x04", "t.xlsx: files that end in '.xlsx' are not read, .* save the sheet as CSV"),
        ("t.kml", b"<kml/>", "t.kml: files that end in '.kml' are not read, .* convert it to GeoJSON or CSV"),
        ("t.pkl", b"\x80\x04", "t.pkl: files that end in '.pkl' are not read"),
        ("t.csv", b'{"type": "FeatureCollection"}', "t.csv: the name ends in .csv, but the content is GeoJSON; rename it"),
        ("t.csv", b"QGC WPL 110\n", "t.csv: the name ends in .csv, but the content is QGC WPL; rename it"),
        ("t.geojson", b'{"fileType" : "Plan"}', "but the content is a plan of QGroundControl; rename it"),
        ("t.csv", b"PK\x03\x04", "t.csv: the name ends in .csv, but the content is an .npz file; rename it"),
        ("t.csv", b"n 3\nm 2\n", "t.csv: the name ends in .csv, but the content is a team orienteering file; rename it"),
        ("t.npz", CSV, "t.npz: not an intact .npz of plain arrays"),
        ("t.npz", b"", "t.npz: not an intact .npz of plain arrays"),
        ("t\n\x1b[31m.csv", b"", r"t\?\?\[31m.csv: the file is empty"),
    ],
)
def test_names_and_contents_that_do_not_fit(name, data, message):
    with pytest.raises(ValueError, match=message):
        read_tasks_from_bytes(name, data)


def test_files_that_are_none(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv: there is no such file"):
        read_tasks(tmp_path / "none.csv")
    with pytest.raises(OSError, match="this is no regular file"):
        read_tasks(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"none\.csv: there is no such file"):
        read_fleet(tmp_path / "none.csv")


def test_a_depot_as_an_option(tmp_path):
    (tmp_path / "t.csv").write_bytes(CSV)
    assert read_tasks(tmp_path / "t.csv").depot is None
    allowed: tuple[Any, ...] = ("47,8", "47 8", (47, 8))
    for depot in allowed:
        assert depot_of(read_tasks(str(tmp_path / "t.csv"), depot=depot)) == [47, 8]
    refused: tuple[tuple[Any, str], ...] = (
        ("470,8", "depot: lat is 470"),
        ("147,8", "depot: lat is 147; latitudes are within 90 degrees, and lon is 8: are they swapped?"),
        ("47", "'47' is no position"),
        ((math.nan, 8), "depot: lat is nan; give a finite number"),
    )
    for depot, message in refused:
        with pytest.raises(ValueError, match=message):
            read_tasks(tmp_path / "t.csv", depot=depot)


def test_a_team_orienteering_file():
    tasks = read_tasks(FILES / "b1.2.a.txt")
    assert tasks.system == "plane" and tasks.meters_per_unit == 1
    assert tasks.ids == tuple("2345678")
    assert tasks.places[0] == "row 5"
    lines = (FILES / "b1.2.a.txt").read_text().splitlines()
    assert [*tasks.points[0], tasks.values[0]] == [float(word) for word in lines[4].split()]
    assert len(fleet_of(tasks)) == 2
    assert {uav.range_m for uav in fleet_of(tasks)} == {float(lines[2].split()[1])}


def test_vehicles_that_end_elsewhere():
    instance = Instances.from_arrays([0, 0], [[1, 2], [3, 4]], [1, 2], 10, 2, end=[[5, 5], [5, 5]])
    tasks = read_tasks_from_bytes("t.txt", chao_text(instance).encode(), unit="km")
    assert [(uav.range_m, uav.start, uav.end) for uav in fleet_of(tasks)] == [(10_000, None, (5, 5))] * 2
    assert tasks.points.tolist() == [[1, 2], [3, 4]]
    assert tasks.meters_per_unit == 1000
    with pytest.raises(ValueError, match=r"t\.txt, line 4: the score is -1"):
        read_tasks_from_bytes("t.txt", chao_text(instance, "{x}\t{y}\t-1").encode())


def test_oplib():
    pytest.importorskip("vrplib")
    instance = Instances.from_arrays([0, 0], [[1, 2], [3, 4]], [1, 2], 10, 1)
    for name in ("t.oplib", "t.txt"):
        tasks = read_tasks_from_bytes(name, oplib_text(instance, depot=2).encode())
        assert tasks.ids == ("1", "3")
        assert tasks.points.tolist() == [[1, 2], [3, 4]]
        assert [uav.range_m for uav in fleet_of(tasks)] == [10]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        # As tests with random bytes found it: a section after the end is none.
        ("NODE_SCORE_SECTION", "EOF\nNODE_SCORE_SECTION", "DIMENSION is 3, but NODE_SCORE_SECTION has 0 lines"),
        ("EOF", "Edge_Weight_SECTION\n1\nEOF", "the file lists distances, or has too many sections"),
        ("EOF", "A_SECTION\n" * 20 + "EOF", "the file lists distances, or has too many sections"),
        ("EUC_2D", "GEO", "EDGE_WEIGHT_TYPE is GEO; only EUC_2D can be solved"),
    ],
)
def test_other_oplib_files(old, new, message):
    pytest.importorskip("vrplib")
    text = oplib_text(Instances.from_arrays([0, 0], [[1, 2], [3, 4]], [1, 2], 10, 1))
    with pytest.raises(ValueError, match=message):
        read_tasks_from_bytes("t.oplib", text.replace(old, new).encode())


def test_an_npz_with_everything():
    tasks = read_tasks_from_bytes("t.npz", npz_bytes(whole_problem()), unit="km")
    assert tasks.ids == ("0", "1", "2")
    assert tasks.values.tolist() == [1, 2, 3]
    assert tasks.must.tolist() == [False, True, False]
    # Half a kilometer of flight takes 500 s at 1 m/s.
    assert tasks.service_s.tolist() == [0, 500, 0]
    assert [(uav.range_m, uav.speed_mps, uav.start, uav.end) for uav in fleet_of(tasks)] == [
        (10_000, 1, (1, 1), (0, 0)),
        (20_000, 1, (0, 0), (2, 2)),
    ]


def test_an_npz_is_the_same_problem_as_before():
    from sb3_uav.missions.problem import make_instance

    before = whole_problem()
    tasks = read_tasks_from_bytes("t.npz", npz_bytes(before))
    assert make_instance(tasks, fleet_of(tasks)).digest() == before.digest()


def test_one_of_several_instances():
    padded = Instances.from_arrays([[0, 0]], [[[5, 6], [0, 0]]], [[7, 0]], 3, 1, task_mask=[[True, False]])
    both = Instances.concatenate([Instances.from_arrays([0, 0], [[1, 2], [3, 4]], [1, 2], 10, 1), padded])
    data = npz_bytes(both)
    with pytest.raises(ValueError, match="there are 2 instances; say which one with row, from 0 to 1"):
        read_tasks_from_bytes("t.npz", data)
    with pytest.raises(ValueError, match="row is 2, but the file has rows 0 to 1"):
        read_tasks_from_bytes("t.npz", data, row=2)
    with pytest.raises(ValueError, match=r"row 0 is asked for, but only \.npz files have rows"):
        read_tasks_from_bytes("t.csv", CSV, row=0)
    tasks = read_tasks_from_bytes("t.npz", data, row=1)
    assert tasks.points.tolist() == [[5, 6]] and fleet_of(tasks).uavs[0].range_m == 3


def test_large_fleets_take_no_memory():
    data = npz_bytes(Instances.from_arrays([0, 0], [[1, 2]], [1], 10, 2**31 - 1))
    tracemalloc.start()
    with pytest.raises(ValueError, match="there are 2147483647 UAVs; give at least 1, and 10000 at most"):
        read_tasks_from_bytes("t.npz", data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


def test_small_files_with_large_arrays_are_not_unpacked(monkeypatch):
    monkeypatch.setattr(instance_files, "_MOST_NPZ_BYTES", 2**20)
    monkeypatch.setattr(instance_files, "read_npz_stream", None)
    file = io.BytesIO()
    np.savez_compressed(file, tasks=np.zeros(2**20))
    assert len(file.getvalue()) < 2**16
    with pytest.raises(ValueError, match="the file holds 1 arrays of 8 MiB; at most 100 arrays of 1 MiB are read"):
        read_tasks_from_bytes("t.npz", file.getvalue())
    file = io.BytesIO()
    arrays: dict[str, Any] = {f"a{number}": np.zeros(1) for number in range(101)}
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match="the file holds 101 arrays of 0 MiB; at most 100 arrays"):
        read_tasks_from_bytes("t.npz", file.getvalue())


def test_long_instance_files_are_not_parsed(monkeypatch):
    monkeypatch.setattr(instance_files, "_MOST_TEXT_BYTES", 100)
    for name in ("b1.2.a.txt", "road8.oplib"):
        with pytest.raises(ValueError, match=f"{name}: the file has .* bytes; at most 100 of an instance are read"):
            read_tasks(FILES / name)


def tasks_of(**others):
    fields = {"ids": "ab", "points": [[47.0, 8.0], [47.5, 8.5]], "system": "wgs84", "source": "t"}
    return TaskList.of(**{**fields, **others})


def test_good_tasks_pass():
    check_tasks(tasks_of())
    # Across the antimeridian, at the poles, and a depot where a task is.
    check_tasks(tasks_of(points=[[-16.5, 179.99], [-16.5, -179.99]], depot=(-16.5, 179.99)))
    check_tasks(tasks_of(points=[[90, 8], [-90, 8]]))
    check_tasks(tasks_of(points=[[0, 8], [47, 0]]))
    check_tasks(tasks_of(points=[[0, 0], [1e6, -1e6]], system="plane"))
    check_tasks(tasks_of(ids=("a 1", "Ä-½ 東"), values=[0, 1e12], altitudes=np.array([np.nan, -5])))


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"ids": (), "points": []}, "t: there is no task"),
        ({"ids": ("a", "")}, "t: task 2: id is ''; give a name"),
        ({"ids": ("a", " b")}, "t: task 2: id is ' b'; give a name that neither begins nor ends with a space"),
        ({"ids": ("a", "b\ud800c")}, r"t: task 2: id is 'b\\ud800c', with a control character"),
        ({"ids": ("a", "a")}, "t: task 2: id 'a' is that of task 1 too"),
        ({"points": [[47, 8], [math.nan, 8]]}, "t: task 2: lat is nan; give a finite number"),
        ({"points": [[47, 8], [47, -math.inf]]}, "t: task 2: lon is -inf; give a finite number"),
        ({"points": [[0, 0], [0, 0]]}, "t: task 1: lat and lon are both 0"),
        ({"depot": (0, 0)}, "t: depot: lat and lon are both 0"),
        ({"points": [[47, 8], [47, 8]]}, "t: task 2: task b is where task a"),
        ({"values": [1, -1]}, "t: task 2: value is -1; give a number from 0"),
        ({"values": [1, math.nan]}, "t: task 2: value is nan; give a number from 0"),
        ({"values": [1, 1e300]}, "t: task 2: value is 1e.300; give a number from 0"),
        ({"service_s": [1, math.inf]}, "t: task 2: service_s is inf; give a number from 0"),
        ({"altitudes": np.array([1, math.inf])}, "t: task 2: alt_m is inf; give a number from -1000"),
        ({"system": "plane", "meters_per_unit": 0.0}, "t: a unit of 0 m is none"),
        (
            {"system": "plane", "meters_per_unit": 1e6, "points": [[0, 0], [0, 1e5]]},
            "t: task 2: y is 100000; .* within 1000 of",
        ),
        (
            {"ids": range(MAX_TASKS + 1), "points": np.zeros((MAX_TASKS + 1, 2))},
            "t: there are 100001 tasks, but at most 100000 are read",
        ),
    ],
)
def test_other_tasks_are_refused(others, message):
    with pytest.raises(ValueError, match=message):
        check_tasks(tasks_of(**others))


GEOJSON = b"""{"type": "FeatureCollection", "features": [
 {"type": "Feature", "geometry": {"type": "Point", "coordinates": [8.1, 47.1]}, "properties": {"id": "a", "value": 2}},
 {"type": "Feature", "geometry": {"type": "Point", "coordinates": [8.0, 47.0]}, "properties": {"depot": true}}]}"""
PLAN = b"""{"fileType": "Plan", "version": 1, "mission": {"version": 2, "plannedHomePosition": [47.0, 8.0, 400], "items": [
 {"type": "SimpleItem", "command": 16, "frame": 3, "params": [5, 0, 0, null, 47.1, 8.1, 50], "doJumpId": 1}]}}"""
WPL = b"QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t47\t8\t400\t1\n1\t0\t3\t16\t5\t0\t0\t0\t47.1\t8.1\t50\t1\n"


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("t.geojson", GEOJSON),
        ("t.json", b"\xef\xbb\xbf" + GEOJSON),
        ("t.plan", PLAN),
        ("t.json", PLAN),
        ("t.waypoints", WPL),
        ("t.WPL", WPL),
        ("t.txt", WPL),
    ],
)
def test_maps_and_ground_stations(name, data):
    tasks = read_tasks_from_bytes(name, data)
    assert tasks.points.tolist() == [[47.1, 8.1]]
    assert depot_of(tasks) == [47, 8]
    with pytest.raises(ValueError, match="the unit 'km' is for x and y, but the file has lat and lon"):
        read_tasks_from_bytes(name, data, unit="km")
    if data is GEOJSON:
        with pytest.raises(ValueError, match="one of the points is the depot already"):
            read_tasks_from_bytes(name, data, depot="46,7")
    elif data in (PLAN, WPL):
        assert depot_of(read_tasks_from_bytes(name, data, depot="46,7")) == [46, 7]


def test_what_all_formats_share_is_checked_in_each():
    for name, data in (("t.geojson", GEOJSON), ("t.plan", PLAN), ("t.wpl", WPL)):
        with pytest.raises(
            ValueError, match=r"lat is 147\.1; latitudes are within 90 degrees, and lon is 8\.1: are they swapped?"
        ):
            read_tasks_from_bytes(name, data.replace(b"47.1", b"147.1"))


def test_the_unit_of_a_plane_in_geojson():
    data = GEOJSON.replace(b"{", b'{"sb3_uav_plane": {"meters_per_unit": 1000}, ', 1)
    assert read_tasks_from_bytes("t.geojson", data, unit="km").meters_per_unit == 1000
    with pytest.raises(ValueError, match="the unit 'm' contradicts the file, whose unit is 1000 m; leave it out"):
        read_tasks_from_bytes("t.geojson", data, unit="m")


SEEDS = {
    "t.csv": CSV,
    "t.geojson": GEOJSON,
    "t.plan": PLAN,
    "t.waypoints": WPL,
    "t.tsv": CSV.replace(b",", b"\t").replace(b".", b","),
    "t.txt": (FILES / "b1.2.a.txt").read_bytes(),
    "t.oplib": (FILES / "road8.oplib").read_bytes(),
    "t.npz": npz_bytes(whole_problem()),
}


@st.composite
def uploads(draw):
    """Names with any bytes, or with a valid file of which some pieces are replaced."""
    name = draw(st.sampled_from([*SEEDS, *SEEDS, "t.txt", "t", "t.xlsx"]))
    junk = st.binary(max_size=40) | st.sampled_from(
        [b"\n", b",", b'"', b"\0", b"nan", b"1e999", b"-", b"\xff\xfe", b";", b"9" * 400]
    )
    if name not in SEEDS or draw(st.booleans()):
        return name, draw(junk)
    data = SEEDS[name]
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(data)))
        data = data[:start] + draw(junk) + data[start + draw(st.integers(0, 20)) :]
    return draw(st.sampled_from([name, "t.txt"])), data


@settings(max_examples=400)
@given(uploads(), st.sampled_from([None, "km", "parsec"]), st.sampled_from([None, "47,8", "x"]), st.booleans())
def test_any_upload_is_read_or_refused(upload, unit, depot, allow_duplicates):
    name, data = upload
    if b"_SECTION" in data:
        pytest.importorskip("vrplib")
    try:
        tasks = read_tasks_from_bytes(name, data, unit=unit, depot=depot, allow_duplicates=allow_duplicates)
    except ValueError as error:
        assert 0 < len(str(error)) < 1_000
    else:
        check_tasks(tasks, allow_duplicates)

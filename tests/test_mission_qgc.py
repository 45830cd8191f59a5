"""Files of ground stations: tasks in ``.plan`` and ``QGC WPL 110``, missions out."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mission_format_helpers import (
    DEPOT,
    accepts_or_refuses,
    json_values,
    mutated,
    plan_at_the_antimeridian,
    plane_plan,
    read_back,
    task_lists,
)

from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.readers.qgc_plan import read_qgc_plan
from sb3_uav.missions.readers.wpl import read_wpl
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.qgc_plan import write_plan_files, write_tasks_plan
from sb3_uav.missions.writers.wpl import write_tasks_wpl, write_wpl_files

UP = FlightOptions(altitude_m=50, altitude_step_m=10)


def item(command=16, *params, frame=3, **keys):
    """The last parameters given are latitude, longitude and altitude."""
    filled = [*params[:-3], *[0] * (7 - len(params)), *params[-3:]] if params else [0] * 7
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": filled, "autoContinue": True, **keys}


def plan(*items, **keys):
    home = {"plannedHomePosition": [47.0, 8.0, 480.0], "version": 2, "items": list(items)}
    return {"fileType": "Plan", "version": 1, "mission": home, **keys}


DOCUMENT = plan(
    item(22, 15, 0, 0, None, 47.0, 8.0, 50, doJumpId=1),
    item(178, 1, 5, -1, 0, 0, 0, 0, frame=2, doJumpId=2),
    item(16, 12.5, 0, 0, None, 47.1, 8.1, 60, doJumpId=3),
    item(93, 4, -1, -1, -1, 0, 0, 0, frame=2, doJumpId=4),
    item(206, 25, 0, 1, 0, 0, 0, 0, frame=2, doJumpId=5),
    item(82, 1, 0, 0, 0, 47.2, 8.2, 400, frame=0, doJumpId=6),
    item(19, 30, 0, 0, 0, 47.3, 8.3, 0, doJumpId=7),
    item(31, 1, 0, 0, 0, 47.4, 8.4, 70, frame=6, doJumpId=8),
    item(16, 0, 0, 0, 0, 0, 0, 50, doJumpId=9),
    item(20, doJumpId=10),
    geoFence={"circles": [], "polygons": [], "version": 2},
    rallyPoints={"points": [], "version": 2},
)


def as_wpl(document):
    """The same items as text."""
    rows = ["QGC WPL 110", "0\t1\t0\t16\t0\t0\t0\t0\t47.0\t8.0\t480\t1"]
    for index, one in enumerate(document["mission"]["items"], 1):
        params = ["nan" if value is None else repr(value) for value in one["params"]]
        rows.append("\t".join([str(index), "0", str(one["frame"]), str(one["command"]), *params, "1"]))
    return "\n".join(rows) + "\n"


def read(document):
    return read_qgc_plan(json.dumps(document).encode(), "a.plan")


def read_text(text):
    return read_wpl(text.encode(), "a.waypoints")


@pytest.mark.parametrize("tasks", [read(DOCUMENT), read_text(as_wpl(DOCUMENT))], ids=["plan", "wpl"])
def test_items_that_are_tasks(tasks):
    assert tasks.ids == ("wp-3", "wp-6", "wp-7", "wp-8")
    assert tasks.points.tolist() == [[47.1, 8.1], [47.2, 8.2], [47.3, 8.3], [47.4, 8.4]]
    assert tasks.depot.tolist() == [47.0, 8.0]
    assert tasks.service_s.tolist() == [16.5, 1, 30, 0]
    assert tasks.altitudes.tolist() == pytest.approx([60, np.nan, np.nan, 70], nan_ok=True)
    assert tasks.values.tolist() == [1] * 4
    (note,) = tasks.notes
    for part in ("MAV_CMD 178 (1)", "MAV_CMD 206 (1)", "without a position (1)", "not relative to home (1)"):
        assert part in note


def test_places_name_items_and_lines():
    assert read(DOCUMENT).places[:2] == ("item 3", "item 6")
    assert read_text(as_wpl(DOCUMENT)).places[:2] == ("line 5", "line 8")


@pytest.mark.parametrize("numbers", [(None, None), (4, 4), (None, 9)])
def test_places_are_names_where_numbers_are_none_or_twice(numbers):
    items = [item(16, 47 + n, 8, 50, **({} if number is None else {"doJumpId": number})) for n, number in enumerate(numbers)]
    assert read(plan(item(22), *items)).ids == ("wp-2", "wp-3")


def test_what_comes_after_the_start_of_the_landing_is_no_task():
    tasks = read(plan(item(16, 47, 8, 50), item(189, 47, 8, 0), item(16, 48, 8, 50), item(93, 5, 0, 0, 0, 0, 0, 0), item(21)))
    assert tasks.ids == ("wp-1",)
    assert tasks.service_s.tolist() == [0]
    assert "a waypoint of the landing (1)" in tasks.notes[0]
    landing = {"type": "ComplexItem", "complexItemType": "fwLandingPattern"}
    assert "landing pattern" in read(plan(item(16, 47, 8, 50), landing)).notes[0]


@pytest.mark.parametrize("home", [None, [None, None, None], [0, 0, 0], [0.0, 0.0]])
def test_home_may_be_missing(home):
    document = copy.deepcopy(DOCUMENT)
    document["mission"]["plannedHomePosition"] = home
    assert read(document).depot is None
    del document["mission"]["plannedHomePosition"]
    assert read(document).depot is None
    assert read_text(as_wpl(DOCUMENT).replace("\t47.0\t8.0\t480", "\t0\t0\t480")).depot is None


OK = item(16, 47, 8, 50)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (plan(OK, {"type": "ComplexItem", "complexItemType": "survey"}), "item 2 is a survey, of which no tasks can be made"),
        (plan(OK, {"type": "ComplexItem", "complexItemType": "StructureScan"}), "item 2 is a structure scan"),
        (plan(OK, {"type": "ComplexItem", "complexItemType": "CorridorScan"}), "item 2 is a corridor scan"),
        (plan(OK, {"type": "ComplexItem", "complexItemType": ["x"]}), r"item 2 is a complex item \(\['x'\]\)"),
        (plan(OK, geoFence={"circles": [{}], "polygons": [{}, {}]}), "geoFence has 1 in circles, 2 in polygons, but"),
        (plan(OK, geoFence={"polygon": [[1, 2]], "version": 1}), "geoFence has 1 in polygon, but plans do not keep clear"),
        (plan(OK, geoFence=[1]), r"geoFence is \[1\]"),
        (plan(OK, rallyPoints={"points": [[1, 2, 3]]}), "rallyPoints has 1; delete them"),
        (plan(OK, item(177, 1, 3, 0, 0, 0, 0, 0)), r"item 2 jumps to another item \(MAV_CMD_DO_JUMP\); delete it"),
        (plan(OK, item(17, 47, 8, 50)), "item 2 loiters for ever"),
        (plan(OK, item(18, 3, 0, 0, 0, 47, 8, 50)), "item 2 loiters for a number of turns"),
        (plan(OK, item(94, 47, 8, 50)), "item 2 places a payload"),
        (plan(OK, item(36, 47, 8, 50)), "item 2 has the command 36, which flies in a way that is not known"),
        (plan(OK, item(5001, 47, 8, 50)), "item 2 is a part of a geofence"),
        (plan(OK, item(5100, 47, 8, 50)), "item 2 is a rally point"),
        (plan(OK, item(93, -1, 12, 0, 0, 0, 0, 0)), "item 2 waits until a time of day"),
        (plan(item(16, 47, 8, 50, frame=1)), "item 1 has the frame 1, whose positions are not latitudes"),
        (plan(item(16, -3, 0, 0, 0, 47, 8, 50)), "item 1: the hold is -3 s; write 0 or more"),
        (plan(item(16, 47, None, 50)), "item 1: one of latitude and longitude is missing"),
        (plan(item(16, 47, True, 50)), "item 1: param 6 is true; write a finite number"),
        (plan(item(16, "47", 8, 50)), "item 1: param 5 is '47'"),
        (plan(item(16.5, 47, 8, 50)), "item 1: command is 16.5; write a whole number"),
        (plan(item(True, 47, 8, 50)), "item 1: command is true"),
        (plan(item(16, 47, 8, 50, doJumpId="1")), "item 1: doJumpId is '1'"),
        (plan({**OK, "params": [1, 2]}), r"item 1: params is \[1, 2\]; write a list of 7"),
        (plan({**OK, "params": None}), "item 1: params is null"),
        (plan({**OK, "frame": None}), "item 1: frame is null"),
        (plan({**OK, "type": "Item"}), "item 1: type is 'Item'"),
        (plan(OK, 7), "item 2 is 7; write an object"),
        (plan(), "no item is a task"),
        (plan(item(22), item(20)), "no item is a task"),
        (plan(OK, version=3), "version is 3; save the plan with"),
        (plan(OK, version=True), "version is true"),
        (plan(OK, version=[]), r"version is \[\]"),
        (plan(OK, fileType="Params"), "fileType is 'Params'"),
        (plan(OK, mission=[]), r"mission is \[\]"),
        (plan(OK, mission={"version": 2}), "items of mission is null"),
        (plan(OK, mission={"items": []}), "version of mission is null"),
        (plan(OK, mission={"version": 2, "items": [OK], "plannedHomePosition": {}}), "plannedHomePosition is {}"),
        (plan(OK, mission={"version": 2, "items": [OK], "plannedHomePosition": ["a", 1]}), "latitude of home is 'a'"),
    ],
)
def test_plans_that_are_refused(document, message):
    with pytest.raises(ValueError, match=f"^a.plan: {message}"):
        read(document)


def test_nan_in_a_plan_is_refused():
    with pytest.raises(ValueError, match=r"^a.plan: this is not JSON .NaN is no number of JSON"):
        read(plan(item(16, 47, float("nan"), 50)))


HOME = "0\t1\t0\t16\t0\t0\t0\t0\t47\t8\t480\t1\n"
ROW = "1\t0\t3\t16\t0\t0\t0\t0\t47.1\t8.1\t50\t1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1 is ''; files of waypoints begin with 'QGC WPL 110'"),
        ("QGC WPL 120\n" + HOME + ROW, "line 1 is 'QGC WPL 120'"),
        ("QGC WPL 110\n", "there are no waypoints"),
        ("QGC WPL 110\n" + HOME, "no item is a task"),
        ("QGC WPL 110\n" + ROW, "line 2: the index is 1; the first row is home"),
        ("QGC WPL 110\n" + HOME + ROW[:-3] + "\n", "line 3 is .*; write 12 numbers, separated by tabs"),
        ("QGC WPL 110\n" + HOME + "\n" + ROW.replace("\t1\n", "\t1\t1\n"), "line 4 is .*; write 12 numbers"),
        ("QGC WPL 110\n" + HOME + ROW.replace("47.1", "nan"), "line 3: latitude is 'nan'; write a finite number"),
        ("QGC WPL 110\n" + HOME + ROW.replace("8.1", "1e999"), "line 3: longitude is '1e999'"),
        ("QGC WPL 110\n" + HOME + ROW.replace("47.1", "47,1"), "line 3: latitude is '47,1'; .* with a point"),
        ("QGC WPL 110\n" + HOME + ROW.replace("47.1", "4_7"), "line 3: latitude is '4_7'"),
        ("QGC WPL 110\n" + HOME + ROW.replace("50", "\u0665"), "line 3: altitude is "),
        ("QGC WPL 110\n" + HOME + ROW.replace("\t16\t", "\t16.5\t"), "line 3: command is 16.5; write a whole number"),
        ("QGC WPL 110\n" + HOME + ROW.replace("\t3\t", "\t-3\t"), "line 3: frame is -3"),
        ("QGC WPL 110\n" + HOME + ROW.replace("\t16\t0", "\t177\t0"), "line 3 jumps to another item"),
        ("QGC WPL 110\n" + HOME + ROW.replace("\t16\t0", "\t16\t-1"), "line 3: the hold is -1 s"),
        ("QGC WPL 110" + "\n" * 1_000_001, "the file has more than 1000000 lines"),
        ("QGC WPL 110\n" + HOME + "1" * 10**6, "line 3 is '11"),
        ("QGC WPL 110\n" + HOME + ROW + "\0", r"line 4 is '\\x00'"),
    ],
)
def test_texts_that_are_refused(text, message):
    with pytest.raises(ValueError, match=f"^a.waypoints: {message}") as refused:
        read_text(text)
    assert len(str(refused.value)) < 300


def test_texts_that_are_not_utf8():
    with pytest.raises(ValueError, match=r"^a.waypoints: byte 0 is not UTF-8"):
        read_wpl(as_wpl(DOCUMENT).encode("utf-16"), "a.waypoints")


def test_spaces_comments_and_line_ends_do_not_matter():
    text = "QGC WPL 110\r\n\r\n# a comment\r\n" + (HOME + ROW).replace("\t", "  ").replace("\n", "\r\n")
    tasks = read_wpl(text.encode("utf-8-sig"), "a.waypoints")
    assert (tasks.ids, tasks.places) == (("wp-1",), ("line 5",))


@settings(max_examples=200)
@given(st.binary(max_size=60) | json_values.map(lambda value: json.dumps(value).encode()) | mutated(DOCUMENT))
def test_strangers_bring_plans_or_an_error(data):
    accepts_or_refuses(read_qgc_plan, data)


@settings(max_examples=150)
@given(
    st.binary(max_size=60).map(lambda data: b"QGC WPL 110\n" + HOME.encode() + data)
    | st.tuples(st.integers(0, 300), st.text(max_size=4)).map(
        lambda cut: (as_wpl(DOCUMENT)[: cut[0]] + cut[1] + as_wpl(DOCUMENT)[cut[0] + len(cut[1]) :]).encode()
    )
)
def test_strangers_bring_texts_or_an_error(data):
    accepts_or_refuses(read_wpl, data)


@settings(max_examples=100)
@given(task_lists(), st.sampled_from(["px4", "ardupilot"]))
def test_tasks_survive_their_files(tmp_path_factory, tasks, firmware):
    folder = tmp_path_factory.mktemp("tasks")
    write_tasks_plan(tasks, folder / "a.plan", FlightOptions(firmware=firmware))
    write_tasks_wpl(tasks, folder / "a.waypoints", FlightOptions(firmware=firmware))
    for found in (read_back(read_qgc_plan, folder / "a.plan"), read_back(read_wpl, folder / "a.waypoints")):
        assert found.ids == tuple(f"wp-{number}" for number in range(1, len(tasks) + 1))
        for name in ("points", "service_s", "altitudes", "depot"):
            assert np.array_equal(getattr(found, name), getattr(tasks, name), equal_nan=name == "altitudes")


@pytest.mark.parametrize("write", [write_tasks_plan, write_tasks_wpl])
def test_tasks_that_no_waypoints_can_say(tmp_path, write):
    tasks = TaskList.of(["a"], [(47.0, 8.0)], "wgs84", depot=(47.0, 8.0), source="t.csv")
    for wrong, message in [
        (replace(tasks, depot=None), "t.csv: there is no depot"),
        (replace(tasks, points=np.zeros((1, 2))), r"t.csv: a is at \(0, 0\)"),
        (tasks.with_depot((0, 0)), r"t.csv: the depot is at \(0, 0\)"),
        (replace(tasks, system="plane"), "t.csv: the tasks are in a plane"),
    ]:
        with pytest.raises(ValueError, match=message):
            write(wrong, tmp_path / "a.plan")
    assert not list(tmp_path.iterdir())


def check_schema(content):
    """The keys and types that the documentation of the format requires."""
    assert set(content) == {"fileType", "geoFence", "groundStation", "mission", "rallyPoints", "version"}
    assert (content["fileType"], content["version"]) == ("Plan", 1)
    assert content["geoFence"] == {"circles": [], "polygons": [], "version": 2}
    assert content["rallyPoints"] == {"points": [], "version": 2}
    mission = content["mission"]
    assert mission["version"] == 2
    assert mission["globalPlanAltitudeMode"] == 1
    assert mission["cruiseSpeed"] > 0
    assert mission["hoverSpeed"] > 0
    assert [type(number) for number in mission["plannedHomePosition"]] == [float, float, int]
    assert mission["items"]
    for number, one in enumerate(mission["items"], 1):
        assert (one["type"], one["autoContinue"], one["doJumpId"]) == ("SimpleItem", True, number)
        assert len(one["params"]) == 7
        assert all(value is None or isinstance(value, int | float) for value in one["params"])
        if one["frame"] == 3:
            assert one["params"][4:] != [0, 0, 0]
            assert (one["Altitude"], one["AltitudeMode"]) == (one["params"][6], 1)
        else:
            assert (one["frame"], one["params"][4:]) == (2, [0, 0, 0])


def missions(found, tmp_path, flight=UP):
    paths = write_plan_files(found, tmp_path / "missions", flight)
    contents = [json.loads(path.read_text()) for path in paths]
    for content in contents:
        check_schema(content)
    return paths, contents, [[(one["command"], *one["params"]) for one in c["mission"]["items"]] for c in contents]


def test_missions_of_a_plan(tmp_path):
    pytest.importorskip("pyproj")
    paths, contents, (one, two, three) = missions(plan_at_the_antimeridian(), tmp_path)
    assert [path.name for path in paths] == ["one.plan", "two.plan", "three.plan"]
    assert one == [
        (22, 0, 0, 0, None, *DEPOT, 50),
        (178, 1, 10, -1, 0, 0, 0, 0),
        (16, 0, 0, 0, None, -17.0, 179.99, 50),
        (16, 10, 0, 0, None, -17.01, -179.99, 30),
        (20, 0, 0, 0, 0, 0, 0, 0),
    ]
    assert [row[-1] for row in two] == [60, 0, 60, 0]
    # It starts and ends away from the depot, at two places: it may be in the air, and "launch" may be anywhere.
    assert three[0] == (22, 0, 0, 0, None, -17.0, 179.9, 70)
    assert three[-1] == (21, 0, 0, 0, None, -17.01, 179.9, 0)
    assert [c["mission"]["plannedHomePosition"] for c in contents] == [[*DEPOT, 0]] * 3
    assert [(c["mission"]["firmwareType"], c["mission"]["vehicleType"]) for c in contents] == [(12, 2)] * 3
    assert [(c["mission"]["cruiseSpeed"], c["mission"]["hoverSpeed"]) for c in contents] == [(15, 10), (15, 10), (15, 8)]


def test_missions_of_fixed_wings_that_land(tmp_path):
    pytest.importorskip("pyproj")
    flight = FlightOptions(firmware="ardupilot", vehicle="fixed-wing", landing="land")
    _, contents, (one, *_) = missions(plan_at_the_antimeridian(), tmp_path, flight)
    assert one == [
        (22, 15, 0, 0, None, *DEPOT, 50),
        (178, 0, 10, -1, 0, 0, 0, 0),
        (16, 0, 0, 0, None, -17.0, 179.99, 50),
        (19, 10, 0, 0, 0, -17.01, -179.99, 30),
        (21, 0, 0, 0, None, *DEPOT, 0),
    ]
    assert (contents[0]["mission"]["firmwareType"], contents[0]["mission"]["vehicleType"]) == (3, 1)
    assert (contents[0]["mission"]["cruiseSpeed"], contents[0]["mission"]["hoverSpeed"]) == (10, 5)


def test_a_base_of_its_own_is_home_and_the_way_back_is_flown(tmp_path):
    pytest.importorskip("pyproj")
    tasks = TaskList.of(["a"], [(47.01, 8.0)], "wgs84", depot=(47.0, 8.0))
    base, away = (47.005, 8.0), (47.004, 8.0)
    fleet = Fleet(
        (Uav("own base", 5_000, start=base, end=base), Uav("on its way", 5_000, start=away), Uav("far", 10, start=away))
    )
    _, contents, (own, back) = missions(make_plan(tasks, fleet, Schedule([[0], [], []]), "by hand"), tmp_path)
    assert contents[0]["mission"]["plannedHomePosition"] == [*base, 0]
    assert [row[0] for row in own] == [22, 16, 20]
    # No stops are left, but it has to come home.
    assert [row[0] for row in back] == [22, 21]
    assert back[-1][5:] == (47.0, 8.0, 0)


def test_pymavlink_reads_the_waypoints(tmp_path):
    pytest.importorskip("pyproj")
    mavwp = pytest.importorskip("pymavlink.mavwp")
    for firmware in ("px4", "ardupilot"):
        found, flight = plan_at_the_antimeridian(), replace(UP, firmware=firmware)
        _, _, expected = missions(found, tmp_path, flight)
        paths = write_wpl_files(found, tmp_path / firmware, flight)
        assert [path.name for path in paths] == ["one.waypoints", "two.waypoints", "three.waypoints"]
        for path, rows in zip(paths, expected, strict=True):
            loader = mavwp.MAVWPLoader()
            assert loader.load(str(path)) == len(rows) + 1
            home = loader.wp(0)
            assert (home.command, home.frame, home.current, home.x, home.y, home.z) == (16, 0, 1, *DEPOT, 0)
            read_rows = [[w.command, w.param1, w.param2, w.param3, w.param4, w.x, w.y, w.z] for w in loader.wpoints[1:]]
            default = np.nan if firmware == "px4" else 0.0
            rows = [[default if value is None else value for value in row] for row in rows]
            assert read_rows == [pytest.approx(row, nan_ok=True) for row in rows]
            assert [w.seq for w in loader.wpoints] == list(range(len(rows) + 1))
            assert [w.frame for w in loader.wpoints[1:]] == [2 if row[0] in (20, 178) else 3 for row in rows]


def test_our_missions_are_read_as_tasks_again(tmp_path):
    pytest.importorskip("pyproj")
    found = plan_at_the_antimeridian()
    paths = [*write_plan_files(found, tmp_path, UP)[:1], *write_wpl_files(found, tmp_path, UP)[:1]]
    for tasks in (read_back(read_qgc_plan, paths[0]), read_back(read_wpl, paths[1])):
        assert tasks.points.tolist() == [[-17.0, 179.99], [-17.01, -179.99]]
        assert (tasks.service_s.tolist(), tasks.altitudes.tolist()) == ([0, 10], [50, 30])


@pytest.mark.parametrize("write", [write_plan_files, write_wpl_files])
def test_planes_have_no_missions(tmp_path, write):
    with pytest.raises(ValueError, match="the tasks are in a plane of x and y, but missions of autopilots need latitudes"):
        write(plane_plan(), tmp_path, UP)
    assert not list(tmp_path.iterdir())

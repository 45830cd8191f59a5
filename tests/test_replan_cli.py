"""``sb3-uav replan``: what it writes and prints, and what it never touches."""

import json
from pathlib import Path

import pytest

from sb3_uav.cli.main import main
from sb3_uav.common.files import file_hash
from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan_file import load_plan, save_plan
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList

for package in ("numba", "pyproj", "rich", "matplotlib", "plotly"):
    pytest.importorskip(package)

HEAD = "what,id,lat,lon,remaining_m,value,service_s,must\n"


@pytest.fixture
def mission(tmp_path, monkeypatch) -> Path:
    """A folder ``mission`` in the current one, with the plan only."""
    monkeypatch.chdir(tmp_path)
    points = [(47.0 + 0.01 * number, 8.0) for number in (1, 2, -1, -2)]
    tasks = TaskList.of(["n1", "n2", "s1", "s2"], points, "wgs84", [1, 2, 3, 4], depot=(47.0, 8.0))
    fleet = Fleet((Uav("north", 9_000.0, 10.0, reserve_percent=20.0), Uav("south", 9_000.0, 10.0, reserve_percent=20.0)))
    save_plan(make_plan(tasks, fleet, Schedule([[0, 1], [2, 3]]), "by hand"), Path("mission", "mission.json"))
    return Path("mission")


def replan(status: str, *arguments: str) -> int:
    Path("status.csv").write_text(HEAD + status)
    return main(["replan", *arguments, "--status", "status.csv", "--time-limit", "0.01"])


def test_a_mission_in_the_air(mission, capsys):
    before = file_hash(mission / "mission.json")
    status = "uav,north,47.015,8,7000\nuav,south,47,8,8000\ndone,n1\ntask,new,47.02,8.001,5,,yes\ndrop,s2\n"
    assert replan(status, "mission") == 2
    assert "status.csv: row 5: remaining_m is 5, but this is a task" in capsys.readouterr().err
    status = status.replace("8.001,5,,yes", "8.001,,5,,yes")
    assert replan(status, "mission") == 0
    printed = " ".join(capsys.readouterr().out.split())
    for text in (
        "Done or dropped: n1, s2.",
        "New tasks: 1 of 1 served.",
        "3 of 3 tasks served, value 10 of 10",
        "2 of the 3 legs that were left to fly are kept",
        "A person must review this plan before it is flown.",
        "Written to mission-replanned: mission.json",
    ):
        assert text in printed
    assert {path.name for path in mission.iterdir()} == {"mission.json"} and file_hash(mission / "mission.json") == before
    plan = load_plan(Path("mission-replanned", "mission.json"))
    assert plan.fleet.uavs[0].start == (47.015, 8.0)
    assert plan.past_tasks == ("n1", "s2")
    summary = json.loads(Path("mission-replanned", "summary.json").read_text())
    assert any("legs that were left to fly are kept" in remark for remark in summary["remarks"])
    assert Path("mission-replanned", "north.plan").is_file()
    # The next one begins with the newest plan, and goes into another folder.
    assert replan(status, "mission-replanned") == 0
    printed = capsys.readouterr().out
    assert "Nothing has changed: all of 5 legs left to fly are kept." in printed
    assert "Routes that stay as they are: north, south." in printed
    again = load_plan(Path("mission-replanned-2", "mission.json"))
    assert [route.stops for route in again.routes] == [route.stops for route in plan.routes]
    assert again.past_tasks == plan.past_tasks


def test_how_it_is_flown_stays(mission):
    from sb3_uav.missions.write import write_mission

    write_mission(load_plan(mission / "mission.json"), "first", FlightOptions(80.0, 15.0, "ardupilot", landing="land"))
    assert replan("lost,north\n", str(Path("first", "mission.json")), "-o", "second", "--altitude-step", "5") == 0
    summary = json.loads(Path("second", "summary.json").read_text())
    expected = {"altitude_m": 80.0, "altitude_step_m": 5.0, "firmware": "ardupilot", "landing": "land"}
    assert {name: summary["flight"][name] for name in expected} == expected
    assert not Path("second", "north.plan").exists()


def test_what_must_be_served_and_is_not_is_a_failure(mission, capsys):
    assert replan("task,far,47.3,8,,1,,yes\n", "mission", "-o", "new") == 1
    assert "Not served, though it must be: far." in " ".join(capsys.readouterr().out.split())
    assert Path("new", "mission.json").is_file()


@pytest.mark.parametrize(
    ("status", "arguments", "message"),
    [
        ("lost,nord\n", ["mission"], "status.csv: row 2: the plan has no UAV nord; did you mean north?"),
        ("done,n1\ndone,N2\n", ["mission"], "status.csv: row 3: the plan has no task N2; did you mean n2?"),
        ("uav,north,8,47,500\n", ["mission"], "row 2: 8, 47 is"),
        ("uav,north,8,47,500\n", ["mission"], "lat and lon look swapped."),
        ("lost,north\nlost,south\n", ["mission"], "all 2 UAVs are lost; nobody is left to fly"),
        ("lost,north\n", ["nowhere"], "No such file or directory"),
        ("lost,north\n", ["status.csv"], "status.csv: this is not JSON"),
        ("lost,north\n", ["mission", "-o", "mission"], "a replan does not change the mission that it starts from"),
        ("lost,north\n", ["mission", "-o", "."], "this folder holds other files"),
        ("lost,north\n", ["mission", "--min-gain", "nan"], "min_gain is nan"),
        ("lost,north\n", ["mission", "--altitude", "-3"], "altitude_m is -3"),
    ],
)
def test_errors_write_nothing(mission, capsys, status, arguments, message):
    assert replan(status, *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-uav replan: error: ") and error.count("\n") == 1
    assert message in error
    assert {path.name for path in Path().iterdir()} == {"mission", "status.csv"}
    assert {path.name for path in mission.iterdir()} == {"mission.json"}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("system", "moon", "system is 'moon'; it is one of wgs84, plane."),
        ("depot", [float("nan"), 8.0], "depot is [nan, 8.0]; give latitude and longitude in degrees."),
        ("depot", [47.0, 10**400], "OverflowError"),
        ("seed", 1e400, "OverflowError"),
        ("fleet", None, "TypeError"),
        ("past", [1], "AttributeError"),
        ("routes", [["n1"], ["n3"]], "KeyError 'n3'"),
        ("routes", [["n1", "n1"], []], "is visited twice"),
        ("seconds", "soon", "could not convert string to float"),
        ("depot", None, "the plan has no depot"),
        ("fleet", [], "there are 0 UAVs"),
    ],
)
def test_a_changed_plan_is_an_error(mission, capsys, field, value, message):
    path = mission / "mission.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), field: value}))
    assert replan("lost,north\n", "mission") == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-uav replan: error: mission/mission.json: ") and error.count("\n") == 1
    assert message in error


@pytest.mark.parametrize(
    ("part", "field", "value", "message"),
    [
        ("fleet", "reserve_percent", -300, "UAV 1: the reserve is -300 %"),
        ("fleet", "range_m", -1, "UAV 1: the range is -1 m"),
        ("fleet", "full_range_m", 0, "UAV 1: the full range is 0 m"),
        ("fleet", "speed_mps", 0, "UAV 1: the speed is 0 m/s"),
        ("fleet", "level", -4, "UAV 1: the level is -4"),
        ("tasks", "must", "no", "'no' is neither true nor false"),
        ("tasks", "value", float("nan"), "task 1: value is nan"),
        ("tasks", "point", [147.0, 8.0], "task 1: lat is 147"),
        ("tasks", "altitude_m", 1e6, "task 1: alt_m is 1000000"),
    ],
)
def test_a_plan_whose_parts_cannot_be_is_an_error(mission, capsys, part, field, value, message):
    path = mission / "mission.json"
    data = json.loads(path.read_text())
    data[part][0][field] = value
    path.write_text(json.dumps(data))
    assert replan("lost,north\n", "mission") == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-uav replan: error: mission/mission.json: ") and error.count("\n") == 1
    assert message in error


def test_a_plan_that_is_nested_deeply_or_names_something_twice_is_an_error(mission, capsys):
    path = mission / "mission.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "tasks": [data["tasks"][0], *data["tasks"]]}))
    assert replan("lost,north\n", "mission") == 2
    assert "two tasks have the same name" in capsys.readouterr().err
    path.write_text("[" * 100_000)
    assert replan("lost,north\n", "mission") == 2
    assert "this is not JSON" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[]", "{}", "[" * 100_000, '{"flight": 3}', '{"flight": {"altitude_m": -1}}', "\udcff"])
def test_a_summary_of_any_content(mission, text):
    from sb3_uav.cli.replan import _former_flight

    (mission / "summary.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    assert _former_flight(mission) == {}

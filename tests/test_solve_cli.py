"""`sb3-uav solve`: files in, missions, a summary and an exit code out."""

from __future__ import annotations

import hashlib
import io
import json
import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sb3_uav.missions
from sb3_uav.cli import main as cli
from sb3_uav.cli.mission_report import Progress, exit_code, print_plan, why_empty
from sb3_uav.common.interruption import ends_at_once
from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions import Fleet, Plan, TaskList, Uav, load_plan, solve
from sb3_uav.missions.fleet_options import FleetOptions
from sb3_uav.missions.search import make_plan
from sb3_uav.solvers import NoScheduleError

rich_console = pytest.importorskip("rich.console")
pytest.importorskip("matplotlib")
pytest.importorskip("plotly")
pytest.importorskip("pyproj")

EXAMPLES = Path(__file__).parents[1] / "examples" / "missions"
TASKS = """\
id,lat,lon,value,must,depot
base,47.0,8.0,,,yes
a,47.01,8.0,1,,
b,47.01,8.015,2,yes,
c,46.99,8.0,3,,
d,47.3,8.0,4,,
e,47.0,8.001,0,,
"""
# Deterministic, and done at once.
FAST = ("--solver", "greedy-insertion", "--time-limit", "1")


@pytest.fixture
def tasks_csv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    path = tmp_path / "tasks.csv"
    path.write_text(TASKS, encoding="utf-8")
    return path


def run(*arguments: str) -> int:
    return cli.main(["solve", *arguments])


def test_a_mission(tasks_csv: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("tasks.csv", "--uavs", "2", "--range", "6km", "--speed", "36km/h", "--reserve", "5", *FAST, "-o", "out") == 0
    printed = capsys.readouterr()
    assert printed.err == "" and max(map(len, printed.out.splitlines())) <= 80
    text = " ".join(printed.out.split())
    assert text.startswith("3 of 5 tasks served, value 6 of 10,")
    assert "1 task skipped, out of reach: d (61.1 km short)" in text and "1 task skipped, worth nothing: e" in text
    assert "A person must review this plan" in text and "bound" not in text and "No reserve" not in text
    assert "Written to out: mission.json," in text and text.endswith("summary.json")
    summary = json.loads(Path("out/summary.json").read_text(encoding="utf-8"))
    assert summary["source"]["tasks"] == {"file": "tasks.csv", "sha256": hashlib.sha256(TASKS.encode()).hexdigest()}
    assert (summary["seed"], summary["solver"], summary["time_limit"]) == (0, "greedy-insertion", 1.0)
    assert [(uav["range_m"], uav["reserve_percent"]) for uav in summary["uavs"]] == [(6000, 5), (6000, 5)]
    plan = load_plan(Path("out/mission.json"))
    assert plan.objective == 6 and all(route.used_m <= 5700 for route in plan.routes)
    assert plan.fleet.uavs[0].speed_mps == 10


def test_a_task_that_must_be_served_and_is_not(tasks_csv: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks_csv.write_text(TASKS.replace("d,47.3,8.0,4,,", "d,47.3,8.0,4,yes,"), encoding="utf-8")
    assert run("tasks.csv", "--uavs", "2", "--range", "6km", *FAST, "-o", "out") == 1
    assert "Not served, though it must be: d." in capsys.readouterr().out
    assert Path("out/summary.json").is_file()


def test_an_empty_plan_says_why(tasks_csv: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks_csv.write_text(TASKS.replace("b,47.01,8.015,2,yes,\n", ""), encoding="utf-8")
    assert run("tasks.csv", "--uavs", "2", "--range", "2km", *FAST, "-o", "out") == 1
    text = " ".join(capsys.readouterr().out.split())
    # 2 x 1111.7 m to the task a, and a little less to c, south of the depot.
    assert "The plan is empty: all tasks are out of reach; the nearest, c, needs 224 m more range" in text
    assert load_plan(Path("out/mission.json")).n_served == 0
    tasks_csv.write_text("id,lat,lon,value,depot\nbase,47,8,,yes\na,47.001,8,0,\n", encoding="utf-8")
    assert run("tasks.csv", "--uavs", "2", "--range", "2km", *FAST, "-o", "out") == 1
    assert "every task is worth nothing" in " ".join(capsys.readouterr().out.split())


FLEET = ("--uavs", "2", "--range", "6km")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "Nothing says which UAVs there are; say --uavs 4 --range 12km"),
        (("--uavs", "0", "--range", "6km"), "there are 0 UAVs"),
        (("--uavs", "1000000000", "--range", "6km"), "there are 1000000000 UAVs"),
        (("--uavs", "2"), "--range, how far every UAV flies, is missing"),
        (("--range", "2km"), "--uavs, the number of UAVs, is missing"),
        (("--uavs", "2", "--range", "-3km"), "--range is -3km; give a finite quantity above 0"),
        (("--uavs", "2", "--range", "3 parsec"), "--range: '3 parsec': 'parsec' is no unit of length"),
        (("--uavs", "2", "--endurance", "25min"), "--endurance needs --speed"),
        (("--uavs", "2", "--endurance", "25min", "--range", "3km"), "--range and --endurance say the same"),
        ((*FLEET, "--fleet", "fleet.csv"), "--fleet says it all"),
        ((*FLEET, "--reserve", "100"), "--reserve is 100; give a percentage"),
        ((*FLEET, "--reserve", "nan"), "--reserve is nan"),
        ((*FLEET, "--depot", "47,8"), "is the depot already"),
        ((*FLEET, "--unit", "km"), "unit"),
        ((*FLEET, "--time-limit", "0"), "--time-limit is 0"),
        ((*FLEET, "--time-limit", "nan"), "--time-limit is nan"),
        ((*FLEET, "--solver", "magic"), "Unknown solver 'magic'"),
        ((*FLEET, "--altitude", "-5"), "altitude_m is -5"),
        ((*FLEET, "--altitude-step", "nan"), "altitude_step_m is nan"),
        (("--fleet", "none.csv"), "none.csv: there is no such file"),
    ],
)
def test_wrong_arguments(
    tasks_csv: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    assert run("tasks.csv", *arguments, "-o", "out") == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-uav solve: error: ") and error.count("\n") == 1 and message in error
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "tasks.csv"),
        (TASKS.replace("base,47.0,8.0,,,yes\n", ""), "there is no depot"),
        (TASKS.replace("47.01,8.015", "nan,8.015"), "row 4"),
        (TASKS.replace("a,", "b,"), "row 4"),
        (TASKS.replace("47.01,8.015", "47.01,8.0"), "row 4"),
        (TASKS.replace("lon,", "x,"), "tasks.csv"),
    ],
)
def test_wrong_files(tasks_csv: Path, capsys: pytest.CaptureFixture[str], text: str, message: str) -> None:
    tasks_csv.write_text(text, encoding="utf-8")
    assert run("tasks.csv", *FLEET, "-o", "out") == 2
    assert message in capsys.readouterr().err and not Path("out").exists()


def test_a_folder_of_somebody_else_is_found_before_the_search(
    tasks_csv: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_uav.missions.search.solve", None)
    assert run("tasks.csv", *FLEET, "-o", ".") == 2
    assert "holds other files, such as tasks.csv" in capsys.readouterr().err


def test_ctrl_c_writes_nothing(tasks_csv: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_uav.missions.search.solve", interrupted)
    assert run("tasks.csv", *FLEET, "-o", "out") == 130
    assert not Path("out").exists()


def test_a_solver_without_a_plan(tasks_csv: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def give_up(*_: Any) -> None:
        raise NoScheduleError("out of time")

    monkeypatch.setattr("sb3_uav.missions.search.solve", give_up)
    assert run("tasks.csv", *FLEET, "-o", "out") == 2
    assert "The solver found no plan: out of time" in capsys.readouterr().err and not Path("out").exists()


@pytest.mark.usefixtures("ctrl_c_works")
def test_ctrl_c_does_not_wait_for_the_search(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    ended: list[Any] = []
    monkeypatch.setattr("os._exit", ended.append)
    with ends_at_once("sb3-uav solve", lambda: ended.append("cleaned up")):
        signal.raise_signal(signal.SIGINT)
    assert ended == ["cleaned up", 130] and capsys.readouterr().err == "sb3-uav solve: interrupted\n"
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    # As under nohup.
    former = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with ends_at_once("sb3-uav solve"):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, former)


def test_a_depot_in_the_south(tasks_csv: Path) -> None:
    tasks_csv.write_text("id,lat,lon\na,-33.0,151.01\n", encoding="utf-8")
    assert run("tasks.csv", "--depot", "-33.0,151.0", *FLEET, *FAST, "-o", "out") == 0
    assert np.array_equal(load_plan(Path("out/mission.json")).tasks.depot, [-33.0, 151.0])  # type: ignore[arg-type]


def test_a_plane_says_what_is_missing(tasks_csv: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks_csv.write_text("id,x,y\na,1.5,0\n", encoding="utf-8")
    flags = ("--unit", "km", "--depot", "0,0", "--uavs", "1", "--range", "3km")
    assert run("tasks.csv", *flags, *FAST, "-o", "out") == 0
    assert "no .plan, .waypoints and KML" in " ".join(capsys.readouterr().out.split())
    assert load_plan(Path("out/mission.json")).length_m == pytest.approx(3000)


def test_flight_options_reach_the_files(tasks_csv: Path) -> None:
    options = ("--altitude", "70", "--altitude-step", "5", "--firmware", "ardupilot", "--vehicle", "fixed-wing")
    assert run("tasks.csv", "--uavs", "2", "--range", "4.5km", *options, "--landing", "land", *FAST, "-o", "out") == 0
    missions = [json.loads(Path(f"out/uav-{n}.plan").read_text(encoding="utf-8"))["mission"] for n in (1, 2)]
    assert [mission["items"][0]["Altitude"] for mission in missions] == [70, 75]
    assert (missions[0]["firmwareType"], missions[0]["vehicleType"], missions[0]["items"][-1]["command"]) == (3, 1, 21)


def test_commands_of_the_examples_are_those_of_the_docs() -> None:
    """Where they run, see `test_doc_blocks.py`."""
    commands = re.findall(r"`(sb3-uav .*?)`", (EXAMPLES / "README.md").read_text(encoding="utf-8"))
    page = (EXAMPLES.parents[1] / "docs" / "missions.md").read_text(encoding="utf-8").splitlines()
    assert len(commands) == 4 and set(commands) <= set(page)


def test_example_data_is_what_the_script_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES.parents[1]))
    from scripts.make_mission_examples import main

    main(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert made == {path.name: path.read_bytes() for path in EXAMPLES.iterdir() if path.suffix != ".md"}


# ------------------------------------------------------------------------------------------------------ the fleet


NO_TASKS = TaskList.of([], np.zeros((0, 2)), "plane", depot=(0, 0))


def test_endurance_and_speed_are_a_range() -> None:
    fleet = FleetOptions(uavs=3, endurance="25min", speed="12m/s", reserve_percent=10).fleet(NO_TASKS)
    assert [uav.id for uav in fleet] == ["uav-1", "uav-2", "uav-3"]
    assert fleet.uavs[0] == Uav("uav-1", 18_000, 12.0, reserve_percent=10)


def test_options_complete_the_file_of_a_fleet(tmp_path: Path) -> None:
    path = tmp_path / "fleet.csv"
    path.write_text("id,range_m,speed_mps,reserve_percent\na,5000,,\nb,6000,15,30\n", encoding="utf-8")
    fleet = FleetOptions(path, speed="10", reserve_percent=20).fleet(NO_TASKS)
    assert [(uav.speed_mps, uav.reserve_percent) for uav in fleet] == [(10, 20), (15, 30)]
    assert fleet.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_file_of_tasks_may_bring_its_fleet() -> None:
    tasks = replace(NO_TASKS, fleet=Fleet.of_equal(2, 40.0, source="chao"))
    assert [uav.range_m for uav in FleetOptions().fleet(tasks)] == [40, 40]
    assert [uav.range_m for uav in FleetOptions(uavs=1, range="50").fleet(tasks)] == [50]


# ------------------------------------------------------------------------------------------------------ what is shown


def small_plan(n_tasks: int = 3, range_m: float = 1e4) -> Plan:
    ids = [f"t{number}" for number in range(n_tasks)]
    tasks = TaskList.of(ids, [(100 * n, 50) for n in range(n_tasks)], "plane", depot=(0, 0))
    return solve(tasks, Fleet.of_equal(2, range_m), "greedy-insertion")


def printed(plan: Plan) -> str:
    console = rich_console.Console(file=io.StringIO(), width=80, highlight=False)
    print_plan(plan, [], console)
    assert max(map(len, console.file.getvalue().splitlines())) <= 80
    return " ".join(console.file.getvalue().split())


def test_a_bound_is_shown_only_if_there_is_one() -> None:
    plan = small_plan()
    assert "bound" not in printed(plan)
    assert "proven bound 4, gap 25.0 %" in printed(replace(plan, bound=4.0))


def test_many_and_hostile_names() -> None:
    plan = small_plan(12, 300.0)
    assert "10 tasks skipped, out of reach: t2 (" in printed(plan) and "and 5 more" in printed(plan)
    tasks = replace(plan.tasks, ids=("[red]\x1b[31m" + 100 * "x", *plan.tasks.ids[1:]))
    fleet = Fleet((Uav("[/] " + 200 * "y", 10.0),))
    # Not by solve, which refuses such names.
    hostile = make_plan(tasks, fleet, Schedule([[]]), "by hand")
    assert "\x1b" not in printed(hostile) and "[red]" in printed(hostile)
    assert exit_code(hostile) == 1


def test_why_a_plan_may_be_empty_though_tasks_are_in_reach() -> None:
    plan = small_plan(1)
    empty = replace(plan, routes=(), skipped=(sb3_uav.missions.plan.Skipped(0, "did not fit", 0.0),))
    assert "though task t0 alone is in reach" in why_empty(empty)


def test_progress_on_a_terminal() -> None:
    console = rich_console.Console(file=io.StringIO(), force_terminal=True, width=80)
    with Progress(5.0, console) as progress:
        progress._live.refresh()
        assert "loading the solver" in console.file.getvalue()
        progress.begin()
        progress(small_plan())
        progress._live.refresh()
    assert "of 5 s: 3 of 3 tasks, value 3" in console.file.getvalue()
    console = rich_console.Console(file=io.StringIO(), width=80)
    with Progress(5.0, console) as progress:
        solve(small_plan().tasks, Fleet.of_equal(1, 1e4), "greedy-insertion", on_plan=progress, on_start=progress.begin)
        assert progress._start is not None
    assert console.file.getvalue() == ""


# ------------------------------------------------------------------------------------------------------ Python


def test_exports() -> None:
    for name in sb3_uav.missions.__all__:
        assert getattr(sb3_uav.missions, name).__module__.startswith("sb3_uav.missions.")
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = sb3_uav.missions.no_such_name

"""A mission in a folder: which files, what is in them, and that the folder is whole at any time."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule
from sb3_uav.missions import FlightOptions, load_plan, write_mission
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.map_png import map_figure, round_length
from sb3_uav.missions.writers.routes_csv import write_routes_csv
from sb3_uav.missions.writers.summary import summary_of

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")
pytest.importorskip("pyproj")

DEPOT = (47.0, 8.0)
EVERYWHERE = {"mission.json", "routes.csv", "routes.geojson", "map.png", "map.html", "summary.json"}


def plan_of(routes: Any = ((0, 1), (2,)), fleet: Fleet | None = None, **fields: Any) -> Plan:
    """Four tasks around the depot, some 1.1 km away in each direction."""
    points = [(47.01, 8.0), (47.01, 8.015), (46.99, 8.0), (47.0, 7.985)]
    tasks = TaskList.of(["a", "b", "c", "d"], points, "wgs84", depot=DEPOT, **fields)
    return make_plan(tasks, fleet or Fleet.of_equal(len(routes), 6_000, 10.0), Schedule(routes), "by hand", seed=3)


def plane_plan(points: Any, **fields: Any) -> Plan:
    """One UAV flies over all points of a plane."""
    fields = {"ids": range(len(points)), "depot": (0, 0), **fields}
    tasks = TaskList.of(points=points, system="plane", **fields)
    return make_plan(tasks, Fleet.of_equal(1, 1e7), Schedule([range(len(points))]), "by hand")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_files(tmp_path: Path) -> None:
    files = write_mission(plan_of(), tmp_path / "new" / "out")
    per_uav = {f"uav-{n}.{suffix}" for n in (1, 2) for suffix in ("plan", "waypoints")}
    assert names(tmp_path / "new" / "out") == EVERYWHERE | per_uav | {"routes.kml"} == {path.name for path in files}
    assert names(tmp_path / "new") == {"out"}
    with Image.open(tmp_path / "new" / "out" / "map.png") as picture:
        assert min(picture.size) > 600
    assert load_plan(tmp_path / "new" / "out" / "mission.json").objective == 3


def test_a_plane_has_no_missions_of_autopilots(tmp_path: Path) -> None:
    write_mission(plane_plan([(10, 0), (20, 5)]), tmp_path / "out")
    assert names(tmp_path / "out") == EVERYWHERE


# ------------------------------------------------------------------------------------------------------ tables


def rows_of(plan: Plan, folder: Path) -> list[dict[str, str]]:
    write_routes_csv(plan, folder / "routes.csv")
    with (folder / "routes.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_routes_csv(tmp_path: Path) -> None:
    plan = plan_of(values=[1, 2.5, 3, 4], service_s=[0, 30, 0, 0])
    rows = rows_of(plan, tmp_path)
    assert [(row["uav"], row["stop"], row["task"]) for row in rows] == [
        *(("uav-1", stop, task) for stop, task in (("1", "a"), ("2", "b"), ("3", ""))),
        *(("uav-2", stop, task) for stop, task in (("1", "c"), ("2", ""))),
    ]
    assert list(rows[0]) == "uav stop task lat lon leg_m used_m value service_s arrival_s".split()
    assert (rows[1]["lat"], rows[1]["lon"], rows[1]["value"], rows[1]["service_s"]) == ("47.01", "8.015", "2.5", "30")
    assert (rows[2]["lat"], rows[2]["lon"], rows[2]["value"]) == ("47.0", "8.0", "")
    legs = [float(row["leg_m"]) for row in rows]
    # 0.01 degrees of latitude, and 0.015 degrees of longitude at 47 degrees.
    assert legs[:2] == pytest.approx([1111.7, 1140.4], abs=0.5)
    assert float(rows[1]["used_m"]) == pytest.approx(legs[0] + legs[1] + 300, abs=0.1)
    # The UAV arrives before it serves.
    assert float(rows[1]["arrival_s"]) == pytest.approx((legs[0] + legs[1]) / 10, abs=0.1)
    seconds = plan.routes[0].seconds
    assert seconds is not None and float(rows[2]["arrival_s"]) == pytest.approx(seconds, abs=0.1)
    assert float(rows[2]["used_m"]) == pytest.approx(plan.routes[0].used_m, abs=0.01)


def test_routes_csv_without_speed_and_of_uavs_without_stops(tmp_path: Path) -> None:
    fleet = Fleet((Uav("stays", 5_000), Uav("moves", 5_000, end=(47.001, 8.0)), Uav("cannot", 10, end=(47.001, 8.0))))
    rows = rows_of(plan_of([[], [], []], fleet), tmp_path)
    assert [(row["uav"], row["stop"], row["task"], row["arrival_s"]) for row in rows] == [("moves", "1", "", "")]
    assert [row["x"] for row in rows_of(plane_plan([(1.5, 0)], meters_per_unit=1000), tmp_path)] == ["1.5", "0.0"]


def test_summary(tmp_path: Path) -> None:
    plan = replace(plan_of(must=[False, False, False, True]), time_limit=7.0)
    write_mission(plan, tmp_path / "out", FlightOptions(altitude_m=70))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert (summary["objective"], summary["bound"], summary["gap"], summary["n_served"]) == (3, None, None, 3)
    assert (summary["seed"], summary["solver"], summary["time_limit"]) == (3, "by hand", 7)
    assert [uav["uav"] for uav in summary["uavs"]] == ["uav-1", "uav-2"]
    assert [uav["altitude_m"] for uav in summary["uavs"]] == [70, 80] and summary["flight"]["landing"] == "rtl"
    first = summary["uavs"][0]
    assert first["used_m"] == pytest.approx(plan.routes[0].used_m, abs=0.001)
    assert first["share_of_range"] == pytest.approx(plan.routes[0].used_m / 6_000, abs=1e-6)
    assert [(skipped["task"], skipped["reason"]) for skipped in summary["skipped"]] == [("d", "did not fit")]
    assert summary["unserved_must"] == ["d"] and any("must be: d" in remark for remark in summary["remarks"])
    assert summary["checker"]["verdict"] == "feasible" and 0.5 < summary["checker"]["largest_share_of_usable_range"] <= 1
    assert {"python", "numpy", "pyproj", "sb3-uav"} <= set(summary["versions"])
    assert set(summary["files"]) == names(tmp_path / "out") - {"summary.json"}


def test_a_bound_makes_a_gap() -> None:
    summary = summary_of(replace(plan_of(), bound=4.0), FlightOptions())
    assert (summary["bound"], summary["gap"]) == (4.0, 0.25)


# ------------------------------------------------------------------------------------------------------ the folder


def test_a_former_mission_is_replaced(tmp_path: Path) -> None:
    write_mission(plan_of([[0], [1], [2]]), tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    inode = tmp_path.stat().st_ino
    write_mission(plan_of([[0, 1]]), tmp_path)
    assert names(tmp_path) == EVERYWHERE | {"routes.kml", "uav-1.plan", "uav-1.waypoints", "notes.txt"}
    assert (tmp_path / "notes.txt").read_text() == "mine"
    # A shell may be in it.
    assert tmp_path.stat().st_ino == inode


def test_other_files_are_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "routes.csv").write_text("mine")
    with pytest.raises(ValueError, match=r"holds other files, such as routes\.csv"):
        write_mission(plan_of(), tmp_path)
    # Nor those that would get in the way of a UAV that the former mission did not have.
    write_mission(plan_of([[0]]), tmp_path / "out")
    (tmp_path / "out" / "uav-2.plan").write_text("mine")
    before = contents(tmp_path / "out")
    with pytest.raises(ValueError, match=r"uav-2\.plan: this file is not of an earlier mission"):
        write_mission(plan_of(), tmp_path / "out", overwrite=True)
    assert contents(tmp_path / "out") == before
    with pytest.raises(ValueError, match="this is a file"):
        write_mission(plan_of(), tmp_path / "routes.csv")


@pytest.mark.parametrize("summary", ["{", "[]", '{"files": {"notes.txt": ""}}', '{"format": "sb3-uav mission summary"}'])
def test_a_summary_of_somebody_else(tmp_path: Path, summary: str) -> None:
    (tmp_path / "summary.json").write_text(summary)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds other files"):
        write_mission(plan_of(), tmp_path)
    assert names(tmp_path) == {"summary.json", "notes.txt"}


def test_a_summary_reaches_no_other_folder(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    write_mission(plan_of(), tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    summary["files"] |= {"../mine.txt": "", "..": "", str(tmp_path / "mine.txt"): ""}
    (tmp_path / "out" / "summary.json").write_text(json.dumps(summary))
    write_mission(plan_of(), tmp_path / "out", overwrite=True)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_changed_files_are_replaced_only_when_told(tmp_path: Path) -> None:
    write_mission(plan_of(), tmp_path)
    (tmp_path / "uav-1.plan").write_text("changed in a ground station")
    with pytest.raises(ValueError, match=r"uav-1\.plan: it was changed .* --overwrite"):
        write_mission(plan_of(), tmp_path)
    assert (tmp_path / "uav-1.plan").read_text() == "changed in a ground station"
    write_mission(plan_of(), tmp_path, overwrite=True)
    assert json.loads((tmp_path / "uav-1.plan").read_text())["fileType"] == "Plan"
    # A file that is missing needs no word.
    (tmp_path / "uav-1.plan").unlink()
    write_mission(plan_of(), tmp_path)


def test_a_writer_that_fails_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mission(plan_of(), tmp_path / "out")
    before = contents(tmp_path / "out")

    def fail(*_: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("sb3_uav.missions.writers.kml.write_kml", fail)
    for folder in ("out", "new"):
        with pytest.raises(OSError, match="no space"):
            write_mission(plan_of([[3]]), tmp_path / folder)
    assert contents(tmp_path / "out") == before and names(tmp_path) == {"out"}


@pytest.mark.parametrize("n_renames", [0, 3, 9, 14])
def test_a_replacement_that_fails_halfway_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_renames: int) -> None:
    write_mission(plan_of(), tmp_path)
    before, rename, calls = contents(tmp_path), Path.rename, []

    def fail_once(path: Path, target: Path) -> Path:
        calls.append(target)
        if len(calls) == n_renames + 1:
            raise PermissionError("in use")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail_once)
    with pytest.raises(PermissionError):
        write_mission(plan_of([[3]]), tmp_path)
    assert contents(tmp_path) == before and len(calls) > n_renames


def test_what_an_interrupted_run_left_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / ".sb3-uav-0123").mkdir()
    write_mission(plan_of(), tmp_path)
    assert "summary.json" in names(tmp_path)


def test_a_plan_that_breaks_a_constraint_is_not_written(tmp_path: Path) -> None:
    plan = plan_of()
    longer = replace(plan.routes[0], stops=(0, 2, 1, 3))
    with pytest.raises(InfeasibleScheduleError):
        write_mission(replace(plan, routes=(longer, plan.routes[1])), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------------ the picture


def numbers_on(plan: Plan) -> list[str]:
    axes = map_figure(plan).axes[0]
    return [text.get_text() for text in axes.texts if text.get_text().isdigit()]


def test_stops_are_numbered_where_there_is_room() -> None:
    circle = [(100 * math.cos(t), 100 * math.sin(t)) for t in np.linspace(0, 6, 30)]
    assert sorted(numbers_on(plane_plan(circle)), key=int) == [str(n) for n in range(1, 31)]
    crowd = [(500 + 0.1 * n, 0.0) for n in range(100)]
    crowded = numbers_on(plane_plan([*crowd, (1000, 1000)]))
    assert 2 <= len(crowded) < 10 and {"1", "101"} <= set(crowded)
    # Nor over the depot.
    assert numbers_on(plane_plan([(0, 1), (1000, 1000)])) == ["2"]


def test_the_picture_is_true_to_scale() -> None:
    plan = plan_of(values=[1, 1, 1, 0])
    axes = map_figure(plan).axes[0]
    assert axes.get_aspect() == 1
    length = np.ptp(axes.lines[-1].get_xdata())
    (label,) = [text.get_text() for text in axes.texts if text.get_text().endswith("m") and text.get_text()[0].isdigit()]
    assert label == "500 m" and length == pytest.approx(500)
    # North is up: the first task lies above the depot, 1112 m away.
    tour = next(line for line in axes.lines if len(line.get_xdata()) == 4)
    assert (tour.get_xdata()[1], tour.get_ydata()[1]) == pytest.approx((0, 1111.7), abs=0.5)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert "1 skipped, worth nothing" in labels and any(label.startswith("uav-2: 1 stop, 2.22 km") for label in labels)


def test_tasks_on_another_continent_do_not_shrink_the_map() -> None:
    tasks = TaskList.of(["a", "far"], [(47.01, 8.0), (-33.0, 151.0)], "wgs84", depot=DEPOT)
    axes = map_figure(make_plan(tasks, Fleet.of_equal(1, 5_000), Schedule([[0]]), "by hand")).axes[0]
    assert np.ptp(axes.get_ylim()) < 2_000
    assert "1 skipped, out of reach (1 outside the map)" in [text.get_text() for text in axes.get_legend().get_texts()]


def test_names_that_are_no_formulas(tmp_path: Path) -> None:
    tasks = TaskList.of(["$x^{"], [(1, 0)], "plane", depot=(0, 0), source="$\\frac{.csv")
    plan = make_plan(tasks, Fleet((Uav("$_\x1b", 10.0),)), Schedule([[0]]), "by hand")
    write_mission(plan, tmp_path / "out")
    assert (tmp_path / "out" / "map.png").is_file()


def test_more_uavs_than_a_legend_has_room_for() -> None:
    points = [(n, 100.0) for n in range(30)]
    tasks = TaskList.of(range(30), points, "plane", depot=(0, 0))
    plan = make_plan(tasks, Fleet.of_equal(30, 1e4), Schedule([[n] for n in range(30)]), "by hand")
    labels = [text.get_text() for text in map_figure(plan).axes[0].get_legend().get_texts()]
    assert "10 more UAVs" in labels and sum(label.startswith("uav-") for label in labels) == 20


@given(st.floats(1e-3, 1e7))
def test_round_lengths(most: float) -> None:
    length = round_length(most)
    assert most / 2.5 * (1 - 1e-6) <= length <= most * (1 + 1e-6)
    assert f"{length:e}"[0] in "125" and float(f"{length:.0e}") == pytest.approx(length)

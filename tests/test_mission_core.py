"""Plans of missions: meters on the ground, reasons for tasks that are left out, files."""

from dataclasses import replace

import numpy as np
import pytest

from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule
from sb3_uav.missions.coordinates import Geographic
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.labels import at_least
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.plan_file import load_plan, save_plan
from sb3_uav.missions.search import make_plan, solve
from sb3_uav.missions.tasks import TaskList

pytest.importorskip("pyproj")


def tasks_at(*points, depot=(47.0, 8.0), **fields):
    return TaskList.of([f"t{number}" for number in range(len(points))], points, "wgs84", depot=depot, **fields)


def test_lengths_are_geodesic():
    # A degree of latitude at 47.5 degrees north is 111.18 km long, one of longitude at 47 degrees 76.06 km.
    plan = make_plan(tasks_at((48.0, 8.0), (47.0, 9.0)), Fleet.of_equal(2, 300_000), Schedule([[0], [1]]), "by hand")
    assert plan.routes[0].length_m == pytest.approx(2 * 111_180, rel=1e-3)
    assert plan.routes[1].length_m == pytest.approx(2 * 76_060, rel=1e-3)


def test_a_plane_around_the_depot_never_shortens_a_leg():
    points = np.array([47.0, 8.0]) + np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2))
    coordinates = Geographic((47.0, 8.0))
    on_ground = coordinates.leg_lengths(points)
    in_plane = np.hypot(*np.diff(coordinates.to_plane(points), axis=0).T)
    assert (in_plane >= on_ground * (1 - 1e-9)).all()
    assert in_plane == pytest.approx(on_ground, rel=1e-5)
    assert coordinates.from_plane(coordinates.to_plane(points)) == pytest.approx(points, abs=1e-9)


def test_service_and_reserve_count():
    tasks = tasks_at((47.01, 8.0), service_s=[30.0])
    fleet = Fleet.of_equal(1, 3_000, speed_mps=10.0)
    route = make_plan(tasks, fleet, Schedule([[0]]), "by hand").routes[0]
    assert route.service_m == 300
    assert route.used_m == route.length_m + 300
    with pytest.raises(InfeasibleScheduleError):
        make_plan(tasks, Fleet.of_equal(1, 3_000, 10.0, reserve_percent=20), Schedule([[0]]), "by hand")


def test_reasons():
    tasks = tasks_at((47.01, 8.0), (48.0, 8.0), (47.0, 8.001), (46.99, 8.0), values=[1, 1, 0, 1])
    plan = make_plan(tasks, Fleet.of_equal(1, 3_000), Schedule([[0]]), "by hand")
    assert [(skipped.task, skipped.reason) for skipped in plan.skipped] == [
        (1, "out of reach"),
        (2, "worth nothing"),
        (3, "did not fit"),
    ]
    assert plan.skipped[0].missing_m == pytest.approx(2 * 111_194 - 3_000, rel=1e-3)
    # There and back once more, less what is left of the range.
    assert plan.skipped[2].missing_m == pytest.approx(4 * 1_111.7 - 3_000, rel=1e-3)


def test_a_solved_plan_survives_its_file(tmp_path):
    pytest.importorskip("numba")
    rng = np.random.default_rng(1)
    points = np.array([-33.0, 151.0]) + rng.uniform(-0.05, 0.05, (30, 2))
    tasks = TaskList.of(range(30), points, "wgs84", rng.integers(1, 9, 30), depot=(-33.0, 151.0))
    fleet = Fleet((Uav("a", 20_000.0, 12.0), Uav("b", 9_000.0, start=(-33.01, 151.0), reserve_percent=10)))
    plan = solve(tasks, fleet, "local-search", time_limit=0.2)
    assert plan.n_served > 5
    save_plan(plan, tmp_path / "mission.json")
    read = load_plan(tmp_path / "mission.json")
    assert [route.stops for route in read.routes] == [route.stops for route in plan.routes]
    assert (read.objective, read.length_m, read.skipped) == (plan.objective, plan.length_m, plan.skipped)


def test_what_left_tasks_lack_is_the_shortest_way_round_them(monkeypatch):
    """Many tasks are compared in blocks."""
    tasks = tasks_at(*np.array([47.0, 8.0]) + np.random.default_rng(3).uniform(-0.01, 0.01, (11, 2)))

    def used(stops):
        return make_plan(tasks, Fleet.of_equal(1, 1e5), Schedule([stops]), "by hand").routes[0].used_m

    range_m = max(used([0, 1, 2]), *(used([task]) for task in range(3, 11))) + 1
    expected = [
        max(min(used(stops) for stops in ([task, 0, 1, 2], [0, task, 1, 2], [0, 1, task, 2], [0, 1, 2, task])) - range_m, 0)
        for task in range(3, 11)
    ]
    assert max(expected) > 100
    for size in (512, 3):
        monkeypatch.setattr("sb3_uav.missions.leftovers._BLOCK", size)
        skipped = make_plan(tasks, Fleet.of_equal(1, range_m), Schedule([[0, 1, 2]]), "by hand").skipped
        assert [each.task for each in skipped] == list(range(3, 11))
        assert [each.missing_m for each in skipped] == pytest.approx(expected, abs=0.1)


def test_what_is_missing_is_never_rounded_down():
    assert [at_least(length) for length in (0.2, 1.0, 1.2, 9_999.9, 12_301.0)] == ["1 m", "1 m", "2 m", "10000 m", "12.4 km"]


@pytest.mark.parametrize(
    ("change", "fleet", "time_limit", "message"),
    [
        ({"points": np.array([[147.0, 8.0]])}, Fleet.of_equal(1, 3e3), 1.0, "task 1: lat is 147"),
        ({"ids": ("a\n",)}, Fleet.of_equal(1, 3e3), 1.0, "task 1: id is 'a\\n'"),
        ({}, Fleet((Uav("a", 3e3), Uav("a", 3e3))), 1.0, "UAV 2: id 'a' is that of UAV 1 too"),
        ({}, Fleet.of_equal(1, 3e3, reserve_percent=-20), 1.0, "UAV 1: the reserve is -20 %"),
        ({}, Fleet.of_equal(1, 3e3), 0.0, "time_limit is 0; give a number of seconds above 0"),
        ({}, Fleet.of_equal(1, 3e3), np.nan, "time_limit is nan; give a number of seconds above 0"),
    ],
)
def test_what_no_reader_has_checked_is_checked(change, fleet, time_limit, message):
    tasks = replace(tasks_at((47.01, 8.0)), **change)
    with pytest.raises(ValueError) as error:
        solve(tasks, fleet, "greedy-insertion", time_limit)
    assert message in str(error.value)


def test_better_plans_are_told_as_they_come():
    pytest.importorskip("numba")
    points = np.array([47.0, 8.0]) + np.random.default_rng(2).uniform(-0.05, 0.05, (60, 2))
    told: list[Plan] = []
    tasks = TaskList.of(range(60), points, "wgs84", depot=(47.0, 8.0))
    plan = solve(tasks, Fleet.of_equal(2, 12_000), time_limit=0.5, on_plan=told.append)
    assert told
    ranks = [(found.objective, -found.length_m) for found in told]
    assert ranks == sorted(ranks)
    assert (plan.objective, -plan.length_m) >= ranks[-1]


def test_a_plan_of_uavs_in_the_air_survives_its_file(tmp_path):
    """One has flown all it can, one has nothing left but its reserve."""
    fleet = Fleet((Uav("a", 0.0, full_range_m=5e3), Uav("b", 400.0, reserve_percent=100.0), Uav("c", 3_000.0)))
    plan = make_plan(tasks_at((47.01, 8.0)), fleet, Schedule([[], [], [0]]), "by hand")
    save_plan(plan, tmp_path / "mission.json")
    assert load_plan(tmp_path / "mission.json").fleet.uavs == fleet.uavs


def test_a_plan_keeps_its_bound_and_altitudes_and_refuses_a_wrong_bound(tmp_path):
    tasks = tasks_at((47.01, 8.0))
    fleet = Fleet((Uav("b", 3_000.0, level=1),))
    plan = replace(make_plan(tasks, fleet, Schedule([[0]]), "by hand"), bound=1.5)
    save_plan(plan, tmp_path / "mission.json")
    read = load_plan(tmp_path / "mission.json")
    assert (read.bound, read.fleet.level_of(0)) == (1.5, 1)
    assert read.gap == pytest.approx(1 / 3)
    save_plan(replace(plan, bound=0.5), tmp_path / "mission.json")
    with pytest.raises(ValueError, match=r"bound is 0\.5, but it is finite and at least 1"):
        load_plan(tmp_path / "mission.json")

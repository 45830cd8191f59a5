"""What is said about a plan: crossings at one altitude, launch order, reserve, speeds, and what is not modeled."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.crossings import find_crossings
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.remarks import REVIEW, named, remarks_on
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList

LEVEL = FlightOptions(altitude_step_m=0)


def plan_of(points: Any, routes: Any, fleet: Fleet | None = None, depot: Any = (0.0, 0.0), **fields: Any) -> Plan:
    """A plan in meters."""
    tasks = TaskList.of([f"t{number}" for number in range(len(points))], points, "plane", depot=depot, **fields)
    return make_plan(tasks, fleet or Fleet.of_equal(len(routes), 1e6), Schedule(routes), "by hand")


def crossing_legs(plan: Plan, flight: FlightOptions = LEVEL) -> list[Any]:
    return [(crossing.uavs, crossing.legs) for crossing in find_crossings(plan, flight)]


# The first UAV flies east and back, the second one across its way.
CROSS = ([(100, 50), (100, -50), (200, -10), (200, 10)], [[2, 3], [0, 1]])


def test_legs_that_cross() -> None:
    # Out to (200, -10), over to (200, 10) and back; the leg from (100, 50) to (100, -50) cuts the first and the last.
    plan = plan_of(*CROSS)
    assert crossing_legs(plan) == [((0, 1), (0, 1)), ((0, 1), (2, 1))]
    points = [crossing.point for crossing in find_crossings(plan, LEVEL)]
    assert np.array(points) == pytest.approx(np.array([[100, -5], [100, 5]]))
    (remark,) = [remark for remark in remarks_on(plan, LEVEL) if "altitude" in remark]
    assert "2 pairs of legs cross: uav-1 with uav-2; --altitude-step 10" in remark


def test_an_altitude_step_keeps_them_apart() -> None:
    plan = plan_of(*CROSS)
    assert crossing_legs(plan, FlightOptions()) == []
    assert not any("cross" in remark for remark in remarks_on(plan, FlightOptions()))
    # Too small a step is none.
    assert len(crossing_legs(plan, FlightOptions(altitude_step_m=2))) == 2


def test_altitudes_of_tasks_count() -> None:
    # The second UAV flies at 60 m, but between its stops at 50 m, the altitude of the first.
    plan = plan_of(*CROSS, altitudes=np.array([50, 50, np.nan, np.nan]))
    assert crossing_legs(plan, FlightOptions()) == [((0, 1), (0, 1)), ((0, 1), (2, 1))]
    assert any("tasks with altitudes of their own" in remark for remark in remarks_on(plan, FlightOptions()))
    # Its leg falls from 100 m to 0 m, and is at 50 m in the middle, 5 m away from where the others cross it.
    plan = plan_of(*CROSS, altitudes=np.array([100, 0.5, np.nan, np.nan]))
    assert len(crossing_legs(plan, LEVEL)) == 1


def test_the_shared_depot_is_no_crossing() -> None:
    assert crossing_legs(plan_of([(100, 0), (0, 100), (-100, 0)], [[0], [1], [2]])) == []


def test_legs_on_one_line() -> None:
    # Both fly east from the depot, over the same ground.
    assert crossing_legs(plan_of([(100, 0), (300, 0)], [[0], [1]])) == [
        ((0, 1), legs) for legs in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    # On one line, but one behind the other.
    fleet = Fleet((Uav("a", 1e6, end=(100, 0)), Uav("b", 1e6, start=(200, 0), end=(300, 0))))
    assert crossing_legs(plan_of([(50, 0), (250, 0)], [[0], [1]], fleet)) == []


def test_a_uav_on_the_ground_crosses_nothing() -> None:
    fleet = Fleet((Uav("a", 1e6), Uav("weak", 10.0, start=(50, -50), end=(50, 50))))
    plan = plan_of([(100, 0)], [[0], []], fleet)
    assert crossing_legs(plan) == []
    assert "Without a route, because the place where it has to land is out of its reach: weak." in remarks_on(plan)


@given(st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=4, max_size=9, unique=True), st.integers(0, 3))
def test_crossings_agree_with_a_slow_definition(points: Any, split: int) -> None:
    stops = list(range(len(points)))
    fleet = Fleet((Uav("a", 1e6, start=(-60, 1), end=(-60, 2)), Uav("b", 1e6, start=(60, 3), end=(61, 5))))
    plan = plan_of(points, [stops[: split + 1], stops[split + 1 :]], fleet)
    expected = []
    first, second = (list(itertools.pairwise(route.points.tolist())) for route in plan.routes)
    for i, j in itertools.product(range(len(first)), range(len(second))):
        sides = [side(*first[i], end) for end in second[j]], [side(*second[j], end) for end in first[i]]
        # Lines that touch or lie on each other are tested by hand.
        if any(0 in pair for pair in sides):
            return
        if all(np.sign(pair[0]) != np.sign(pair[1]) for pair in sides):
            expected.append(((0, 1), (i, j)))
    assert crossing_legs(plan) == expected


def side(a: Any, b: Any, point: Any) -> float:
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])


def test_launch_order_is_longest_in_the_air_first() -> None:
    points, routes = [(100, 0), (0, 300), (-200, 0)], [[0], [1], [2]]
    assert launches(plan_of(points, routes)) == ["Launch one after the other, the longest route first: uav-2, uav-3, uav-1."]
    fleet = Fleet((Uav("slow", 1e6, 1.0), Uav("fast", 1e6, 10.0), Uav("idle", 1e6, 5.0)))
    # 200 s at 1 m/s against 60 s at 10 m/s.
    assert launches(plan_of(points, [[0], [1], []], fleet)) == [
        "Launch one after the other, the longest time in the air first: slow, fast."
    ]
    # From places of their own, nobody waits.
    assert launches(plan_of(points[:2], [[0], [1]], Fleet((Uav("a", 1e6), Uav("b", 1e6, start=(5, 5)))))) == []


def test_places_of_launches_are_told_apart() -> None:
    """Bases a few meters from each other, in degrees."""
    starts = [(47.123456, 8.123456), (47.123466, 8.123456)]
    fleet = Fleet(tuple(Uav(f"u{number}", 1e6, start=starts[number % 2]) for number in range(4)))
    tasks = TaskList.of("abcd", [(47.13, 8.12 + 0.001 * number) for number in range(4)], "wgs84", depot=starts[0])
    plan = make_plan(tasks, fleet, Schedule([[0], [1], [2], [3]]), "by hand")
    places = [remark.partition(" at ")[2].partition(", the ")[0] for remark in launches(plan)]
    assert places == ["lat 47.1234560, lon 8.1234560", "lat 47.1234660, lon 8.1234560"]


def test_a_stop_at_the_depot_is_a_flight_too() -> None:
    """Straight up and down: it needs its turn, and may be too high."""
    plan = plan_of([(0, 0), (100, 0)], [[0], [1]])
    assert launches(plan) == ["Launch one after the other, the longest route first: uav-2, uav-1."]
    assert any("Above 120 m" in remark and "uav-1" in remark for remark in remarks_on(plan, FlightOptions(130.0)))


def launches(plan: Plan) -> list[str]:
    return [remark for remark in remarks_on(plan) if remark.startswith("Launch")]


def test_reserve_and_review() -> None:
    plan = plan_of([(100, 0)], [[0]], Fleet((Uav("a", 1e6, reserve_percent=20), Uav("b", 1e6))))
    remarks = remarks_on(plan)
    assert remarks[0].startswith("No reserve is kept (b);") and remarks[-1] == REVIEW
    assert not any(
        "reserve" in remark for remark in remarks_on(plan_of([(1, 0)], [[0]], Fleet((Uav("a", 9, None, None, None, 5),))))
    )


def test_service_at_different_speeds() -> None:
    fleet = Fleet((Uav("a", 1e6, 5.0), Uav("b", 1e6, 20.0)))
    plan = plan_of([(100, 0)], [[0], []], fleet, service_s=[10])
    assert any("costs every UAV 20 m of its range" in remark for remark in remarks_on(plan))
    # 200 m at 5 m/s and 10 s of service: the time is that of the slow UAV, the range is charged at the speed of the fast one.
    assert (plan.routes[0].seconds, plan.routes[0].used_m) == (50.0, 400.0)
    assert not any("Speeds" in remark for remark in remarks_on(plan_of([(100, 0)], [[0], []], fleet)))


def test_tasks_that_must_be_served() -> None:
    plan = plan_of([(100, 0), (1, 1)], [[1]], must=[True, False])
    assert remarks_on(plan)[0] == "Not served, though it must be: t0."


def test_far_away() -> None:
    pytest.importorskip("pyproj")
    tasks = TaskList.of(["a", "b"], [(48.0, 8.0), (60.0, 9.0)], "wgs84", depot=(47.0, 8.0))
    near = make_plan(tasks, Fleet.of_equal(1, 1e7), Schedule([[0]]), "by hand")
    assert any("A leg of UAV uav-1 is 111 km long" in remark for remark in near.remarks)
    assert not any("plane" in remark for remark in near.remarks)
    # Along the radius the plane is right; across it, two places 13 degrees north of the depot seem farther apart.
    across = TaskList.of(["a", "b"], [(60.0, 0.0), (60.0, 16.0)], "wgs84", depot=(47.0, 8.0))
    far = make_plan(across, Fleet.of_equal(1, 1e7), Schedule([[0, 1]]), "by hand")
    assert any("up to 0." in remark and "% too long" in remark for remark in far.remarks)


def test_high_up() -> None:
    plan = plan_of([(100, 0), (0, 100), (50, 50)], [[0], [1], [2]], altitudes=np.array([np.nan, np.nan, 130]))
    assert not any("120 m" in remark for remark in remarks_on(plan))
    remarks = remarks_on(plan, FlightOptions(altitude_m=100, altitude_step_m=15))
    assert any(remark.endswith("permit: uav-3.") for remark in remarks)
    remarks = remarks_on(plan, FlightOptions(altitude_m=100, altitude_step_m=30))
    assert any(remark.endswith("permit: uav-2, uav-3.") for remark in remarks)


def test_names_that_are_too_many_or_hostile() -> None:
    assert named(["a", "b", "c"], 2) == "a, b and 1 more"
    assert "\x1b" not in named(["\x1b[31mred"])


def test_notes_of_the_file_are_told() -> None:
    assert "Mind the height." in remarks_on(plan_of([(1, 0)], [[0]], notes=("Mind the height.",)))

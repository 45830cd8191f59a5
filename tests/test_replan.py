"""Replanning: UAVs in the air, tasks done, UAVs lost, new tasks; what need not change stays."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.plan_file import plan_from_json, plan_to_json
from sb3_uav.missions.problem import make_instance
from sb3_uav.missions.replan import Replanned, replan
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.status import NewTask, Status, UavReport
from sb3_uav.missions.tasks import TaskList

pytest.importorskip("numba")


def line_plan(*routes, ranges=None, values=None, reserve=0.0, must=None, n_tasks=None) -> Plan:
    """Task ``t3`` is at (3, 0): a line of tasks, the depot at 0."""
    n_tasks = max((task for route in routes for task in route), default=0) if n_tasks is None else n_tasks
    tasks = TaskList.of(
        [f"t{x}" for x in range(1, n_tasks + 1)],
        [(float(x), 0.0) for x in range(1, n_tasks + 1)],
        "plane",
        values,
        must=must,
        depot=(0.0, 0.0),
    )
    ranges = [100.0] * len(routes) if ranges is None else ranges
    uavs = tuple(Uav(name, reach, 1.0, reserve_percent=reserve) for name, reach in zip("abcd", ranges, strict=False))
    return make_plan(tasks, Fleet(uavs), Schedule([[task - 1 for task in route] for route in routes]), "by hand")


def stops(plan: Plan) -> dict[str, list[str]]:
    return {route.uav.id: [plan.tasks.ids[task] for task in route.stops] for route in plan.routes}


def check(found: Replanned) -> None:
    """Feasible by the checker, in the problem that the plan itself describes."""
    plan = found.plan
    schedule = Schedule([route.stops for route in plan.routes])
    report = check_schedule(make_instance(plan.tasks, plan.fleet), 0, schedule)
    assert (report.objective, report.unserved) == (plan.objective, plan.unserved)
    assert 0 <= found.n_kept <= found.n_remaining
    assert 0.0 <= found.kept_share <= 1.0


def test_without_news_the_plan_stays():
    plan = line_plan([1, 3], [2, 4])
    for status in (
        Status(),
        Status(uavs=(UavReport("a", (0.0, 0.0), 100.0),)),
        Status(uavs=(UavReport("a", None, 100.0, "percent"),)),
    ):
        found = replan(plan, status, 0.0)
        assert found.plan is plan
        assert (found.kept_share, found.n_remaining, found.unchanged) == (1.0, 6, ("a", "b"))
    assert "taken to be where their routes begin, with the range planned there: b." in found.remarks[0]


def test_a_uav_in_the_air_flies_on_from_where_it_is():
    plan = line_plan([1, 2, 3], reserve=10.0)
    found = replan(plan, Status(uavs=(UavReport("a", (1.5, 0.0), 60.0),), done=("t1",)), 0.0)
    check(found)
    (route,) = found.plan.routes
    assert stops(found.plan) == {"a": ["t2", "t3"]}
    assert list(route.legs_m) == [0.5, 1.0, 3.0]
    # The reserve is 10 % of the 100 m that it had, not of the 60 m that are left.
    assert (route.uav.range_m, route.uav.full_range_m) == (60.0, 100.0)
    assert route.uav.usable_m == pytest.approx(50.0)
    # From where it is to t2, from t2 to t3, from t3 to the end; the leg from t1 to t2 is over.
    assert (found.n_kept, found.n_remaining, found.method) == (3, 3, "kept")
    assert (found.gone, found.unchanged, found.removed) == (("t1",), ("a",), ())


@pytest.mark.parametrize(("unit", "number"), [("m", 60.0), ("percent", 60.0), ("min", 1.0)])
def test_units_of_what_remains(unit, number):
    plan = line_plan([1])
    found = replan(plan, Status(uavs=(UavReport("a", (1.0, 1.0), number, unit),)), 0.0)
    assert found.plan.routes[0].uav.range_m == 60.0
    # A percentage is one of the whole range, also of a UAV that has been replanned before.
    again = replan(found.plan, Status(uavs=(UavReport("a", (1.0, 2.0), 30.0, "percent"),)), 0.0)
    assert again.plan.routes[0].uav.range_m == 30.0


@pytest.mark.parametrize(
    ("gone", "n_remaining"),
    [
        # From the start to t1 and on to t2; over again to t3, from where the UAV flies to its end.
        (("t3",), 2),
        # To t1, and from t3 to the end.
        (("t2",), 2),
        # From where it is to t2, on to t3, to the end.
        (("t1",), 3),
        # Only the flight to the end.
        (("t1", "t2", "t3"), 1),
    ],
)
def test_legs_of_tasks_that_are_done_do_not_count(gone, n_remaining):
    plan = line_plan([1, 2, 3], n_tasks=4, ranges=[6.0])
    found = replan(plan, Status(uavs=(UavReport("a", (0.0, 0.5), 3.2 if len(gone) == 3 else 6.0),), done=gone), 0.0)
    check(found)
    assert found.n_remaining == n_remaining


def test_more_than_the_whole_range_is_not_believed():
    found = replan(line_plan([1]), Status(uavs=(UavReport("a", (0.0, 0.5), 120.0),)), 0.0)
    assert found.plan.fleet.uavs[0].range_m == 100.0
    assert found.remarks[0] == "UAV a reports 120 m, more than its whole range; 100 m are assumed."


def test_what_the_range_no_longer_admits_is_left_out():
    # 12 m to t6 and back. With 11 m left, a detour must go: t6, which is worth most but must not be; t5 must.
    plan = line_plan([5, 6], values=[1, 1, 1, 1, 1, 9], must=[False] * 4 + [True, False])
    found = replan(plan, Status(uavs=(UavReport("a", None, 11.0),)), 0.0)
    check(found)
    assert stops(found.plan)["a"][-1] == "t5" and "t6" not in stops(found.plan)["a"]
    assert found.removed == ("t6",)
    # The tasks on the way fit.
    assert found.plan.n_served == 5


def test_least_value_for_its_range_goes_first():
    tasks = TaskList.of(["near", "far", "up"], [(1.0, 0.0), (10.0, 0.0), (1.0, 6.0)], "plane", [1, 5, 2], depot=(0.0, 0.0))
    plan = make_plan(tasks, Fleet((Uav("a", 40.0),)), Schedule([[2, 0, 1]]), "by hand")
    assert stops(replan(plan, Status(uavs=(UavReport("a", None, 20.5),)), 0.0).plan) == {"a": ["near", "far"]}


def test_tasks_of_a_lost_uav_are_free():
    plan = line_plan([1, 2], [3, 4])
    found = replan(plan, Status(lost=("a",)), 0.0)
    check(found)
    assert [uav.id for uav in found.plan.fleet] == ["b"]
    assert sorted(stops(found.plan)["b"]) == ["t1", "t2", "t3", "t4"]
    assert (found.lost, found.freed, found.removed) == (("a",), ("t1", "t2"), ())
    # Only legs of UAVs that fly count: from the start to t3 is not kept, t3 to t4 and to the end are.
    assert (found.n_kept, found.n_remaining, found.method) == (2, 3, "insertion")
    # UAV b keeps its altitude.
    assert [found.plan.fleet.level_of(place) for place in range(1)] == [1]


def test_insertion_comes_first_and_more_change_only_for_more_value():
    tasks = TaskList.of(["e", "w", "n"], [(10.0, 0.0), (-10.0, 0.0), (0.0, 9.0)], "plane", [2, 2, 1], depot=(0.0, 0.0))
    plan = make_plan(tasks, Fleet((Uav("a", 20.0), Uav("b", 20.0))), Schedule([[0], [1]]), "by hand")
    small = NewTask("s", (0.0, -5.0), 1.0)
    found = replan(plan, Status(tasks=(small,)), 0.05)
    assert (found.method, found.kept_share, stops(found.plan)) == ("kept", 1.0, {"a": ["e"], "b": ["w"]})
    dear = NewTask("s", (0.0, -5.0), 2.5)
    found = replan(plan, Status(tasks=(dear,)), 0.05)
    check(found)
    assert (found.method, found.plan.objective, found.kept_share) == ("repair", 4.5, 0.5)
    assert any("a value of 4.5 in place of 4;" in remark for remark in found.remarks)
    calm = replan(plan, Status(tasks=(dear,)), 0.05, min_gain=15.0)
    assert calm.method == "kept"
    forgone = "Changing routes further would serve a value of 4.5 in place of 4; --min-gain 0 does so."
    assert forgone in calm.remarks and forgone not in found.remarks
    # What must be served counts whatever its value.
    urgent = NewTask("s", (0.0, -5.0), 0.0, must=True)
    found = replan(plan, Status(tasks=(urgent,)), 0.05, min_gain=15.0)
    assert (found.plan.unserved, found.plan.objective) == ((), 2.0)
    assert any("for 1 more task that must be served" in remark for remark in found.remarks)


def test_dropped_and_unplanned_tasks():
    plan = line_plan([1, 3], n_tasks=4, ranges=[6.0])
    found = replan(plan, Status(dropped=("t3",), done=("t4",)), 0.0)
    check(found)
    assert sorted(stops(found.plan)["a"]) == ["t1", "t2"]
    assert found.gone == ("t3", "t4")
    assert found.plan.past_tasks == ("t3", "t4")


def test_the_reserve_takes_a_uav_home():
    plan = line_plan([1, 9], reserve=20.0)
    found = replan(plan, Status(uavs=(UavReport("a", (9.0, 0.0), 25.0),)), 0.0)
    check(found)
    assert found.plan.routes[0].length_m == 9.0
    assert any("UAV a flies straight to its end; it needs 4 m of its reserve for that." in remark for remark in found.remarks)


def test_a_uav_that_cannot_come_home_is_named_and_the_others_fly():
    plan = line_plan([8, 9], [1, 2])
    found = replan(plan, Status(uavs=(UavReport("a", (9.0, 0.0), 2.0),), done=("t8",)), 0.0)
    check(found)
    assert stops(found.plan)["a"] == []
    assert {"t1", "t2"} <= set(stops(found.plan)["b"])
    assert found.plan.remarks[0] == (
        "UAV a cannot reach the place where it has to land: it lacks 7 m of range, so that its route is empty. Act at once."
    )


def test_a_silent_uav_whose_tasks_are_done_is_pointed_out():
    found = replan(line_plan([1, 2], [3]), Status(done=("t1",), uavs=(UavReport("b", None, 90.0),)), 0.0)
    assert "UAV a has not reported, though of its route are done: t1." in found.remarks[0]
    assert "with the range planned there: a." in found.remarks[1]


def test_a_status_file_may_grow():
    plan = line_plan([1, 2], [3, 4])
    new = NewTask("n", (2.0, 1.0))
    status = Status(done=("t1",), lost=("b",), tasks=(new,), uavs=(UavReport("a", (1.0, 0.0), 90.0),))
    first = replan(plan, status, 0.0)
    stored = plan_from_json(plan_to_json(first.plan), "mission.json")
    second = replan(stored, status, 0.0)
    assert second.plan is stored
    third = replan(stored, Status((), ("t1", "n"), ("b",), (new,)), 0.0)
    check(third)
    assert third.gone == ("n",)
    assert third.plan.past_tasks == ("t1", "n")
    # The row of n is still there, and n is done.
    assert not replan(third.plan, Status((), ("t1", "n"), ("b",), (new,)), 0.0).added
    # A task that was done before it was planned.
    at_once = replan(plan, Status(done=("t1", "n"), tasks=(new,)), 0.0)
    assert (at_once.added, at_once.gone, at_once.plan.past_tasks) == ((), ("t1",), ("t1", "n"))


@pytest.mark.parametrize(
    ("status", "message"),
    [
        (Status(uavs=(UavReport("aa", None, 1.0),)), "uav aa: the plan has no UAV aa; did you mean a?"),
        (Status(lost=("zebra",)), "lost zebra: the plan has no UAV zebra; there are a, b."),
        (Status(done=("T1",)), "done T1: the plan has no task T1; did you mean t1?"),
        (Status(dropped=("x",)), "drop x: the plan has no task x; there are t1, t2, t3, t4."),
        (Status(lost=("a", "b")), "all 2 UAVs are lost; nobody is left to fly"),
        (Status(done=("t1", "t2", "t3", "t4")), "no task is left"),
        (Status(uavs=(UavReport("a", None, 0.0), UavReport("b", None, 0.0))), "no UAV has any range left"),
        (Status(lost=("a",), uavs=(UavReport("a", None, 1.0),)), "uav a: UAV a is lost and yet reports"),
        (Status(uavs=(UavReport("a", None, 1.0),) * 2), "uav a: UAV a is named twice"),
        (Status(uavs=(UavReport("a", (1.0, math.nan), 1.0),)), "uav a: coordinates are 1, nan"),
        (Status(uavs=(UavReport("a", (1.0, 0.0)),)), "uav a: this says where UAV a is, but not how far"),
        (Status(uavs=(UavReport("a", None, -1.0),)), "uav a: UAV a still flies -1"),
        (Status(uavs=(UavReport("a", None, 201.0),)), "its whole range is 100 m; check the unit"),
        (Status(uavs=(UavReport("a", (9e5, 0.0), 1.0),)), "is 900 km from the depot; check x and y"),
        (Status(tasks=(NewTask("t1", (1.0, 1.0)),)), "task t1: the plan has another task t1 already"),
        (Status(tasks=(NewTask("n", (1.0, 1.0)),) * 2), "task n: task n is named twice"),
        (Status(tasks=(NewTask("n", (1.0, 1.0), -1.0),)), "task n: value is -1"),
        (Status(tasks=(NewTask("n", (1.0, 1.0), 1.0, math.inf),)), "task n: service_s is inf"),
        (Status(tasks=(NewTask("n", (1.0, 1.0), altitude_m=-5e3),)), "task n: alt_m is -5000"),
        (Status(tasks=(NewTask("n\x1b[31m", (1.0, 1.0)),)), "with a control character; remove it"),
        (
            Status(tasks=(NewTask("n", (1.0, 1.0)),), system="wgs84"),
            "coordinates are lat and lon, but those of the plan are x",
        ),
    ],
)
def test_a_status_that_does_not_fit(status, message):
    with pytest.raises(ValueError) as error:
        replan(line_plan([1, 3], [2, 4]), status, 0.0)
    assert str(error.value).startswith("status: ")
    assert message in str(error.value)


def test_a_stop_where_the_uav_stands_is_kept_too():
    """Its legs are 0 m long, but legs all the same."""
    tasks = TaskList.of(["here", "there"], [(0.0, 0.0), (5.0, 0.0)], "plane", depot=(0.0, 0.0))
    plan = make_plan(tasks, Fleet.of_equal(2, 100.0), Schedule([[0], [1]]), "by hand")
    found = replan(plan, Status(dropped=("there",)), 0.0)
    assert [route.stops for route in found.plan.routes] == [(0,), ()]
    assert (found.n_kept, found.n_remaining) == (2, 2)


def test_past_names_and_options_are_checked():
    plan = replan(line_plan([1, 2], [3]), Status(lost=("b",), done=("t1",)), 0.0).plan
    with pytest.raises(ValueError, match="uav b: UAV b was lost before"):
        replan(plan, Status(uavs=(UavReport("b", None, 5.0),)), 0.0)
    with pytest.raises(ValueError, match="task t1: there was a task t1, done or dropped"):
        replan(plan, Status(tasks=(NewTask("t1", (1.0, 1.0)),)), 0.0)
    for time_limit, min_gain in ((math.nan, 0.0), (-1.0, 0.0), (0.0, math.inf)):
        with pytest.raises(ValueError, match="give a finite number, 0 or more"):
            replan(plan, Status(), time_limit, min_gain=min_gain)


def test_speeds_that_nobody_said():
    tasks = TaskList.of(["t1"], [(1.0, 0.0)], "plane", depot=(0.0, 0.0))
    plan = make_plan(tasks, Fleet((Uav("a", 9.0),)), Schedule([[0]]), "by hand")
    with pytest.raises(ValueError, match="task n: service_s is 3, but the plan does not say how fast UAV a flies"):
        replan(plan, Status(tasks=(NewTask("n", (1.0, 1.0), service_s=3.0),)), 0.0)
    with pytest.raises(ValueError, match="uav a: the plan does not say how fast UAV a flies"):
        replan(plan, Status(uavs=(UavReport("a", None, 1.0, "min"),)), 0.0)


def test_degrees():
    pytest.importorskip("pyproj")
    tasks = TaskList.of(["t1", "t2"], [(47.01, 8.0), (47.02, 8.0)], "wgs84", depot=(47.0, 8.0))
    plan = make_plan(tasks, Fleet((Uav("a", 9_000.0),)), Schedule([[0, 1]]), "by hand")
    found = replan(plan, Status(uavs=(UavReport("a", (47.015, 8.0), 5_000.0),), done=("t1",), system="wgs84"), 0.0)
    check(found)
    assert found.plan.routes[0].length_m == pytest.approx(3 * 555.9 + 1111.8, rel=1e-3)
    with pytest.raises(ValueError, match=r"8, 47\.01 is 5[0-9]{3} km from the depot; lat and lon look swapped"):
        replan(plan, Status(uavs=(UavReport("a", (8.0, 47.01), 5_000.0),)), 0.0)
    with pytest.raises(ValueError, match="lat is 95 and lon 8, which is out of range"):
        replan(plan, Status(uavs=(UavReport("a", (95.0, 8.0), 5_000.0),)), 0.0)


POINTS = st.tuples(st.integers(-8, 8), st.integers(-8, 8)).map(lambda point: (float(point[0]), float(point[1])))


@st.composite
def small_plans(draw: st.DrawFn) -> Plan:
    points = draw(st.lists(POINTS, min_size=1, max_size=6))
    n_tasks = len(points)
    tasks = TaskList.of(
        range(n_tasks),
        points,
        "plane",
        draw(st.lists(st.sampled_from([0.0, 1.0, 2.0, 7.0]), min_size=n_tasks, max_size=n_tasks)),
        draw(st.lists(st.sampled_from([0.0, 2.0]), min_size=n_tasks, max_size=n_tasks)),
        draw(st.lists(st.booleans(), min_size=n_tasks, max_size=n_tasks)),
        depot=(0.0, 0.0),
    )
    uavs = tuple(
        Uav(name, draw(st.sampled_from([0.0, 9.0, 20.0, 60.0])), 1.0, draw(start), draw(start), draw(reserve))
        for start, reserve in [(st.none() | POINTS, st.sampled_from([0.0, 15.0]))]
        for name in "abc"[: draw(st.integers(1, 3))]
    )
    assume(any(uav.usable_m > 0 for uav in uavs))
    fleet = Fleet(uavs)
    routes: list[list[int]] = [[] for _ in uavs]
    # Any feasible plan, good or bad.
    for task in draw(st.permutations(range(n_tasks))):
        uav = draw(st.integers(0, len(uavs) - 1))
        routes[uav].append(task)
        try:
            make_plan(tasks, fleet, Schedule(routes), "")
        except ValueError:
            routes[uav].pop()
    return make_plan(tasks, fleet, Schedule(routes), "by hand")


@st.composite
def statuses(draw: st.DrawFn, plan: Plan) -> Status:
    ids, uavs = list(plan.tasks.ids), [uav.id for uav in plan.fleet]
    done = draw(st.lists(st.sampled_from(ids), unique=True))
    lost = draw(st.lists(st.sampled_from(uavs), unique=True, max_size=len(uavs) - 1)) if len(uavs) > 1 else []
    reports = [
        UavReport(uav.id, draw(POINTS), draw(st.floats(0, 1)) * uav.range_m)
        for uav in plan.fleet
        if uav.id not in lost and draw(st.booleans())
    ]
    new = [
        NewTask(f"new-{n}", draw(POINTS), draw(st.sampled_from([0.0, 1.0, 9.0])), draw(st.sampled_from([0.0, 3.0])), must)
        for n, must in enumerate(draw(st.lists(st.booleans(), max_size=3)))
    ]
    dropped = draw(st.lists(st.sampled_from([name for name in ids if name not in done] or ids), unique=True, max_size=2))
    return Status(tuple(reports), tuple(done), tuple(lost), tuple(new), tuple(dropped))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_status_of_any_plan(data):
    plan = data.draw(small_plans())
    status = data.draw(statuses(plan))
    try:
        found = replan(plan, status, 0.0)
    except ValueError as error:
        assert "no task is left" in str(error) or "no UAV has any range left" in str(error)
        return
    check(found)
    gone = {*status.done, *status.dropped}
    served = [name for names in stops(found.plan).values() for name in names]
    assert not gone & {*served, *found.plan.tasks.ids}
    assert not set(status.lost) & set(stops(found.plan))
    assert len(served) == len(set(served))
    assert set(found.plan.tasks.ids) == {*plan.tasks.ids, *(task.id for task in status.tasks)} - gone
    if not status.lost and not status.uavs:
        # Everybody is where the plan says, so that nothing has to be left out.
        planned = {name for names in stops(plan).values() for name in names} - gone
        left = found.plan.tasks
        missed = sum(bool(must) and name not in planned for name, must in zip(left.ids, left.must, strict=True))
        value = sum(value for name, value in zip(left.ids, left.values, strict=True) if name in planned)
        assert (len(found.plan.unserved), -found.plan.objective) <= (missed, -value)
    again = replan(found.plan, Status(), 0.0)
    assert again.plan is found.plan and again.kept_share == 1.0
    # Nor do the same news twice change anything.
    assert stops(replan(found.plan, status, 0.0).plan) == stops(found.plan)


def test_time_limit_is_for_search_only_where_something_is_left(monkeypatch):
    from sb3_uav.local_search.search import LocalSearch

    def fail(*_: object) -> None:
        raise AssertionError("searched for a plan that serves more than everything")

    monkeypatch.setattr(LocalSearch, "improve", fail)
    monkeypatch.setattr(LocalSearch, "repair", fail)
    found = replan(line_plan([1, 2], [3, 4]), Status(lost=("a",)), 5.0)
    assert found.plan.n_served == 4
    assert np.all(found.plan.tasks.values == 1)

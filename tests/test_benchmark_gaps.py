"""Gaps to best-known values, and OPLib's rule for lengths."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from brute_force import largest_value
from evaluation_helpers import Stub
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.envs import Instances, Schedule, check_schedule
from sb3_uav.envs.schedule import InfeasibleScheduleError
from sb3_uav.evaluation import evaluate
from sb3_uav.evaluation.benchmarks.gaps import GapRow, failures, find_gaps, gap_to
from sb3_uav.evaluation.benchmarks.instance import BenchmarkInstance
from sb3_uav.evaluation.benchmarks.report import markdown_table, report
from sb3_uav.evaluation.benchmarks.rounding import check_rounded, fill, fit_to_rule, rounded_distance
from sb3_uav.evaluation.benchmarks.summary_file import omissions, repairs


def test_halves_are_rounded_up() -> None:
    """As TSPLIB's nint does; Python's round takes the even neighbor."""
    assert [rounded_distance((0, 0), (x, 0)) for x in (0.49, 0.5, 1.5, 2.5, 2.4)] == [0, 1, 2, 3, 2]


def rounded_length(instance: Instances, route: tuple[int, ...]) -> int:
    depot, tasks = instance.depot[0].tolist(), instance.tasks[0].tolist()
    return sum(int(math.dist(a, b) + 0.5) for a, b in pairwise([depot, *(tasks[task] for task in route), depot]))


@given(st.integers(1, 12), st.integers(0, 2**31), st.floats(1, 60))
def test_fitted_tours_are_feasible_by_both_rules(n_tasks: int, seed: int, limit: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 12, (n_tasks + 1, 2))
    order = rng.permutation(n_tasks).tolist()
    instance = Instances.from_arrays(points[0], points[1:], rng.integers(0, 9, n_tasks), limit, 1)
    # As long as a solver could have found it.
    while order:
        try:
            check_schedule(instance, 0, Schedule([order]))
            break
        except InfeasibleScheduleError:
            order.pop()
    given_tour = Schedule([order])
    fitted = fit_to_rule(instance, given_tour)
    (route,) = fitted.routes
    assert set(route) <= set(order) and rounded_length(instance, route) <= limit
    report, rounded = check_schedule(instance, 0, fitted), check_rounded(instance, fitted)
    assert rounded.lengths == (rounded_length(instance, route),) and rounded.objective == report.objective
    if rounded_length(instance, tuple(order)) <= limit:
        assert fitted == given_tour


def on_a_line(places: list[float], values: list[float], limit: float) -> Instances:
    return Instances.from_arrays([0.0, 0.0], [[x, 0.0] for x in places], values, limit, 1)


# Places, values and the limit.
ROUNDED_UP = ([0.5, 0.5, -0.5], [9.0, 2.0, 4.0], 2.5)


def test_the_least_valuable_task_that_is_enough_goes() -> None:
    # Edges of 0.5 count 1. Two tasks are in one place, so that leaving out only one of them saves nothing.
    instance = on_a_line(*ROUNDED_UP)
    tour = Schedule([[0, 1, 2]])
    assert check_schedule(instance, 0, tour).length == 2.0
    with pytest.raises(InfeasibleScheduleError, match=r"UAV 0 flies 3 by the rounded lengths, more than 2\.5"):
        check_rounded(instance, tour)
    fitted = fit_to_rule(instance, tour)
    assert fitted.routes == ((0, 1),) and check_rounded(instance, fitted).objective == 11.0
    # Here either is enough.
    assert fit_to_rule(on_a_line([0.5, -0.5], [9.0, 4.0], 2.5), Schedule([[0, 1]])).routes == ((0,),)
    assert fit_to_rule(on_a_line([0.5, -0.5], [4.0, 9.0], 2.5), Schedule([[0, 1]])).routes == ((1,),)


def test_another_order_can_be_enough() -> None:
    """Of two orders that are equally long, the rule prefers one."""
    found = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        points = rng.integers(0, 9, (6, 2))
        tour = rng.permutation(5).tolist()
        long = Instances.from_arrays(points[0], points[1:], np.ones(5), 1000.0, 1)
        euclidean = check_schedule(long, 0, Schedule([tour])).length
        instance = replace(long, max_distance=long.max_distance * 0 + euclidean + (0.01, 0.3)[seed % 2])
        fitted = fit_to_rule(instance, Schedule([tour]))
        found += fitted.n_visited == 5 and list(fitted.routes[0]) != tour
        check_rounded(instance, fitted)
        check_schedule(instance, 0, fitted)
    assert found > 5


@given(st.integers(1, 12), st.integers(0, 2**31), st.floats(1, 60))
def test_filled_tours_are_feasible_by_the_rule(n_tasks: int, seed: int, limit: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 12, (n_tasks + 1, 2))
    instance = Instances.from_arrays(points[0], points[1:], rng.integers(0, 9, n_tasks), limit, 1)
    before = Schedule([[]])
    filled = fill(instance, before)
    objective = check_rounded(instance, filled).objective
    # No valuable task is left that alone would have fitted.
    values = instance.values[0].tolist()
    alone = [values[task] for task in range(n_tasks) if rounded_length(instance, (task,)) <= limit]
    assert objective >= max(alone, default=0.0) > 0 or objective == 0 == max(alone, default=0.0)
    again = fill(instance, filled)
    assert check_rounded(instance, again).objective == objective


def test_rounding_can_leave_room() -> None:
    # Edges of 1.4 count 1.
    instance = on_a_line([1.4, 2.8], [5.0, 3.0], 4.0)
    with pytest.raises(InfeasibleScheduleError):
        check_schedule(instance, 0, Schedule([[0, 1]]))
    filled = fill(instance, Schedule([[0]]))
    # There 1, on 1, back 3: too long.
    assert filled.routes == ((0,),)
    shorter = on_a_line([1.4, -1.4], [5.0, 3.0], 5.0)
    assert sorted(fill(shorter, Schedule([[0]])).routes[0]) == [0, 1]
    with pytest.raises(InfeasibleScheduleError, match=r"flies 5\.6"):
        check_schedule(shorter, 0, fill(shorter, Schedule([[0]])))


def test_another_order_must_not_be_too_long_without_rounding() -> None:
    tasks = [[3, 7], [3, 7], [3, 6], [8, 0], [5, 6]]
    # As given it is 20.538 long, 21 by the rule; the other way round through the last four 20.583, and 20 by the rule.
    instance = Instances.from_arrays([2.0, 8.0], tasks, np.ones(5), 20.55, 1)
    fitted = fit_to_rule(instance, Schedule([[0, 1, 2, 3, 4]]))
    check_schedule(instance, 0, fitted)
    check_rounded(instance, fitted)
    roomy = replace(instance, max_distance=instance.max_distance + 0.1)
    assert fit_to_rule(roomy, Schedule([[0, 1, 2, 3, 4]])).routes == ((0, 4, 3, 2, 1),)


@pytest.mark.parametrize("routes", [[[0], [1]], [[0, 0]], [[2]], [[-1]]])
def test_the_rule_refuses_what_is_no_schedule(routes: list[list[int]]) -> None:
    with pytest.raises(InfeasibleScheduleError):
        check_rounded(on_a_line([1.0, 2.0], [1.0, 1.0], 9.0), Schedule(routes))


def test_gaps() -> None:
    assert gap_to(50, 40) == 20 and gap_to(50, 60) == -20 and gap_to(0, 0) == 0 and gap_to(0, 5) == 0


class Told(Stub):
    """Returns a route for each instance."""

    name = "told"

    def __init__(self, routes: list[list[int]]) -> None:
        self.each = iter(routes)

    def solve(self, instances, time_limit=None, seed=0):
        self.routes = [next(self.each)]
        return super().solve(instances, time_limit, seed)


def benchmark(instance: Instances, name: str, is_rounded: bool = False) -> BenchmarkInstance:
    return BenchmarkInstance(name, name[0], Path(name), instance, tuple(range(2, instance.n_tasks + 2)), is_rounded)


def test_results_become_gaps(tmp_path: Path) -> None:
    line = on_a_line(*ROUNDED_UP)
    best = largest_value(line)
    assert best == 15
    members = [benchmark(line, name, name == "b.rounded") for name in ("a.best", "a.less", "b.rounded", "b.long", "b.unknown")]
    routes = [[0, 1, 2], [0, 1], [0, 1, 2], [2, 0, 2], []]
    sources = {member.name: member.instances for member in members}
    evaluate([Told(routes)], sources, tmp_path)
    known = {"a.best": best, "a.less": 22.0, "b.rounded": 10.0, "b.long": 5.0}
    rows, lines = find_gaps(tmp_path, members, known)
    found = {row.instance: row for row in rows}
    assert (found["a.best"].gap, found["a.best"].reached, found["a.best"].better) == (0, True, False)
    assert (found["a.less"].gap, found["a.less"].reached, found["a.less"].better) == (50, False, False)
    rounded = found["b.rounded"]
    assert (rounded.objective, rounded.euclidean_objective, rounded.n_dropped, rounded.length) == (11, 15, 1, 2)
    assert (rounded.gap, rounded.reached, rounded.better) == (-10, True, True)
    long = found["b.long"]
    assert (long.status, long.objective, long.gap, long.reached) == ("infeasible", None, None, False)
    unknown = found["b.unknown"]
    assert (unknown.status, unknown.objective, unknown.best_known, unknown.gap, unknown.reached) == (
        "ok",
        0,
        None,
        None,
        False,
    )
    # The numbers in the file.
    assert [line["routes"] for line in lines] == [[[2, 3, 4]], [[2, 3]], [[2, 3]], [[]]]
    assert failures(rows) == [f"told was infeasible on b.long: {long.message}"] and "visited twice" in long.message
    summary = {row.group: row for row in report(rows)}
    assert list(summary) == ["a", "b", "all"]
    assert (summary["a"].gap, summary["a"].n_reached, summary["a"].n_results) == (25, 1, 2)
    whole = summary["all"]
    assert (whole.n_results, whole.n_known, whole.n_compared) == (5, 4, 3)
    assert (whole.n_reached, whole.n_better, whole.n_infeasible) == (2, 1, 1)
    assert whole.gap == pytest.approx(40 / 3) and whole.seconds == 0.5
    assert "| all | told | 13.33* | 2/4 | 1 | 1 | 0.500 |" in markdown_table(report(rows))


def test_depot_and_room_count(tmp_path: Path) -> None:
    line = on_a_line([1.4, -1.4], [5.0, 3.0], 5.0)
    member = replace(benchmark(line, "a.1", True), depot_score=2.0)
    evaluate([Told([[0]])], {"a": line}, tmp_path)
    ((row,), (route,)) = find_gaps(tmp_path, [member], {"a.1": 10.0})
    assert (row.objective, row.euclidean_objective, row.gap, row.n_added, row.length) == (7, 7, 30, 0, 2)
    ((row,), (route,)) = find_gaps(tmp_path, [member], {"a.1": 10.0}, use_rounding=True)
    assert (row.objective, row.euclidean_objective, row.gap, row.n_added, row.length) == (10, 7, 0, 1, 5)
    assert row.reached and not row.better and sorted(route["routes"][0]) == [2, 3]
    assert repairs([row]) == ["told: by the rounding rule 1 task could be put into 1 of its tours."]


def test_no_value_makes_up_for_what_must_be_served(tmp_path: Path) -> None:
    plain = on_a_line([0.5, 0.6, -0.5], [9.0, 9.0, 1.0], 2.5)
    line = replace(plain, must_serve=plain.values < 2)
    members = [benchmark(line, "a.left"), benchmark(line, "a.done"), benchmark(plain, "a.plain")]
    evaluate([Told([[0, 1], [0, 2], [0, 1]])], {member.name: member.instances for member in members}, tmp_path)
    rows, lines = find_gaps(tmp_path, members, dict.fromkeys(("a.left", "a.done", "a.plain"), 10.0))
    assert [row.unserved for row in rows] == [1, 0, 0]
    assert [(row.reached, row.better) for row in rows] == [(False, False), (True, False), (True, True)]
    assert [row.gap for row in rows] == [-80, 0, -80]
    # By its number in the file.
    assert lines[0]["unserved"] == [4] and "unserved" not in lines[1]
    (said,) = omissions(rows)
    assert said.startswith("told: 1 of 3 results leave out tasks that must be served") and "gaps.csv" in said


def test_several_limits_count_once_among_failures() -> None:
    row = GapRow("x.1", "x", "s", 1.0, 0, "failed", 5.0, None, None, False, False, None, None, 0, 0, None, None, "no way")
    rows = [row, replace(row, time_limit=2.0), replace(row, instance="x.2")]
    assert failures(rows) == ["s failed on 2 instances (x.1 to x.2): no way"]


def test_a_pipe_in_a_name_stays_in_its_cell() -> None:
    row = GapRow("x.1", "x", "a|b", None, 0, "ok", 5.0, 5.0, 0.0, True, False, 1.0, 5.0, 0, 0, 1.0, 1, "")
    assert markdown_table(report([row]))[-1].startswith("| a\\|b |")

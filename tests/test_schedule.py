"""Schedules, and the checker that every producer of schedules must pass."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import math
from dataclasses import fields
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from conftest import instance_batches, seeds
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sb3_uav.envs import InfeasibleScheduleError, Instances, Schedule, ScheduleReport, check_schedule
from sb3_uav.envs import schedule as schedule_module
from sb3_uav.envs.schedule import _schedule_from_json, schedule_to_json


@pytest.fixture
def square() -> Instances:
    """
    Two instances. In the second the depot is in a corner of a 3 by 4 rectangle, tasks 0 to 2 in the other corners, task 3 at
    the depot, and slot 4 is padding; D = 12 is the length of a tour along three corners' two sides and the diagonal.
    """
    return Instances.from_arrays(
        depot=[[9.0, 9.0], [0.0, 0.0]],
        tasks=[[[9.0, 9.0]] * 5, [[3.0, 0.0], [3.0, 4.0], [0.0, 4.0], [0.0, 0.0], [0.0, 0.0]]],
        values=[[1.0] * 5, [1.0, 2.5, 4.0, 0.0, 100.0]],
        max_distance=[1.0, 12.0],
        n_uavs=2,
        task_mask=[[True] * 5, [True] * 4 + [False]],
    )


# The checker


@pytest.mark.parametrize(
    ("routes", "objective", "lengths"),
    [
        ([], 0.0, ()),
        ([[], []], 0.0, (0.0, 0.0)),
        ([[0]], 1.0, (6.0,)),
        ([[0, 1]], 3.5, (12.0,)),
        ([[1, 0]], 3.5, (12.0,)),
        ([[2, 1], [3, 0]], 7.5, (12.0, 6.0)),
        ([[3], [1]], 2.5, (0.0, 10.0)),
    ],
)
def test_objective_and_lengths(
    square: Instances, routes: list[list[int]], objective: float, lengths: tuple[float, ...]
) -> None:
    """By hand: legs of 3, 4 and 5. A tour of exactly D is feasible, and not every UAV needs to fly."""
    report = check_schedule(square, 1, Schedule(routes))
    assert report == ScheduleReport(objective, lengths)
    assert report.length == sum(lengths)


@pytest.mark.parametrize(
    ("routes", "message"),
    [
        ([[0], [1], [2]], r"^3 routes for a fleet of 2 UAVs\.$"),
        ([[], [], []], r"^3 routes for a fleet of 2 UAVs\.$"),
        ([[0], [5]], r"^UAV 1 visits task 5, but tasks are numbered 0 to 3\.$"),
        ([[4]], r"^UAV 0 visits task 4, but tasks are numbered 0 to 3\.$"),
        ([[-1]], r"^UAV 0 visits task -1, but"),
        ([[0, 0]], r"^Task 0 is visited twice, by UAV 0 and UAV 0\.$"),
        ([[3, 0], [1, 3]], r"^Task 3 is visited twice, by UAV 0 and UAV 1\.$"),
        ([[0], [0, 1, 2]], r"^Task 0 is visited twice, by UAV 0 and UAV 1\.$"),
        ([[0], [1, 2, 3]], None),
        ([[], [0, 1, 2]], r"^UAV 1 flies 14\.000000000, which is 2 over its maximum of 12\.000000000\.$"),
        ([[0, 2]], None),
        ([[0, 2, 1]], r"^UAV 0 flies 16\.000000000, which is 4 over its maximum of 12\.000000000\.$"),
    ],
)
def test_each_constraint_has_its_message(square: Instances, routes: list[list[int]], message: str | None) -> None:
    """Cases without a message are feasible schedules similar to the infeasible ones."""
    if message is None:
        check_schedule(square, 1, Schedule(routes))
    else:
        with pytest.raises(InfeasibleScheduleError, match=message):
            check_schedule(square, 1, Schedule(routes))


def test_the_row_counts(square: Instances) -> None:
    """What is feasible in one instance is checked against that instance only."""
    everything = Schedule([[0, 1, 2, 3, 4], []])
    assert check_schedule(square, 0, everything) == ScheduleReport(5.0, (0.0, 0.0))
    with pytest.raises(InfeasibleScheduleError):
        check_schedule(square, 1, everything)
    with pytest.raises(IndexError):
        check_schedule(square, 2, everything)


def test_infeasible_is_a_value_error() -> None:
    assert issubclass(InfeasibleScheduleError, ValueError)


@pytest.mark.parametrize("excess", [-1e-3, 0.0, 2.5e-10, 1e-9, 1e-3])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_tolerance_is_relative_to_the_maximum(excess: float, scale: float) -> None:
    """Half a billionth of D, whatever the unit of the coordinates."""
    instances = Instances.from_arrays([0, 0], [[scale * (1 + excess), 0]], max_distance=2 * scale)
    if excess > 5e-10:
        with pytest.raises(InfeasibleScheduleError, match=r"UAV 0 flies .* over its maximum"):
            check_schedule(instances, 0, Schedule([[0]]))
    else:
        assert check_schedule(instances, 0, Schedule([[0]])).length == pytest.approx(2 * scale * (1 + excess), rel=1e-13)


def exact_length(instances: Instances, row: int, route: list[int]) -> Fraction:
    """Length of a tour in rational arithmetic, each leg's root to 200 bits."""

    def point(coordinates: list[float]) -> tuple[Fraction, Fraction]:
        return Fraction(coordinates[0]), Fraction(coordinates[1])

    depot, tasks = point(instances.depot[row].tolist()), [point(task) for task in instances.tasks[row].tolist()]
    stops = [depot, *(tasks[task] for task in route), depot]
    total = Fraction(0)
    for (ax, ay), (bx, by) in itertools.pairwise(stops):
        square = (ax - bx) ** 2 + (ay - by) ** 2
        total += Fraction(math.isqrt(int(square * 4**200)), 2**200)
    return total


@settings(max_examples=150)
@given(instances=instance_batches(max_batch=1), seed=seeds)
def test_agrees_with_exact_arithmetic(instances: Instances, seed: int) -> None:
    """Verdict, lengths and objective, of random disjoint routes."""
    rng = np.random.default_rng(seed)
    real = np.flatnonzero(instances.task_mask[0].numpy())
    chosen = rng.permutation(real)[: rng.integers(0, len(real) + 1)]
    cuts = np.sort(rng.integers(0, len(chosen) + 1, instances.n_uavs - 1))
    routes = [[int(task) for task in part] for part in np.split(chosen, cuts)]
    lengths = [exact_length(instances, 0, route) for route in routes]
    limit = Fraction(instances.max_distance[0].item()) * (1 + Fraction(1, 10**9))
    # Closer than this to the limit, rounding may decide.
    assume(all(abs(length - limit) > limit / 10**13 for length in lengths))
    if max(lengths) > limit:
        with pytest.raises(InfeasibleScheduleError, match="over its maximum"):
            check_schedule(instances, 0, Schedule(routes))
        return
    report = check_schedule(instances, 0, Schedule(routes))
    assert report.lengths == pytest.approx([float(length) for length in lengths], rel=1e-13, abs=0)
    assert report.objective == pytest.approx(sum(instances.values[0, task].item() for task in chosen))


def test_is_independent_of_the_dynamics() -> None:
    """Of this package it may use the data of the instances and the tolerance, but no function."""
    imported = set()
    for node in ast.walk(ast.parse(inspect.getsource(schedule_module))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sb3_uav"):
            imported |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names if alias.name.partition(".")[0] in ("sb3_uav", "torch", "numpy")}
    assert imported == {"sb3_uav.envs.instances.Instances", "sb3_uav.envs.distances.DISTANCE_TOLERANCE"}
    checker = ast.parse(inspect.getsource(check_schedule))
    attributes = [node for node in ast.walk(checker) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    used = {node.attr for node in attributes if isinstance(node.value, ast.Name) and node.value.id == "instances"}
    assert used == {field.name for field in fields(Instances)}


# Schedules and their lines of JSON


def test_schedules_are_plain_values() -> None:
    schedule = Schedule([np.array([2, 0]), (), [1]])
    assert schedule.routes == ((2, 0), (), (1,)) and {type(task) for route in schedule.routes for task in route} == {int}
    assert schedule == Schedule([[2, 0], [], [1]]) != Schedule([[2, 0], [1]])
    assert hash(schedule) == hash(Schedule([[2, 0], [], [1]]))
    assert schedule.n_visited == 3 and Schedule([]).n_visited == 0


@settings(max_examples=50)
@given(
    solver=st.text('ab é\n"λ', max_size=6),
    row=st.integers(0, 1000),
    routes=st.lists(st.lists(st.integers(0, 1500), max_size=4), max_size=4),
    objective=st.floats(0, 1e6),
)
def test_json_round_trip(solver: str, row: int, routes: list[list[int]], objective: float) -> None:
    schedule = Schedule(routes)
    record = schedule_to_json(solver, row, schedule, ScheduleReport(objective, (1.5, 2.0)))
    line = json.dumps(record)
    assert "\n" not in line
    assert json.loads(line) == {
        "solver": solver,
        "instance": row,
        "routes": routes,
        "objective": objective,
        "lengths": [1.5, 2.0],
    }
    assert _schedule_from_json(json.loads(line), "schedules.jsonl line 1") == (solver, row, schedule)


@pytest.mark.parametrize(
    "record",
    [None, [], "text", 3, {}, {"solver": "a", "instance": 0}, {"solver": "a", "routes": []}, {"instance": 0, "routes": []}],
)
def test_json_with_missing_fields(record: Any) -> None:
    with pytest.raises(ValueError, match=r"^s\.jsonl:7: a schedule needs the fields 'solver', 'instance' and 'routes', found"):
        _schedule_from_json(record, "s.jsonl:7")


@pytest.mark.parametrize(
    "changes",
    [
        {"routes": 3},
        {"routes": "12"},
        {"routes": ""},
        {"routes": {}},
        {"routes": [1, 2]},
        {"routes": [[1], "2"]},
        {"routes": [[1.0]]},
        {"routes": [["1"]]},
        {"routes": [[True]]},
        {"routes": [[None]]},
        {"routes": [[[1]]]},
        {"instance": "0"},
        {"instance": 0.0},
        {"instance": True},
        {"instance": None},
    ],
)
def test_json_with_wrong_types(changes: dict[str, Any]) -> None:
    with pytest.raises(
        ValueError, match=r"^s\.jsonl:7: 'routes' must be lists of task indices and 'instance' an index, found"
    ):
        _schedule_from_json({"solver": "a", "instance": 0, "routes": [[1]], **changes}, "s.jsonl:7")

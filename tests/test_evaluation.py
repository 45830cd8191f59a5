"""Evaluations: what reaches the disk and when, failing solvers, time limits, arguments."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_helpers import Choosy, Limited, Nearest, Stub, Unlimited, contents, named, places, read_rows, read_schedules

from sb3_uav.common.files import file_hash
from sb3_uav.envs import Instances, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import _schedule_from_json
from sb3_uav.evaluation.results import RESULT_COLUMNS
from sb3_uav.evaluation.run import evaluate, find_reference
from sb3_uav.solvers import SolverResult, make_solver


@pytest.fixture
def easy() -> Instances:
    """Two instances of three tasks at the depot."""
    return Instances.from_arrays(np.zeros((2, 2)), np.zeros((2, 3, 2)), n_uavs=1)


# --------------------------------------------------------------------------------------------------------------- the files


def test_means_errors_and_times(tmp_path: Path) -> None:
    """Values count, not visits; a single instance has no standard error."""
    batch = Instances.from_arrays(
        np.zeros((3, 2)), np.full((3, 2, 2), 0.1), values=[[1.0, 5.0], [2.0, 5.0], [6.0, 5.0]], n_uavs=2
    )
    (row,) = evaluate([Stub([[0]])], batch, tmp_path)
    assert row.objective == 3.0 and row.standard_error == pytest.approx(math.sqrt(7) / math.sqrt(3))
    assert (row.n_instances, row.seconds, row.batch_size, row.violations, row.failures) == (3, 0.5, 3, (), ())
    (row,) = evaluate([Stub([[0]])], batch[:1], tmp_path)
    assert row.objective == 1.0 and math.isnan(row.standard_error)
    assert len(read_rows(tmp_path)) == 1


def test_infeasible_schedules_are_reported(tmp_path: Path) -> None:
    """A task visited twice, and a tour that is too long: said so, not counted, and the others are kept."""
    batch = Instances.from_arrays([[0.0, 0.0]] * 2, [[[0.1, 0.0], [0.2, 0.0]], [[0.1, 0.0], [3.0, 0.0]]], n_uavs=2)
    calls: list[tuple[str, int, int]] = []
    far, twice = named("far", Stub([[0, 1]])), named("twice", Stub([[0, 1], [1]]))
    summary = evaluate([far, twice], {"set": batch}, tmp_path, progress=lambda *call: calls.append(call))
    assert calls == [(f"{name} on set: 2 instances", done, 2) for name in ("far", "twice") for done in range(3)]
    assert summary[0].objective == 2.0 and summary[0].violations == (
        "far, instance 1 of set: UAV 0 flies 6.000000000, which is 4 over its maximum of 2.000000000.",
    )
    assert math.isnan(summary[1].objective) and len(summary[1].violations) == 2
    assert "Task 1 is visited twice, by UAV 0 and UAV 1" in summary[1].violations[0]
    rows, schedules = read_rows(tmp_path), read_schedules(tmp_path)
    assert [row["feasible"] for row in rows] == ["True", "False", "False", "False"]
    assert [row["status"] for row in rows] == ["ok", "infeasible", "infeasible", "infeasible"]
    assert [row["objective"] for row in rows] == ["2.0", "", "", ""] and rows[1]["length"] == ""
    routes = {"solver": "far", "instance": 1, "routes": [[0, 1]], "objective": None, "lengths": []}
    assert schedules[1] == {**routes, "time_limit": None, "seed": 0}


def test_every_column(instances: Instances, tmp_path: Path) -> None:
    """The first columns are those that other programs have always found there."""
    evaluate([Nearest(), Stub()], {"a": instances, "b, c": instances[:2]}, tmp_path, seed=3)
    rows = read_rows(tmp_path)
    assert list(rows[0]) == list(RESULT_COLUMNS)
    assert list(rows[0])[:8] == ["solver", "instance", "n_uavs", "n_tasks", "objective", "length", "seconds", "feasible"]
    assert [(row["solver"], row["source"], row["instance"]) for row in rows] == [
        (solver, source, str(i))
        for source, of in (("a", range(5)), ("b, c", range(5, 7)))
        for solver in ("nearest", "stub")
        for i in of
    ]
    for row, line in zip(rows, read_schedules(tmp_path), strict=True):
        _, index, schedule = _schedule_from_json(line, "schedules.jsonl")
        report = check_schedule(instances, index % 5, schedule)
        assert float(row["objective"]) == report.objective and float(row["length"]) == report.length
        batch_size = "1" if row["solver"] == "nearest" else {"a": "5", "b, c": "2"}[row["source"]]
        expected = dict(n_uavs="2", n_tasks="6", seed="3", time_limit="", status="ok", message="", batch_size=batch_size)
        assert {name: row[name] for name in expected} == expected
        assert row["bound"] == ("6.0" if row["solver"] == "nearest" else "")


def test_results_are_on_disk_as_soon_as_they_are_known(instances: Instances, tmp_path: Path) -> None:
    """Another process sees every result before the next instance is begun."""
    seen = []

    def look(text: str, n_done: int, n_total: int) -> None:
        seen.append((n_done, len(read_rows(tmp_path)), len(read_schedules(tmp_path))))
        assert (tmp_path / "evaluation.json").exists()

    evaluate([Nearest()], instances, tmp_path, progress=look)
    assert seen == [(i, i, i) for i in range(6)]


def test_what_was_evaluated_is_recorded(instances: Instances, tmp_path: Path) -> None:
    (tmp_path / "router.zip").write_bytes(b"abc")
    solver = make_solver("kmeans-nearest:restarts=2,name=K-means")
    solver.files = {"router": tmp_path / "router"}
    evaluate([solver, Stub()], {"a": instances}, tmp_path / "out", seed=4, reference="stub")
    told = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert told["instances"] == [{"name": "a", "n_instances": 5, "sha256": instances.digest()}]
    assert told["solvers"]["K-means"] == {
        "spec": "kmeans-nearest:restarts=2,name=K-means",
        "settings": {"spec": "kmeans-nearest:restarts=2,name=K-means"},
        "files": {"router": {"path": str(tmp_path / "router"), "sha256": file_hash(tmp_path / "router.zip")}},
    }
    assert file_hash(tmp_path / "router.zip") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    (run,) = told["runs"]
    assert (run["seed"], run["time_limits"], run["solvers"], run["n_jobs"]) == (4, [None], ["K-means", "stub"], 1)
    assert {"python", "sb3-uav", "torch", "numpy"} <= set(run["versions"])


def test_hash_of_instances(instances: Instances) -> None:
    assert instances.digest() == instances[:].digest() != instances[:4].digest()
    moved = Instances.from_arrays(instances.depot + 1e-12, instances.tasks, task_mask=instances.task_mask, n_uavs=2)
    assert moved.digest() != instances.digest()


# ---------------------------------------------------------------------------------------------------------------- failures


def test_failures_are_kept_and_tried_again(instances: Instances, tmp_path: Path) -> None:
    """A solver that fails on some instances does not disturb the others, or its own other instances."""
    broken = Nearest(places(instances)[1:3])
    stub, nearest = evaluate([Stub(), broken], {"a": instances}, tmp_path)
    assert stub.failures == () and stub.n_feasible == 5
    assert nearest.failures == ("nearest failed on 2 of 5 instances of a: RuntimeError: no way",)
    assert (nearest.n_feasible, nearest.n_paired, math.isnan(nearest.gap)) == (3, 3, True)
    rows = [row for row in read_rows(tmp_path) if row["solver"] == "nearest"]
    assert [row["status"] for row in rows] == ["ok", "failed", "failed", "ok", "ok"]
    assert rows[1]["message"] == "RuntimeError: no way" and rows[1]["feasible"] == "False"
    assert rows[1]["objective"] == rows[1]["seconds"] == rows[1]["bound"] == rows[1]["batch_size"] == ""
    assert len(read_schedules(tmp_path)) == 8

    # Other solvers' failures stay in the file.
    evaluate([Stub()], {"a": instances}, tmp_path, resume=True)
    assert [row["status"] for row in read_rows(tmp_path)].count("failed") == 2
    mended = Nearest()
    (again,) = evaluate([mended], {"a": instances}, tmp_path, resume=True)
    assert mended.solved == places(instances)[1:3] and again.n_feasible == 5
    evaluate([Stub(), Nearest()], {"a": instances}, tmp_path / "fresh")
    assert contents(tmp_path) == contents(tmp_path / "fresh")


def test_a_solver_that_refuses_a_set(instances: Instances, tmp_path: Path) -> None:
    """It is not asked to solve it; the other sets and solvers are evaluated."""
    large = UniformGenerator(4, n_uavs=3)(2, np.random.default_rng(0))
    summary = evaluate([Choosy(), Stub()], {"small": instances, "large": large}, tmp_path, reference="stub")
    assert [(row.solver, row.source, row.n_feasible) for row in summary] == [
        ("choosy", "small", 5),
        ("stub", "small", 5),
        ("choosy", "large", 0),
        ("stub", "large", 2),
    ]
    assert summary[2].failures == ("choosy failed on 2 of 2 instances of large: RuntimeError: the license is too small",)
    with pytest.raises(ValueError, match="large: choosy cannot solve these instances: RuntimeError: the license is too small"):
        evaluate([Choosy()], {"large": large}, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_batched_solvers_that_fail_half_way(instances: Instances, tmp_path: Path) -> None:
    class Torn(Stub):
        def solve_rows(self, instances: Instances, rows: Sequence[int], *_: Any, **__: Any) -> Any:
            yield from list(super().solve_rows(instances, rows))[:2]
            raise MemoryError("too many instances at once")

    class Lazy(Stub):
        def solve(self, *arguments: Any, **kwargs: Any) -> list[SolverResult]:
            return super().solve(*arguments, **kwargs)[:3]

    torn, lazy = evaluate([named("torn", Torn()), named("lazy", Lazy())], {"a": instances}, tmp_path)
    assert torn.n_feasible == 2
    assert torn.failures == ("torn failed on 3 of 5 instances of a: MemoryError: too many instances at once",)
    assert lazy.n_feasible == 0
    assert lazy.failures == ("lazy failed on 5 of 5 instances of a: lazy returned 3 results for 5 instances.",)


# ------------------------------------------------------------------------------------------------------------- time limits


def test_several_time_limits(easy: Instances, tmp_path: Path) -> None:
    """Each limit is a comparison of its own; a solver without one runs once and stands in all of them."""
    unlimited = Unlimited([[0, 1]])
    summary = evaluate([Limited(), unlimited], {"a": easy}, tmp_path, time_limits=(1, 3, 2))
    assert unlimited.calls == 1
    assert [(row.solver, row.time_limit, row.objective) for row in summary] == [
        (solver, limit, objective)
        for limit, found in ((1, 1.0), (3, 3.0), (2, 2.0))
        for solver, objective in (("limited", found), ("stub", 2.0))
    ]
    assert [row.gap for row in summary] == [50.0, 0.0, 0.0, pytest.approx(100 / 3), 0.0, 0.0]
    assert [row.difference for row in summary if row.solver == "stub"] == [1.0, -1.0, 0.0]
    rows = read_rows(tmp_path)
    assert [(row["solver"], row["time_limit"], row["objective"]) for row in rows if row["instance"] == "0"] == [
        ("limited", "1.0", "1.0"),
        ("limited", "2.0", "2.0"),
        ("limited", "3.0", "3.0"),
        ("stub", "", "2.0"),
    ]
    assert [line["time_limit"] for line in read_schedules(tmp_path)] == [1, 1, 2, 2, 3, 3, None, None]
    calls: list[tuple[str, int, int]] = []
    evaluate([Limited()], {"a": easy}, tmp_path, time_limits=(2.0,), resume=True, progress=lambda *call: calls.append(call))
    assert calls == [("limited on a: 2 instances, 2 s each, 2 of them done before", 2, 2)]


def test_no_time_at_all(easy: Instances, tmp_path: Path) -> None:
    """It is for the solver to say that this is too little; the others go on."""
    limited, stub = evaluate([Limited(), Unlimited([[0]])], {"a": easy}, tmp_path, time_limits=(0,))
    assert limited.failures == ("limited failed on 2 of 2 instances of a: limited needs a time limit above 0.",)
    assert stub.objective == 1.0


# --------------------------------------------------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(seed=-1), "The seed is -1; it must be at least 0"),
        (dict(n_jobs=0), "number of jobs is 0; give at least 1"),
        (dict(time_limits=(-1.0,)), r"A time limit is -1.0; it must be a number of seconds"),
        (dict(time_limits=(math.nan,)), "A time limit is nan"),
        (dict(time_limits=(1.0, math.inf)), "A time limit is inf"),
        (dict(time_limits=(1.0, 1)), "time limit 1.0 is given twice"),
        (dict(time_limits=()), "nothing to evaluate"),
        (dict(reference="b"), r"The reference 'b' is none of the solvers \['stub'\]"),
    ],
)
def test_wrong_arguments(kwargs: dict[str, Any], message: str, instances: Instances, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate([Stub()], instances, tmp_path / "out", **kwargs)
    assert not (tmp_path / "out").exists()


def test_wrong_solvers_and_sets(instances: Instances, tmp_path: Path) -> None:
    for solvers, sets, message in (
        ([], instances, "at least one solver"),
        ([Stub()], {}, "at least one solver and one set"),
        ([Stub(), Stub()], instances, "Solver 'stub' is given twice"),
        ([named("a\nb", Stub())], instances, r"The name 'a\\nb' breaks the line"),
        ([Stub()], {"a\r": instances}, r"The name 'a\\r' breaks the line"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate(solvers, sets, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_instances_that_nobody_checked(instances: Instances, tmp_path: Path) -> None:
    """The constructor of instances lets through what no sum can be made of."""
    huge = replace(instances, values=instances.values * 1e308)
    with pytest.raises(ValueError, match=r"^instances: field 'values' .* must be finite"):
        evaluate([Stub()], huge, tmp_path / "never")
    assert not (tmp_path / "never").exists()


def test_names_of_the_reference() -> None:
    solvers = [named(name, Stub()) for name in ("a", "b:x=1", "b:x=2", "c:y=3", "a:z=4")]
    assert find_reference(solvers, None) == "a"
    assert find_reference(solvers, "b:x=2") == "b:x=2"
    assert find_reference(solvers, "c") == "c:y=3"
    assert find_reference(solvers, "a") == "a"
    with pytest.raises(ValueError, match="'b' is several of the solvers"):
        find_reference(solvers, "b")

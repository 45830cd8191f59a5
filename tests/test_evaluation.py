"""Evaluations: what reaches the disk and when, going on after an interruption, failing solvers, parallel processes."""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_uav.common.files import file_hash
from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import schedule_from_json
from sb3_uav.evaluation import results
from sb3_uav.evaluation.parallel import Failure, Runner
from sb3_uav.evaluation.results import RESULT_COLUMNS, locked_folder
from sb3_uav.evaluation.run import evaluate, find_reference
from sb3_uav.evaluation.summary import SummaryRow
from sb3_uav.solvers import OneByOneSolver, Solution, Solver, SolverResult, make_solver


class Stub(Solver):
    """Returns the given routes for every instance."""

    name = "stub"

    def __init__(self, routes: Sequence[Sequence[int]] = ()) -> None:
        self.routes = routes

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [SolverResult(Schedule(self.routes), 0.5, len(instances)) for _ in range(len(instances))]


class Nearest(OneByOneSolver):
    """
    Visits one task, which depends on the random numbers.

    :param broken: Rows at which it raises ``error``, told by the coordinates of their depots
    """

    name = "nearest"

    def __init__(self, broken: Sequence[float] = (), error: BaseException | None = None) -> None:
        self.broken = broken
        self.error = error
        self.solved: list[float] = []

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        place = float(instance.depot[0, 0])
        if place in self.broken:
            raise self.error or RuntimeError("no\nway")
        self.solved.append(place)
        reachable = np.nonzero(instance.reachable()[0].numpy())[0]
        return Solution(Schedule([rng.choice(reachable, 1)]), bound=float(instance.n_tasks))


class Limited(OneByOneSolver):
    """Visits as many of three tasks at the depot as it has seconds, and refuses to work without any."""

    name = "limited"

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        if time_limit is None or time_limit <= 0:
            raise ValueError(f"{self.name} needs a time limit above 0.")
        return Solution(Schedule([range(round(time_limit))]))


class Unlimited(Stub):
    uses_time_limit = False
    calls = 0

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        assert time_limit is None
        self.calls += 1
        return super().solve(instances, time_limit, seed)


class Choosy(Stub):
    """Refuses fleets of more than two UAVs."""

    name = "choosy"

    def check(self, instances: Instances) -> None:
        if instances.n_uavs > 2:
            raise RuntimeError("the licence is too small")


class Mortal(OneByOneSolver):
    """Ends its process, or never ends, on instances whose depot lies at the given places."""

    name = "mortal"

    def __init__(self, deadly: Sequence[float] = (), endless: Sequence[float] = ()) -> None:
        self.deadly = deadly
        self.endless = endless

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        place = float(instance.depot[0, 0])
        if place in self.deadly:
            os._exit(1)
        while place in self.endless:
            time.sleep(1)
        return Solution(Schedule([[int(rng.integers(3))]]))


def places(instances: Instances) -> list[float]:
    return instances.depot[:, 0].tolist()


def named(name: str, solver: Solver) -> Solver:
    solver.name = name
    return solver


@pytest.fixture(scope="module")
def instances() -> Instances:
    return UniformGenerator(6, n_uavs=2)(5, np.random.default_rng(0)).pad(8)


@pytest.fixture
def easy() -> Instances:
    """Two instances of three tasks at the depot."""
    return Instances.from_arrays(np.zeros((2, 2)), np.zeros((2, 3, 2)), n_uavs=1)


def read_rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_schedules(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "schedules.jsonl").read_text().splitlines()]


def contents(folder: Path) -> tuple[str, str]:
    """Both files, without the seconds."""
    lines = [",".join({**row, "seconds": ""}.values()) for row in read_rows(folder)]
    return "\n".join(lines), (folder / "schedules.jsonl").read_text()


def figures(summary: list[SummaryRow]) -> list[list[Any]]:
    """What a summary says, without the seconds, and so that NaN equals itself."""
    return [[repr(value) for name, value in vars(row).items() if name != "seconds"] for row in summary]


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
        _, index, schedule = schedule_from_json(line, "schedules.jsonl")
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


# --------------------------------------------------------------------------------------------- interruptions, and going on


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit()])
def test_going_on_after_an_interruption(error: BaseException, instances: Instances, tmp_path: Path) -> None:
    """What was found before Ctrl-C is there; then only the rest is solved, and the files are those of an undisturbed run."""
    sets = {"a": instances[:3], "b": instances[3:]}
    undisturbed = evaluate([Stub(), Nearest()], sets, tmp_path / "whole", seed=1)
    with pytest.raises(type(error)):
        evaluate([Stub(), Nearest([places(instances)[2]], error)], sets, tmp_path / "halted", seed=1)
    assert [(row["solver"], row["instance"]) for row in read_rows(tmp_path / "halted")] == [
        *(("stub", str(i)) for i in range(3)),
        *(("nearest", str(i)) for i in range(2)),
    ]
    assert not (tmp_path / "halted" / "summary.csv").exists()
    solver = Nearest()
    calls: list[tuple[str, int, int]] = []
    summary = evaluate(
        [Stub(), solver], sets, tmp_path / "halted", seed=1, resume=True, progress=lambda *call: calls.append(call)
    )
    assert solver.solved == places(instances)[2:]
    assert calls[:3] == [
        ("stub on a: 3 instances, 3 of them done before", 3, 3),
        ("nearest on a: 3 instances, 2 of them done before", 2, 3),
        ("nearest on a: 3 instances, 2 of them done before", 3, 3),
    ]
    assert contents(tmp_path / "halted") == contents(tmp_path / "whole")
    assert figures(summary) == figures(undisturbed)
    assert json.loads((tmp_path / "halted" / "summary.json").read_text())["reference"] == "stub"


def test_a_later_crash_takes_the_old_summary_away(instances: Instances, tmp_path: Path) -> None:
    """It would tell of other results than the files beside it."""
    evaluate([Nearest()], instances, tmp_path)
    assert (tmp_path / "summary.json").exists()
    with pytest.raises(KeyboardInterrupt):
        evaluate([Nearest(places(instances), KeyboardInterrupt())], instances, tmp_path, seed=2, resume=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["evaluation.json", "results.csv", "schedules.jsonl"]


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_going_on_after_a_crash_at_any_byte(data: st.DataObject, instances: Instances, tmp_path: Path) -> None:
    """Whatever part of the two files reached the disk, the end is the same, and no whole result is thrown away."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    if not whole.exists():
        evaluate([Nearest(), Stub()], {'a "b",': instances}, whole)
    shutil.rmtree(cut, ignore_errors=True)
    shutil.copytree(whole, cut)
    kept = {}
    for name, header in (("results.csv", ",".join(RESULT_COLUMNS) + "\n"), ("schedules.jsonl", "")):
        text = (whole / name).read_bytes()
        end = data.draw(st.integers(len(header), len(text)), label=name)
        (cut / name).write_bytes(text[:end])
        kept[name] = text[:end].count(b"\n") - bool(header)
    n_whole = min(kept.values())
    solver = Nearest()
    evaluate([solver, Stub()], {'a "b",': instances}, cut, resume=True)
    assert len(solver.solved) == 5 - min(n_whole, 5)
    assert contents(cut) == contents(whole)


def test_a_new_start_forgets(instances: Instances, tmp_path: Path) -> None:
    """Also what cannot be continued."""
    evaluate([Stub()], instances, tmp_path)
    (tmp_path / "results.csv").write_text("not ours\n")
    evaluate([Nearest()], instances[:2], tmp_path)
    assert [row["solver"] for row in read_rows(tmp_path)] == ["nearest"] * 2
    assert len(json.loads((tmp_path / "evaluation.json").read_text())["runs"]) == 1


def test_folders_grow(instances: Instances, tmp_path: Path) -> None:
    """Solvers, seeds and sets of instances can be added; what is there is neither solved again nor lost."""
    first, second = instances[:3], instances[3:]
    fresh = evaluate([Stub(), Nearest()], {"a": first, "b": second}, tmp_path / "fresh")
    folder = tmp_path / "grown"
    evaluate([Stub()], {"a": first}, folder)
    solver = Nearest()
    evaluate([solver], {"a": first}, folder, resume=True)
    grown = evaluate([Stub(), solver], {"a": first, "b": second}, folder, resume=True)
    assert solver.solved == places(instances)
    assert contents(folder) == contents(tmp_path / "fresh") and figures(grown) == figures(fresh)

    before = contents(folder)
    evaluate([solver], {"a": first}, folder, resume=True, seed=1)
    assert [row["seed"] for row in read_rows(folder)].count("1") == 3
    assert all(line in contents(folder)[0] for line in before[0].splitlines())
    assert len(json.loads((folder / "evaluation.json").read_text())["runs"]) == 4
    # One seed at a time is summarised.
    assert evaluate([solver], {"a": first}, folder, resume=True)[0].n_instances == 3


def test_folders_that_hold_something_else(instances: Instances, tmp_path: Path) -> None:
    evaluate([make_solver("random-nearest"), Stub()], {"a": instances, "b": instances[:1]}, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def refusal(sets: dict[str, Instances], *solvers: Solver) -> str:
        with pytest.raises(ValueError) as error:
            evaluate(solvers or [Stub()], sets, tmp_path, resume=True)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
        assert "--overwrite" in str(error.value) and str(tmp_path) in str(error.value)
        return str(error.value)

    short = instances.digest()[:8]
    assert f"other instances, a (5, {short}) where now comes a (4" in refusal({"a": instances[:4]})
    assert "other instances, a (5" in refusal({"b": instances[:1]})
    assert "other instances, b (1" in refusal({"a": instances, "c": instances})
    other = named("random-nearest", make_solver("kmeans-nearest"))
    message = refusal({"a": instances}, Stub(), other)
    assert (
        "another 'random-nearest', whose spec was 'random-nearest' and not 'kmeans-nearest'; give it another name" in message
    )


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("results.csv", "solver,instance,objective\nstub,0,3\n", "results.csv: its columns are not those that this version"),
        ("results.csv", "", "results.csv: its columns are not those"),
        ("results.csv", None, "results.csv, line 3: is damaged"),
        ("results.csv", b"\xff\xfe\n", "results.csv: is damaged"),
        ("schedules.jsonl", "{}\n", "schedules.jsonl, line 1: is damaged"),
        ("schedules.jsonl", "[\n", "schedules.jsonl, line 1: is damaged"),
        ("evaluation.json", "{", "evaluation.json: does not tell what the results.csv beside it holds"),
        ("evaluation.json", '{"format": 2}', "its format is 2, expected 1"),
        ("evaluation.json", '{"format": 1, "instances": [3], "solvers": {}, "runs": []}', "does not tell what"),
    ],
)
def test_damaged_files(name: str, content: Any, message: str, instances: Instances, tmp_path: Path) -> None:
    """Nothing is guessed, and nothing is destroyed."""
    evaluate([Stub()], instances, tmp_path)
    if content is None:
        lines = (tmp_path / name).read_text().splitlines()
        content = "\n".join([*lines[:2], lines[2][:20], *lines[3:]]) + "\n"
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=message):
        evaluate([Stub()], instances, tmp_path, resume=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    "column, value",
    [("instance", "1.5"), ("objective", "much"), ("feasible", "yes"), ("status", "fine"), ("solver", "unknown")],
)
def test_cells_that_cannot_be(column: str, value: str, instances: Instances, tmp_path: Path) -> None:
    evaluate([Stub()], instances, tmp_path)
    header, first, *others = (tmp_path / "results.csv").read_text().splitlines()
    cells = dict(zip(header.split(","), first.split(","), strict=True)) | {column: value}
    (tmp_path / "results.csv").write_text("\n".join([header, ",".join(cells.values()), *others]) + "\n")
    with pytest.raises(ValueError, match=rf"results.csv(, line 2: is damaged .*{value}|: holds results of 'unknown')"):
        evaluate([Stub()], instances, tmp_path, resume=True)


def test_changed_versions_are_said(
    instances: Instances, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    evaluate([Stub()], instances, tmp_path)
    evaluate([Stub()], instances, tmp_path, resume=True)
    assert caplog.messages == []
    machine = results.describe_machine()
    newer = {**machine, "versions": {**machine["versions"], "torch": "99.0", "pyvrp": "1.0"}}
    monkeypatch.setattr(results, "describe_machine", lambda: newer)
    evaluate([Stub()], instances, tmp_path, resume=True)
    assert "torch " in caplog.text and "-> 99.0" in caplog.text and "pyvrp" in caplog.text


def test_one_evaluation_at_a_time(instances: Instances, tmp_path: Path) -> None:
    with locked_folder(tmp_path), pytest.raises(ValueError, match="another evaluation is writing there; wait for it"):
        evaluate([Stub()], instances, tmp_path)
    assert list(tmp_path.iterdir()) == []
    evaluate([Stub()], instances, tmp_path)


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
    assert summary[2].failures == ("choosy failed on 2 of 2 instances of large: RuntimeError: the licence is too small",)
    with pytest.raises(ValueError, match="large: choosy cannot solve these instances: RuntimeError: the licence is too small"):
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


def test_failures_are_named() -> None:
    assert Failure.of(ValueError("Give\n  more.")).message == "Give more."
    assert Failure.of(ImportError("Run: pip")).message == "Run: pip"
    assert Failure.of(OSError(2, "gone")).message == "FileNotFoundError: [Errno 2] gone"
    assert Failure.of(ValueError()).message == "ValueError: "


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


# --------------------------------------------------------------------------------------------------------------- processes


@pytest.mark.slow
def test_two_processes_find_the_same_as_one(instances: Instances, tmp_path: Path) -> None:
    """
    Same schedules, same files; random numbers follow the row also for the rows of an interrupted run, and a failing instance
    fails alone.
    """
    solvers: list[Solver] = [make_solver("kmeans-nearest"), Nearest(places(instances)[3:4]), Stub()]
    sets = {"a": instances, "b": instances[1:4]}
    alone = evaluate(solvers, sets, tmp_path / "one", seed=5)
    with pytest.raises(KeyboardInterrupt):
        halting = Nearest(places(instances)[2:3], KeyboardInterrupt())
        evaluate([make_solver("random-nearest"), halting], sets, tmp_path / "two", seed=5)
    both = evaluate(solvers, sets, tmp_path / "two", seed=5, n_jobs=2)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    assert figures(both) == figures(alone)


@pytest.mark.slow
def test_processes_that_die_or_never_end(instances: Instances) -> None:
    """One that dies takes only its own instance with it; leaving ends those that would go on for ever."""
    deadly = Mortal(deadly=places(instances)[1:2])
    unsendable = Nearest()
    unsendable.solve_row = lambda *_: None  # type: ignore[assignment, method-assign]
    before = set(multiprocessing.active_children())
    with Runner(2) as runner:
        for _, failure in runner.run(unsendable, instances, [0, 1]):
            assert isinstance(failure, Failure) and "pickle" in failure.message
        found = dict(runner.run(deadly, instances, [0, 1]))
        assert found[1] == Failure("its process died; was it out of memory?")
        assert isinstance(found[0], SolverResult) and found[0].schedule == deadly.solve_row(instances[0], 0).schedule
        endless = runner.run(Mortal(endless=places(instances)[:1]), instances, [0, 1])
        row, _ = next(endless)
        assert row == 1
        workers = set(multiprocessing.active_children()) - before
        assert len(workers) == 2
    for worker in workers:
        worker.join(30)
        assert worker.exitcode is not None

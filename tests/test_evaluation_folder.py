"""Folders of evaluations: resumed after interruptions and crashes, extended, and protected against mixing results."""

from __future__ import annotations

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluation_helpers import Nearest, Stub, contents, figures, named, places, read_rows
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances
from sb3_uav.evaluation import folder as evaluation_folder
from sb3_uav.evaluation import provenance
from sb3_uav.evaluation.locking import locked_folder
from sb3_uav.evaluation.results import RESULT_COLUMNS, read_results
from sb3_uav.evaluation.run import evaluate
from sb3_uav.solvers import Solver, make_solver


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit()])
def test_resuming_after_an_interruption(error: BaseException, instances: Instances, tmp_path: Path) -> None:
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
def test_resuming_after_a_crash_at_any_byte(data: st.DataObject, instances: Instances, tmp_path: Path) -> None:
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


class Idle(Stub):
    """Serves what it is told, and does not mind tasks that must be served."""

    def check(self, instances: Instances) -> None: ...


def test_folders_without_the_number_of_tasks_left_out_are_resumed(instances: Instances, tmp_path: Path) -> None:
    """As versions wrote them that named such tasks in the message only."""
    must_serve = instances.task_mask.clone()
    must_serve[:, 2:] = False
    sets = {"a": replace(instances[:3], must_serve=must_serve[:3]), "b": instances[3:]}
    whole, earlier = tmp_path / "whole", tmp_path / "earlier"
    solvers = [Idle(), named("half", Idle([[1]])), Nearest(places(instances)[:3])]
    summary = evaluate(solvers, sets, whole)
    assert [row.n_unserved for row in summary] == [6, 3, 0, 0, 0, 0]
    shutil.copytree(whole, earlier)
    rows = read_rows(earlier)
    # The last one fails on the first set.
    assert [row["unserved"] for row in rows] == ["2", "2", "2", "1", "1", "1", "", "", ""] + ["0"] * 6
    with (earlier / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, RESULT_COLUMNS[:-1], extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    assert read_results(earlier / "results.csv") == read_results(whole / "results.csv")
    again = evaluate(solvers, sets, earlier, resume=True)
    assert contents(earlier) == contents(whole) and figures(again) == figures(summary)


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
    # One seed at a time is summarized.
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
    assert f"other instances: a (5, {short}), not a (4" in refusal({"a": instances[:4]})
    assert "other instances: a (5" in refusal({"b": instances[:1]})
    assert "other instances: b (1" in refusal({"a": instances, "c": instances})
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
        ("evaluation.json", "{", "evaluation.json: does not describe the results.csv beside it"),
        ("evaluation.json", '{"format": 2}', "its format is 2, expected 1"),
        ("evaluation.json", '{"format": 1, "instances": [3], "solvers": {}, "runs": []}', "does not describe"),
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
    with pytest.raises(ValueError, match=rf"results.csv, line 2: (is damaged .*{value}|holds results of 'unknown')"):
        evaluate([Stub()], instances, tmp_path, resume=True)


@pytest.mark.parametrize("name", ["results.csv", "schedules.jsonl", "evaluation.json"])
@pytest.mark.parametrize("before", ["nothing", "another evaluation"])
def test_resuming_after_a_kill_in_the_first_instants(
    before: str, name: str, instances: Instances, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before one of the three files is in its place, there is nothing to resume, and nothing in the way."""
    if before == "another evaluation":
        evaluate([Nearest()], instances[:2], tmp_path)
    replace_file = os.replace

    def killed(source: Path, target: Path) -> None:
        if Path(target).name == name:
            raise KeyboardInterrupt
        replace_file(source, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "replace", killed)
        evaluate([Stub()], instances, tmp_path)
    # Where another evaluation was to be replaced and is still there, it was not replaced.
    is_there = before == "another evaluation" and name != "evaluation.json"
    evaluate([Stub()], instances, tmp_path, resume=not is_there)
    assert [row["solver"] for row in read_rows(tmp_path)] == ["stub"] * 5


def test_changed_versions_are_said(
    instances: Instances, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    evaluate([Stub()], instances, tmp_path)
    evaluate([Stub()], instances, tmp_path, resume=True)
    assert caplog.messages == []
    machine = provenance.describe_machine()
    newer = {**machine, "versions": {**machine["versions"], "torch": "99.0", "pyvrp": "1.0"}}
    monkeypatch.setattr(evaluation_folder, "describe_machine", lambda: newer)
    evaluate([Stub()], instances, tmp_path, resume=True)
    assert "torch " in caplog.text and "-> 99.0" in caplog.text and "pyvrp" in caplog.text


def test_one_evaluation_at_a_time(instances: Instances, tmp_path: Path) -> None:
    with locked_folder(tmp_path), pytest.raises(ValueError, match="another evaluation is writing there; wait for it"):
        evaluate([Stub()], instances, tmp_path)
    assert list(tmp_path.iterdir()) == []
    evaluate([Stub()], instances, tmp_path)

"""What somebody has changed in the files of an evaluation is not believed when it is resumed."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluation_helpers import Nearest, Stub, contents, named, read_rows
from evaluation_helpers import read_schedules as read_lines

from sb3_uav.envs import Instances
from sb3_uav.evaluation.results import RESULT_COLUMNS
from sb3_uav.evaluation.run import evaluate


def run(instances: Instances, folder: Path, resume: bool = True) -> None:
    """Results that are feasible, empty, infeasible and failed, in this order; lines 2 to 21 of ``results.csv``."""
    solvers = [Nearest(), Stub(), named("wrong", Stub([[0, 0]])), named("failing", Nearest(instances.depot[:, 0].tolist()))]
    evaluate(solvers, {"a": instances}, folder, resume=resume)


def change_result(folder: Path, line: int, **cells: str) -> None:
    rows = read_rows(folder)
    rows[line - 2].update(cells)
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, RESULT_COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def change_schedule(folder: Path, line: int, **fields: Any) -> None:
    lines = read_lines(folder)
    lines[line - 1].update(fields)
    (folder / "schedules.jsonl").write_text("".join(json.dumps(found) + "\n" for found in lines))


@pytest.mark.parametrize(
    ("line", "cells", "message"),
    [
        (2, dict(objective="5.0"), "line 2: .*objective is 5.0, but by the routes in schedules.jsonl it is 2.0"),
        (6, dict(length="0.5"), "line 6: .*length is 0.5, but"),
        (6, dict(objective="nan"), "line 6: .*objective is nan"),
        (2, dict(n_tasks="7"), "line 2: .*n_tasks is 7, but .* 6"),
        (2, dict(n_uavs="1"), "line 2: .*n_uavs is 1"),
        (2, dict(feasible="False"), "line 2: .*feasible is False"),
        (2, dict(unserved="1"), "line 2: .*unserved is 1"),
        (2, dict(seconds="-1"), "line 2: .*seconds is -1.0, below 0"),
        (2, dict(seconds="inf"), "line 2: .*seconds is inf"),
        (2, dict(seconds=""), "line 2: .*seconds is None and batch_size is 1"),
        (2, dict(batch_size="0"), "line 2: .*batch_size is 0"),
        (2, dict(batch_size=str(10**12)), f"line 2: .*batch_size is {10**12}"),
        (2, dict(bound="inf"), "line 2: .*bound is inf"),
        (2, dict(instance="7"), "line 2: .*instance is 7, which is not one of 'a'"),
        (2, dict(instance="-1"), "line 2: .*instance is -1, below 0"),
        (3, dict(instance="0"), "line 3: .*a second result of 'nearest' on instance 0"),
        (12, dict(status="ok"), "line 12: .*status is 'ok', but by the routes in schedules.jsonl it is 'infeasible'"),
        (12, dict(status="ok", feasible="True", objective="2.0", length="1.0", message=""), "line 12: .*objective is 2.0"),
        (17, dict(objective="9.0"), "line 17: .*objective is 9.0, but for a failure it is None"),
        (2, dict(seed="x"), "line 2: .*invalid literal"),
    ],
)
def test_changed_results_are_refused(
    line: int, cells: dict[str, str], message: str, instances: Instances, tmp_path: Path
) -> None:
    """The message names file, line and field, and both files stay as they are."""
    run(instances, tmp_path, resume=False)
    change_result(tmp_path, line, **cells)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=f"results.csv, {message}.*--overwrite"):
        run(instances, tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(routes=[[99]]), "results.csv, line 2: .*objective is 2.0, but by the routes .* None"),
        (dict(routes=[[0], [0]]), "results.csv, line 2"),
        (dict(routes=[[0, 1, 2]]), "results.csv, line 2"),
        (dict(routes=[["0"]]), r"routes in schedules.jsonl is \[\['0'\]\], not lists"),
        (dict(routes=[[True]]), "routes in schedules.jsonl"),
        (dict(routes=None), "routes in schedules.jsonl is None"),
        (dict(objective=3.0), "objective in schedules.jsonl is 3.0, but by the routes there it is 2.0"),
        (dict(lengths=[0.0]), "lengths in schedules.jsonl"),
        (dict(more=1), "more in schedules.jsonl is 1"),
        (dict(instance=1), "schedules.jsonl, line 2: .*a second schedule of 'nearest' on instance 1"),
        (dict(instance=1.5), "schedules.jsonl, line 1: is damaged"),
        (dict(solver=[]), "schedules.jsonl, line 1: is damaged"),
        (dict(seed=None), "schedules.jsonl, line 1: is damaged"),
        (dict(time_limit="1"), "schedules.jsonl, line 1: is damaged"),
    ],
)
def test_changed_schedules_are_refused(fields: dict[str, Any], message: str, instances: Instances, tmp_path: Path) -> None:
    run(instances, tmp_path, resume=False)
    change_schedule(tmp_path, 1, **fields)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=message):
        run(instances, tmp_path)
    assert contents(tmp_path) == before


def test_what_a_user_may_change(instances: Instances, tmp_path: Path) -> None:
    """Delete a line, after which the instance is solved again; leave a torn last line; reword a message; round in the end."""
    run(instances, tmp_path, resume=False)
    whole = contents(tmp_path)
    text = (tmp_path / "results.csv").read_text()
    lines = text.splitlines(keepends=True)
    (tmp_path / "results.csv").write_text("".join(lines[:1] + lines[2:]) + "nearest,0,2")
    run(instances, tmp_path)
    assert contents(tmp_path) == whole
    row = read_rows(tmp_path)[0]
    change_result(tmp_path, 2, length=str(float(row["length"]) * (1 + 1e-13)))
    change_result(tmp_path, 12, message="of an earlier version")
    run(instances, tmp_path)


def test_results_of_other_instances_wait(instances: Instances, tmp_path: Path) -> None:
    """A run without their set neither uses nor loses them; one with it checks them."""
    sets = {"a": instances[:3], "b": replace(instances, values=2 * instances.values)[3:]}
    evaluate([Nearest()], sets, tmp_path)
    change_result(tmp_path, 5, objective="1.0")
    evaluate([Nearest()], {"a": sets["a"]}, tmp_path, resume=True)
    assert [row["objective"] for row in read_rows(tmp_path)][3] == "1.0"
    with pytest.raises(ValueError, match=r"results.csv, line 5: .*objective is 1.0, but .* 4.0"):
        evaluate([Nearest()], sets, tmp_path, resume=True)

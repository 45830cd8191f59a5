"""``sb3-uav evaluate``: the files it writes and the table it prints."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluate_cli_helpers import Inputs, read_results, read_summary, run
from evaluation_helpers import read_schedules

from sb3_uav.common.files import file_hash
from sb3_uav.envs import Instances, check_schedule
from sb3_uav.envs.schedule import _schedule_from_json
from sb3_uav.solvers import SOLVERS
from sb3_uav.solvers.decoding import DECODINGS

# ---------------------------------------------------------------------------------------------------------------- the files


@pytest.mark.parametrize("decode, title", [("greedy", "greedy"), ("sampling", "sampling 3")])
def test_files_and_table(decode: str, title: str, inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every schedule is in both files, is feasible, and has the objective that it says; the table holds their means."""
    code = run(
        *inputs.pair, "--untrained", "--decode", decode, "--samples", 3, "--solvers", "kmeans-nearest", "random-nearest",
        "--instances", inputs.small, inputs.large, "--out", tmp_path / "new" / "out",
    )  # fmt: skip
    assert code == 0
    out = tmp_path / "new" / "out"
    files_written = ["evaluation.json", "results.csv", "schedules.jsonl", "summary.csv", "summary.json"]
    assert sorted(path.name for path in out.iterdir()) == files_written
    solvers = [f"DL-DRL ({title})", f"DL-DRL untrained ({title})", "kmeans-nearest", "random-nearest"]
    rows, lines = read_results(out), read_schedules(out)
    expected = [(solver, str(i)) for part in (range(4), range(4, 6)) for solver in solvers for i in part]
    assert [(row["solver"], row["instance"]) for row in rows] == expected
    assert [(line["solver"], str(line["instance"])) for line in lines] == expected

    files = [Instances.load(inputs.small), Instances.load(inputs.large)]
    for row, line in zip(rows, lines, strict=True):
        assert sorted(line) == ["instance", "lengths", "objective", "routes", "seed", "solver", "time_limit"]
        _, index, schedule = _schedule_from_json(line, "schedules.jsonl")
        instances, index = (files[0], index) if index < 4 else (files[1], index - 4)
        report = check_schedule(instances, index, schedule)
        assert len(schedule.routes) == 3
        assert line["objective"] == report.objective == float(row["objective"]) == schedule.n_visited
        assert line["lengths"] == list(report.lengths) and float(row["length"]) == report.length
        assert (row["n_uavs"], row["n_tasks"]) == ("3", "20" if instances is files[0] else "60")
        assert row["feasible"] == "True" and float(row["seconds"]) > 0

    table = capsys.readouterr().out
    summary = {row["solver"]: row for row in read_summary(out) if row["source"] == "U3-N20"}
    best = max(float(row["objective"]) for row in summary.values())
    reference = np.array([float(row["objective"]) for row in rows if row["solver"] == solvers[0]][:4])
    for solver in solvers:
        values = np.array([float(row["objective"]) for row in rows if row["solver"] == solver and row["n_tasks"] == "20"])
        printed = next(text for text in table.splitlines() if f" {solver} " in text).split()
        error, gap = values.std(ddof=1) / 2, 100 * (best - values.mean()) / best
        differences = values - reference
        # Student's t for 3 degrees of freedom.
        halfwidth = 3.182 * differences.std(ddof=1) / 2
        told = "reference" if solver == solvers[0] else f"{differences.mean():+.2f} ± {halfwidth:.2f}"
        start = f"{solver} {values.mean():.2f} {error:.2f} {gap:.2f} {told} "
        assert " ".join(printed).startswith(start)
        assert printed[-1] == ("4" if solver.startswith("DL-DRL") else "1")
        assert float(summary[solver]["difference"]) == pytest.approx(differences.mean())
        assert float(summary[solver]["difference_high"]) == pytest.approx(differences.mean() + halfwidth)
    assert table.index("U3-N20: 4 instances") < table.index("U3-N60: 2 instances")


def test_seed_and_batch_size(inputs: Inputs, tmp_path: Path) -> None:
    """The same seed gives the same schedules, whatever the size of the batch."""

    def schedules(name: str, *arguments: Any) -> str:
        common = (*inputs.pair, "--decode", "sampling", "--samples", 2, "--instances", inputs.small)
        assert run(*common, "--solvers", "random-nearest", "--out", tmp_path / name, *arguments) == 0
        return (tmp_path / name / "schedules.jsonl").read_text()

    first = schedules("a", "--seed", 3)
    assert schedules("b", "--seed", 3, "--batch-size", 1) == first
    assert schedules("c", "--seed", 4) != first


def test_untrained_networks_of_several_seeds(inputs: Inputs, tmp_path: Path) -> None:
    """They are different solvers, and may stand in the same folder."""
    for seed in (0, 1):
        assert run(*inputs.pair, "--untrained", "--instances", inputs.small, "--out", tmp_path, "--seed", seed) == 0
    rows = [(row["solver"], row["seed"]) for row in read_results(tmp_path) if row["instance"] == "0"]
    untrained = [("DL-DRL untrained (greedy)", "0"), ("DL-DRL untrained 1 (greedy)", "1")]
    assert rows == [("DL-DRL (greedy)", "0"), ("DL-DRL (greedy)", "1"), *untrained]


def test_infeasible_schedules_set_the_exit_code(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SOLVERS, "broken", "evaluate_cli_helpers:OutOfRange")
    assert run("--solvers", "broken", "random-nearest", "--instances", inputs.small, "--out", tmp_path) == 1
    assert "sb3-uav: wrong: broken, instance 0 of U3-N20: UAV 1 visits task 99" in capsys.readouterr().err
    assert [row["feasible"] for row in read_results(tmp_path)] == ["False"] * 4 + ["True"] * 4


def test_pairs_side_by_side(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Zips are solvers like others; the options of the pair and those of a spec give the same schedules."""
    zips = inputs.zips
    code = run(
        *inputs.pair, "--decode", "sampling", "--samples", 2, "--instances", inputs.small, "--out", tmp_path,
        "--reference", "K-means+AM", "--solvers", f"dl-drl:{zips},decode=sampling,samples=2", f"dl-drl-i:{zips},name=DL-DRL-I",
        f"kmeans-am:router={inputs.router},name=K-means+AM",
    )  # fmt: skip
    assert code == 0
    lines = read_schedules(tmp_path)
    names = ["DL-DRL (sampling 2)", f"dl-drl:{zips},decode=sampling,samples=2", "DL-DRL-I", "K-means+AM"]
    assert [line["solver"] for line in lines] == [name for name in names for _ in range(4)]
    routes = {name: [line["routes"] for line in lines if line["solver"] == name] for name in names}
    assert routes[names[0]] == routes[names[1]] != routes[names[2]]
    assert [(row["solver"], row["reference"]) for row in read_summary(tmp_path)] == [(name, "K-means+AM") for name in names]
    assert "Difference: to K-means+AM on the same instances" in capsys.readouterr().out
    told = json.loads((tmp_path / "evaluation.json").read_text())
    for name in names[:3]:
        files = told["solvers"][name]["files"]
        assert files["allocator"] == {"path": str(inputs.allocator), "sha256": file_hash(inputs.allocator)}
        assert files["router"] == {"path": str(inputs.router), "sha256": file_hash(inputs.router)}


def test_every_decoding_of_the_solver_is_on_the_command_line(inputs: Inputs, tmp_path: Path) -> None:
    for decode in DECODINGS:
        out = tmp_path / decode
        common = ("--decode", decode, "--samples", 2, "--instances", inputs.small, "--out", out)
        assert run(*inputs.pair, *common, "--solvers", f"dl-drl:{inputs.zips},decode={decode},samples=2") == 0
        lines = read_schedules(out)
        assert len(lines) == 8 and [line["routes"] for line in lines[:4]] == [line["routes"] for line in lines[4:]]


def test_zips_whose_paths_hold_commas(inputs: Inputs, tmp_path: Path) -> None:
    folder = tmp_path / "mine, yours"
    folder.mkdir()
    for zip_file in (inputs.allocator, inputs.router):
        shutil.copy(zip_file, folder)
    spec = f"dl-drl:allocator=\"{folder / 'allocator.zip'}\",router='{folder / 'router.zip'}'"
    assert run("--instances", inputs.small, "--out", tmp_path / "out", "--solvers", spec) == 0
    told = json.loads((tmp_path / "out" / "evaluation.json").read_text())["solvers"][spec]
    assert told["files"]["allocator"]["path"] == str(folder / "allocator.zip")


def test_device_and_batch_size_are_for_all_networks(inputs: Inputs, tmp_path: Path) -> None:
    common = ("--instances", inputs.small, "--out", tmp_path, "--batch-size", 3, "--device", "cpu", "--solvers")
    assert run(*common, f"kmeans-am:router={inputs.router}", f"dl-drl:{inputs.zips},batch_size=2", "random-nearest") == 0
    assert [row["batch_size"] for row in read_results(tmp_path)] == ["3"] * 3 + ["1"] + ["2"] * 4 + ["1"] * 4


# ------------------------------------------------------------------------------------------- interruptions and other troubles


def test_several_time_limits(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SOLVERS, "timed", "evaluate_cli_helpers:Timed")
    common = (*inputs.pair, "--instances", inputs.small, "--out", tmp_path, "--solvers", "timed", "--time-limit")
    assert run(*common, 0.5, 2) == 0
    captured = capsys.readouterr()
    assert captured.out.index("U3-N20: 4 instances, 0.5 s each") < captured.out.index("U3-N20: 4 instances, 2 s each")
    lines = [line for line in captured.err.splitlines() if " on " in line]
    assert lines == [
        "DL-DRL (greedy) on U3-N20: 4 instances",
        "timed on U3-N20: 4 instances, 0.5 s each",
        "timed on U3-N20: 4 instances, 2 s each",
    ]
    found = [
        (row["solver"], row["time_limit"], row["objective"]) for row in read_summary(tmp_path) if row["solver"] == "timed"
    ]
    assert found == [("timed", "0.5", "0.0"), ("timed", "2.0", "1.0")]
    assert [row["time_limit"] for row in read_results(tmp_path)] == [""] * 4 + ["0.5"] * 4 + ["2.0"] * 4


# -------------------------------------------------------------------------------------------------------------- the command


def test_help_of_evaluate(capsys: pytest.CaptureFixture[str]) -> None:
    """It tells the files and the exit codes."""
    with pytest.raises(SystemExit) as stop:
        run("--help")
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for word in (
        "sb3-uav evaluate",
        "results.csv",
        "summary.json",
        "exit code:",
        "  3    a solver or its license is missing",
        "dl-drl-i:",
    ):
        assert word in text


def test_as_a_process(inputs: Inputs, tmp_path: Path) -> None:
    """What a shell sees: a table on the standard output, remarks on the standard error, the exit code."""
    command = [sys.executable, "-m", "sb3_uav.cli.main", "evaluate", "--instances", str(inputs.small), "--out", str(tmp_path)]
    done = subprocess.run([*command, "--solvers", "random-nearest"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr.endswith("random-nearest on U3-N20: 4 instances\n")
    assert "random-nearest" in done.stdout
    assert [row["solver"] for row in read_results(tmp_path)] == ["random-nearest"] * 4


def test_unreachable_tasks_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They are no error, because the paper's distribution has them too, but a user should know."""
    far = Instances.from_arrays([0.0, 0.0], [[0.5, 0.0], [3.0, 0.0], [0.0, 1.1]], max_distance=2.0, n_uavs=1)
    far.save(tmp_path / "far.npz")
    assert run("--solvers", "kmeans-nearest", "--instances", tmp_path / "far.npz", "--out", tmp_path / "out") == 0
    assert "far: 2 of 3 tasks lie farther than max_distance / 2 from their depot" in capsys.readouterr().err
    assert read_results(tmp_path / "out")[0]["objective"] == "1.0"


def test_tasks_that_must_be_served_are_named_where_they_are_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Task 1 is out of reach; tasks 0 and 2 take one UAV each."""
    tasks, must = [[0.5, 0.0], [3.0, 0.0], [-0.9, 0.0]], [True, True, True]
    one = Instances.from_arrays([0.0, 0.0], tasks, max_distance=[1.9, 1.0], n_uavs=2, must_serve=must)
    one.save(tmp_path / "one.npz")
    solver, out = "local-search:time_limit=0.05", tmp_path / "out"
    assert run("--solvers", solver, "--instances", tmp_path / "one.npz", "--out", out) == 0
    said = capsys.readouterr().err
    assert "one: 1 of 3 tasks are out of reach of every UAV" in said
    assert "one: instance 0: tasks that must be served are among them: 1." in said
    assert "local-search:time_limit=0.05, 1 of 1 instances of one: leaves out tasks that must be served" in said
    (row,), (totals,) = read_results(out), read_summary(out)
    assert row["message"] == "does not serve tasks that must be served: 1"
    assert (row["unserved"], totals["n_unserved"]) == ("1", "1")
    (line,) = (out / "schedules.jsonl").read_text().splitlines()
    record = json.loads(line)
    assert record["unserved"] == [1] and sorted(task for route in record["routes"] for task in route) == [0, 2]

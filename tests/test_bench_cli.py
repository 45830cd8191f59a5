"""``sb3-uav bench`` on the small files beside the tests: what it prints and writes, resuming, and errors."""

from __future__ import annotations

import csv
import json
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from benchmark_files import BEST_KNOWN, FILES
from PIL import Image

from sb3_uav.cli import main as cli
from sb3_uav.cli.bench import _Progress
from sb3_uav.envs import Schedule, check_schedule
from sb3_uav.evaluation.benchmarks import read_folder
from sb3_uav.evaluation.benchmarks.rounding import check_rounded
from sb3_uav.evaluation.results import read_results
from sb3_uav.solvers import registry

pytest.importorskip("rich")
HAS_VRPLIB = find_spec("vrplib") is not None
# What can be read without vrplib.
CHAO = ["--only", "a1.*", "b1.*"]
OUR_FILES = {
    "results.csv",
    "schedules.jsonl",
    "evaluation.json",
    "summary.csv",
    "summary.json",
    "gaps.csv",
    "routes.jsonl",
    "summary.md",
}


def bench(out: Path, *arguments: Any, folder: Path = FILES, best_known: Path = BEST_KNOWN) -> int:
    return cli.main(["bench", *map(str, [folder, "--best-known", best_known, "--out", out, *arguments])])


def read_gaps(out: Path) -> list[dict[str, str]]:
    with (out / "gaps.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def user_error(capsys: pytest.CaptureFixture[str], out: Path, *arguments: Any, **files: Path) -> str:
    """Run a command that must fail, and return its one line on the standard error."""
    capsys.readouterr()
    assert bench(out, *arguments, **files) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert lines[-1].startswith("sb3-uav bench: error: ") and captured.out == ""
    return lines[-1]


@pytest.mark.skipif(not HAS_VRPLIB, reason="vrplib reads OPLib files")
def test_all_files_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert bench(out, "--solvers", "random-nearest", "kmeans-nearest", "--seed", 3) == 0
    assert {path.name for path in out.iterdir()} == OUR_FILES
    folder = read_folder(FILES)
    gaps = read_gaps(out)
    assert [row["instance"] for row in gaps if row["solver"] == "random-nearest"] == list(folder.instances)
    assert len(gaps) == 12 and {row["seed"] for row in gaps} == {"3"} and {row["status"] for row in gaps} == {"ok"}
    routes = {
        (line["instance"], line["solver"]): line for line in map(json.loads, (out / "routes.jsonl").read_text().splitlines())
    }
    assert len(routes) == 12
    for row in gaps:
        # Once more, from the numbers of the nodes in the files.
        instance = folder.instances[row["instance"]]
        line = routes[row["instance"], row["solver"]]
        schedule = Schedule([[instance.nodes.index(node) for node in route] for route in line["routes"]])
        report = check_schedule(instance.instances, 0, schedule)
        assert report.objective == float(row["objective"]) == line["objective"]
        if instance.is_rounded:
            assert sum(check_rounded(instance.instances, schedule).lengths) == float(row["length"])
        else:
            assert report.length == pytest.approx(float(row["length"]))
        best = float(row["best_known"])
        assert float(row["gap"]) == pytest.approx(100 * (best - report.objective) / best if best else 0)
        assert row["reached"] == str(report.objective >= best) and row["better"] == "False"
    # No vehicle of this one reaches the end.
    nobody = [row for row in gaps if row["instance"] == "b1.2.b"]
    assert {(row["objective"], row["gap"], row["reached"]) for row in nobody} == {("0.0", "0.0", "True")}
    assert [row.objective for row in read_results(out / "results.csv")] == [float(row["euclidean_objective"]) for row in gaps]
    settings = json.loads((out / "evaluation.json").read_text())
    assert [source["name"] for source in settings["instances"]] == ["a1", "b1, 1 UAV", "b1, 2 UAVs", "road8"]
    summary = (out / "summary.md").read_text(encoding="utf-8")
    printed = capsys.readouterr()
    assert "6 instances, 6 of them with a best-known value; seed 3." in summary
    assert "| Group | Solver | Gap % | Reached | Better | s each |" in summary and "| all | random-nearest |" in summary
    rule = "the length of every edge is rounded to the nearest whole number"
    assert rule in summary and rule in printed.out
    assert "bench_files: 6 instances, gap to the best-known values" in printed.out and str(out / "summary.md") in printed.out
    assert "random-nearest on b1, 2 UAVs: 2 instances\n" in printed.err
    # The same schedules, compared in another way.
    results = (out / "results.csv").read_text()
    assert bench(out, "--solvers", "random-nearest", "kmeans-nearest", "--seed", 3, "--use-rounding") == 0
    assert (out / "results.csv").read_text() == results
    more = read_gaps(out)
    assert all(float(new["objective"]) >= float(old["objective"]) for new, old in zip(more, gaps, strict=True))
    assert all(new == old for new, old in zip(more, gaps, strict=True) if old["instance"] != "road8")


def test_a_solver_that_refuses_ends_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setitem(registry.SOLVERS, "choosy", "evaluation_helpers:Fastidious")
    assert bench(tmp_path, "--solvers", "choosy", "random-nearest", *CHAO) == 3
    by_solver = {row["solver"]: row for row in read_gaps(tmp_path) if row["instance"] == "b1.1.a"}
    assert by_solver["choosy"]["status"] == "failed" and by_solver["choosy"]["message"] == "no open ways"
    assert by_solver["random-nearest"]["status"] == "ok"
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == "sb3-uav: choosy failed on 3 instances (b1.1.a to b1.2.b): no open ways"
    assert "- choosy failed on 3 instances (b1.1.a to b1.2.b): no open ways" in (tmp_path / "summary.md").read_text()
    # Of the two that it solved; of the first group it solved all.
    assert captured.out.count("100.00*") == 1 and captured.out.count("100.00 ") == 1
    assert "* mean over those that are solved" in captured.out


def test_a_solver_that_is_missing_ends_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setitem(registry.SOLVERS, "absent", "a_module_that_is_not_installed:Solver")
    assert bench(tmp_path, "--solvers", "absent", "random-nearest", *CHAO) == 3
    assert "sb3-uav: absent failed on 5 instances (a1.2.a to b1.2.b): No module" in capsys.readouterr().err


def test_resuming(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(tmp_path, "--solvers", "random-nearest", *CHAO) == 0
    results, gaps = (tmp_path / "results.csv").read_text(), (tmp_path / "gaps.csv").read_text()
    schedules = (tmp_path / "schedules.jsonl").read_text()
    # As if it had been interrupted, in the middle of a line.
    lines = results.splitlines(keepends=True)
    (tmp_path / "results.csv").write_text("".join(lines[:4]) + lines[4][:10])
    (tmp_path / "gaps.csv").unlink()
    capsys.readouterr()
    assert bench(tmp_path, "--solvers", "random-nearest", *CHAO) == 0
    assert "2 instances, 2 of them done before" in capsys.readouterr().err
    assert (tmp_path / "schedules.jsonl").read_text() == schedules
    again = (tmp_path / "results.csv").read_text().splitlines(keepends=True)
    # With their seconds: they were not solved again.
    assert again[:4] == lines[:4]
    before = csv.DictReader(gaps.splitlines())
    assert [{**row, "seconds": ""} for row in read_gaps(tmp_path)] == [{**row, "seconds": ""} for row in before]
    # Another solver beside the first one; the table shows both.
    assert bench(tmp_path, "--solvers", "kmeans-nearest", *CHAO) == 0
    captured = capsys.readouterr()
    assert "random-nearest" in captured.out and len(read_gaps(tmp_path)) == 10
    assert bench(tmp_path, "--solvers", "kmeans-nearest", *CHAO, "--overwrite") == 0
    assert len(read_gaps(tmp_path)) == 5


def test_interrupting(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setitem(registry.SOLVERS, "interrupted", "evaluate_cli_helpers:Interrupted")
    assert bench(tmp_path, "--solvers", "random-nearest", *CHAO) == 0
    assert bench(tmp_path, "--solvers", "random-nearest", "interrupted", *CHAO) == 130
    assert "sb3-uav bench: interrupted; continue with sb3-uav bench " in capsys.readouterr().err
    # These describe the results before; those are kept.
    assert not (tmp_path / "gaps.csv").exists() and not (tmp_path / "summary.md").exists()
    assert len(read_results(tmp_path / "results.csv")) == 5
    assert bench(tmp_path, "--solvers", "random-nearest", *CHAO) == 0


@pytest.mark.slow
def test_two_processes_find_the_same(tmp_path: Path) -> None:
    for n_jobs in (1, 2):
        assert bench(tmp_path / str(n_jobs), "--solvers", "random-nearest", *CHAO, "--jobs", n_jobs) == 0
    assert (tmp_path / "1" / "routes.jsonl").read_text() == (tmp_path / "2" / "routes.jsonl").read_text()


def test_the_curve(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyvrp")
    pytest.importorskip("matplotlib")
    arguments = ["--only", "a1.*", "--solvers", "pyvrp", "random-nearest", "--time-limits", 0.01, 0.03]
    assert bench(tmp_path, *arguments) == 0
    with Image.open(tmp_path / "anytime.png") as picture:
        assert picture.format == "PNG" and min(picture.size) > 300
    printed = capsys.readouterr().out
    assert "Limit" in printed and str(tmp_path / "anytime.png") in printed
    assert {(row["solver"], row["time_limit"]) for row in read_gaps(tmp_path)} == {
        ("pyvrp", "0.01"),
        ("pyvrp", "0.03"),
        ("random-nearest", ""),
    }


def test_instances_without_a_value_are_solved_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = tmp_path / "values.csv"
    values.write_text("instance,best_known\na1.2.a,1\n", encoding="utf-8")
    out = tmp_path / "out"
    assert bench(out, "--solvers", "random-nearest", "--only", "a1.*", best_known=values) == 0
    better, unknown = read_gaps(out)
    assert better["better"] == "True" and float(better["gap"]) < 0
    assert unknown["best_known"] == unknown["gap"] == "" and float(unknown["objective"]) > 0
    assert "Solved, but without a best-known value: a1.2.b." in capsys.readouterr().out
    summary = (out / "summary.md").read_text()
    assert "2 instances, 1 of them with a best-known value" in summary
    assert f"- a1.2.a: {float(better['objective']):g} against 1, by random-nearest" in summary


def test_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = ["--solvers", "random-nearest", *CHAO]
    out = tmp_path / "out"
    values = tmp_path / "values.csv"
    values.write_text("instance,best_known\na1.2.a,many\n", encoding="utf-8")
    assert f"{values}, line 2: best_known of 'a1.2.a' is 'many'" in user_error(capsys, out, *one, best_known=values)
    values.write_text("instance,best_known\nz9,3\n", encoding="utf-8")
    message = user_error(capsys, out, *one, best_known=values)
    assert "none of its instances has a best-known value; they have names like 'a1.2.a', the best-known values" in message
    assert "no such file" in user_error(capsys, out, *one, best_known=tmp_path / "none.csv")
    assert "no such folder" in user_error(capsys, out, *one, folder=tmp_path / "none")
    assert "Unknown solver 'nothing'; choose one of" in user_error(capsys, out, "--solvers", "nothing", *CHAO)
    assert "random-nearest' is given twice" in user_error(capsys, out, "--solvers", "random-nearest", "random-nearest", *CHAO)
    assert "no instance has a name like q9" in user_error(capsys, out, "--solvers", "random-nearest", "--only", "q9")
    assert "A time limit is -1" in user_error(capsys, out, *one, "--time-limits", "-1")
    assert not out.exists()
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "a1.2.a.txt").write_text("n 9\nm two\n", encoding="utf-8")
    assert "a1.2.a.txt, line 2: expected 'm NUMBER', found 'm two'" in user_error(capsys, out, *one, folder=damaged)


def test_other_instances_leave_earlier_results_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(tmp_path, "--solvers", "random-nearest", "--only", "a1.*") == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    message = user_error(capsys, tmp_path, "--solvers", "random-nearest", "--only", "b1.*")
    assert "holds results of other instances: a1 (2, " in message
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_progress_of_the_whole_run(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tqdm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with _Progress(7) as progress:
        done = []
        for text, n_done, n_set in (
            ("a on x: 3", 1, 3),
            ("a on x: 3", 3, 3),
            ("b on x: 3", 0, 3),
            ("b on x: 3", 3, 3),
            ("c", 1, 1),
        ):
            progress(text, n_done, n_set)
            done.append(progress._bar.n)
    assert done == [1, 3, 3, 6, 7]

"""``sb3-uav evaluate``: the files it writes, the table it prints, and what it says to wrong input."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import sb3_uav
from sb3_uav.envs import BatchedVecEnv, Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import schedule_from_json
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import DLDRL, SOLVERS, Solver, SolverResult, evaluate, make_solver, print_table
from sb3_uav.solvers.evaluation import RESULT_COLUMNS
from sb3_uav.zoo import cli

TINY = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)


class Inputs:
    """Files on disk: a pair of zips for 3 UAVs, and instances of two sizes."""

    def __init__(self, folder: Path) -> None:
        self.allocator, self.router = folder / "allocator.zip", folder / "router.zip"
        self.small, self.large = folder / "U3-N20.npz", folder / "U3-N60.npz"
        env = make_vec_env("TaskAllocation-U3-N20-v0", 4, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
        # Two algorithms, because a zip may come from any.
        policy: Any = AllocatorPolicy
        PPO(policy, env, n_steps=16, policy_kwargs=dict(TINY), seed=0, device="cpu").save(self.allocator)
        env = make_vec_env("RoutePlanning-N20-v0", 4, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
        REINFORCE(RouterPolicy, env, policy_kwargs=dict(TINY), seed=0, device="cpu").save(self.router)
        UniformGenerator(20, n_uavs=3)(4, np.random.default_rng(0)).save(self.small)
        UniformGenerator(60, n_uavs=3)(2, np.random.default_rng(1)).pad(64).save(self.large)

    @property
    def pair(self) -> list[str]:
        return ["--allocator", str(self.allocator), "--router", str(self.router), "--device", "cpu"]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


def run(*arguments: Any) -> int:
    return cli.main(["evaluate", *map(str, arguments)])


def read_results(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        assert reader.fieldnames == ["solver", "instance", "n_uavs", "n_tasks", "objective", "length", "seconds", "feasible"]
        return list(reader)


def read_schedules(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "schedules.jsonl").read_text().splitlines()]


def user_error(capsys: pytest.CaptureFixture[str], *arguments: Any) -> str:
    """Run a command that must fail, and return its one line on the standard error."""
    capsys.readouterr()
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("sb3-uav: error: ")]
    assert len(lines) == 1 and "Traceback" not in captured.err and captured.out == ""
    return lines[0]


class Stub(Solver):
    """Returns the given routes for every instance."""

    name = "stub"

    def __init__(self, routes: Sequence[Sequence[int]] = ()) -> None:
        self.routes = routes

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [SolverResult(Schedule(self.routes), 0.5, len(instances)) for _ in range(len(instances))]


class Interrupted(Stub):
    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        raise KeyboardInterrupt


class OutOfRange(Stub):
    def __init__(self) -> None:
        super().__init__([[], [99]])


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
    assert sorted(path.name for path in out.iterdir()) == ["results.csv", "schedules.jsonl"]
    solvers = [f"DL-DRL ({title})", f"DL-DRL untrained ({title})", "kmeans-nearest", "random-nearest"]
    rows, lines = read_results(out), read_schedules(out)
    expected = [(solver, str(i)) for part in (range(4), range(4, 6)) for solver in solvers for i in part]
    assert [(row["solver"], row["instance"]) for row in rows] == expected
    assert [(line["solver"], str(line["instance"])) for line in lines] == expected

    files = [Instances.load(inputs.small), Instances.load(inputs.large)]
    for row, line in zip(rows, lines, strict=True):
        assert sorted(line) == ["instance", "lengths", "objective", "routes", "solver"]
        _, index, schedule = schedule_from_json(line, "schedules.jsonl")
        instances, index = (files[0], index) if index < 4 else (files[1], index - 4)
        report = check_schedule(instances, index, schedule)
        assert len(schedule.routes) == 3
        assert line["objective"] == report.objective == float(row["objective"]) == schedule.n_visited
        assert line["lengths"] == list(report.lengths) and float(row["length"]) == report.length
        assert (row["n_uavs"], row["n_tasks"]) == ("3", "20" if instances is files[0] else "60")
        assert row["feasible"] == "True" and float(row["seconds"]) > 0

    table = capsys.readouterr().out
    for solver in solvers:
        values = [float(row["objective"]) for row in rows if row["solver"] == solver and row["n_tasks"] == "20"]
        cells = next(line for line in table.splitlines() if solver in line).split("│")
        error = np.std(values, ddof=1) / 2
        batch = "4" if solver.startswith("DL-DRL") else "1"
        found = [cell.strip() for cell in cells[1:-1]]
        assert found[:3] == [solver, f"{np.mean(values):.2f}", f"{error:.2f}"]
        assert found[4:] == [batch, "0"]
    assert table.index("U3-N20: 4 instances") < table.index("U3-N60: 2 instances")
    assert all(len(line.rstrip()) <= 80 for line in table.splitlines())


def test_seed_and_batch_size(inputs: Inputs, tmp_path: Path) -> None:
    """The same seed gives the same schedules, whatever the size of the batch."""

    def schedules(name: str, *arguments: Any) -> str:
        common = (*inputs.pair, "--decode", "sampling", "--samples", 2, "--instances", inputs.small)
        assert run(*common, "--solvers", "random-nearest", "--out", tmp_path / name, *arguments) == 0
        return (tmp_path / name / "schedules.jsonl").read_text()

    first = schedules("a", "--seed", 3)
    assert schedules("b", "--seed", 3, "--batch-size", 1) == first
    assert schedules("c", "--seed", 4) != first


def test_means_errors_and_times_in_python(tmp_path: Path) -> None:
    """Values count, not visits; a single instance has no standard error."""
    instances = Instances.from_arrays(
        np.zeros((3, 2)), np.full((3, 2, 2), 0.1), values=[[1.0, 5.0], [2.0, 5.0], [6.0, 5.0]], n_uavs=2
    )
    (row,) = evaluate([Stub([[0]])], instances, tmp_path)
    assert row.objective == 3.0 and row.standard_error == pytest.approx(math.sqrt(7) / math.sqrt(3))
    assert (row.n_instances, row.seconds, row.batch_size, row.violations) == (3, 0.5, 3, ())
    (row,) = evaluate([Stub([[0]])], instances[:1], tmp_path)
    assert row.objective == 1.0 and math.isnan(row.standard_error)


def test_infeasible_schedules_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A task visited twice, and a tour that is too long: said so, not counted, and the others are kept."""
    instances = Instances.from_arrays([[0.0, 0.0]] * 2, [[[0.1, 0.0], [0.2, 0.0]], [[0.1, 0.0], [3.0, 0.0]]], n_uavs=2)
    lines: list[str] = []
    far, twice = Stub([[0, 1]]), Stub([[0, 1], [1]])
    far.name, twice.name = "far", "twice"
    summary = evaluate([far, twice], {"set": instances}, tmp_path, progress=lines.append)
    assert lines == ["far on set: 2 instances", "twice on set: 2 instances"]
    assert summary[0].objective == 2.0 and summary[0].violations == (
        "far, instance 1 of set: UAV 0 flies 6.000000000, which is 4 over its maximum of 2.000000000.",
    )
    assert math.isnan(summary[1].objective) and len(summary[1].violations) == 2
    assert "Task 1 is visited twice, by UAV 0 and UAV 1" in summary[1].violations[0]
    rows, schedules = read_results(tmp_path), read_schedules(tmp_path)
    assert [row["feasible"] for row in rows] == ["True", "False", "False", "False"]
    assert [row["objective"] for row in rows] == ["2.0", "", "", ""] and rows[1]["length"] == ""
    assert schedules[1] == {"solver": "far", "instance": 1, "routes": [[0, 1]], "objective": None, "lengths": []}
    print_table(summary)
    last = capsys.readouterr().out.splitlines()[-2].split("│")
    assert [cell.strip() for cell in last[2:4]] == ["-", "-"] and last[6].strip() == "2"


def test_infeasible_schedules_set_the_exit_code(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SOLVERS, "broken", f"{__name__}:OutOfRange")
    assert run("--solvers", "broken", "random-nearest", "--instances", inputs.small, "--out", tmp_path) == 1
    assert "infeasible schedule: broken, instance 0 of U3-N20: UAV 1 visits task 99" in capsys.readouterr().err
    assert [row["feasible"] for row in read_results(tmp_path)] == ["False"] * 4 + ["True"] * 4


@pytest.mark.parametrize("failure", ["interrupted", "error"])
def test_nothing_is_half_written(
    failure: str, inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C or an error in the second solver: the files of the evaluation before are still there, and nothing else."""
    arguments = ("--instances", inputs.small, "--out", tmp_path, "--solvers", "random-nearest")
    assert run(*arguments) == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    if failure == "interrupted":
        monkeypatch.setitem(SOLVERS, "failing", f"{__name__}:Interrupted")
        assert run(*arguments, "failing") == 130
        assert "interrupted" in capsys.readouterr().err
    else:
        monkeypatch.setattr(DLDRL, "check", lambda *_: None)
        UniformGenerator(5, n_uavs=2)(1, np.random.default_rng(0)).save(tmp_path.parent / "U2.npz")
        files = (inputs.small, tmp_path.parent / "U2.npz")
        assert "trained for 3 UAVs" in user_error(capsys, *inputs.pair, "--instances", *files, "--out", tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


# ---------------------------------------------------------------------------------------------------------------- bad input


def test_wrong_instances(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad, out = tmp_path / "bad.npz", tmp_path / "out"

    def error_for(**changed: Any) -> str:
        with np.load(inputs.small) as file:
            np.savez(bad, **{**dict(file), **changed})
        return user_error(capsys, "--solvers", "kmeans-nearest", "--instances", inputs.large, bad, "--out", out)

    with np.load(inputs.small) as file:
        tasks = file["tasks"].copy()
    tasks[1, 2, 0] = np.nan
    message = error_for(tasks=tasks)
    assert str(bad) in message and "field 'tasks' holds nan at index (1, 2, 0)" in message
    assert "field 'max_distance' is 0.0 in instance 0" in error_for(max_distance=np.zeros(4))
    assert "field 'max_distance' is -1.0 in instance 2" in error_for(max_distance=np.array([1.0, 1.0, -1.0, 1.0]))
    bad.write_bytes(inputs.small.read_bytes()[:500])
    common = ("--solvers", "kmeans-nearest", "--out", out, "--instances")
    assert f"{bad}: not an intact .npz" in user_error(capsys, *common, bad)
    assert f"{tmp_path / 'no.npz'}: no such instance file" in user_error(capsys, *common, tmp_path / "no.npz")
    assert "twice; give every file once" in user_error(capsys, *common, inputs.small, inputs.small)
    assert not out.exists()


def test_wrong_zips(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truncated = tmp_path / "truncated.zip"
    truncated.write_bytes(inputs.allocator.read_bytes()[:3000])
    common = ("--instances", inputs.small, "--out", tmp_path / "out")

    def error_for(allocator: Path, router: Path) -> str:
        return user_error(capsys, *common, "--allocator", allocator, "--router", router)

    assert f"{truncated}: is not an intact zip" in error_for(truncated, inputs.router)
    assert f"{tmp_path / 'no.zip'}: no such file" in error_for(inputs.allocator, tmp_path / "no.zip")
    assert "exchanged" in error_for(inputs.router, inputs.allocator)
    UniformGenerator(5, n_uavs=5)(1, np.random.default_rng(0)).save(tmp_path / "U5.npz")
    message = user_error(capsys, *inputs.pair, "--instances", inputs.small, tmp_path / "U5.npz", "--out", tmp_path / "out")
    assert "U5: DL-DRL (greedy) cannot solve these instances" in message and "trained for 3 UAVs" in message
    assert not (tmp_path / "out").exists()


def test_wrong_arguments(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("--instances", inputs.small, "--out", tmp_path / "out")
    solver = (*common, "--solvers", "kmeans-nearest")
    for arguments, message in (
        (common, "There is nothing to evaluate: give --allocator with --router, or --solvers."),
        ((*common, "--allocator", inputs.allocator), "--allocator and --router go together; --router is missing."),
        ((*solver, "--router", inputs.router), "--allocator and --router go together; --allocator is missing."),
        ((*solver, "--untrained"), "--untrained needs --allocator and --router"),
        ((*common, "--solvers", "magic"), "Unknown solver 'magic'; choose one of ['kmeans-nearest', 'random-nearest'"),
        ((*common, "--solvers", "kmeans-nearest:k=3"), "has no option 'k=3'; its options are: restarts=<int>"),
        ((*solver, "kmeans-nearest"), "Solver 'kmeans-nearest' is given twice"),
        ((*solver, "--seed", -1), "--seed is -1; it must be at least 0."),
        ((*common, *inputs.pair, "--decode", "sampling", "--samples", 0), "samples is 0; give at least 1."),
        ((*common, *inputs.pair, "--batch-size", 0), "batch_size is 0; give at least 1."),
        ((*common, *inputs.pair, "--device", "abacus"), "device is 'abacus', which cannot be used"),
    ):
        assert message in user_error(capsys, *arguments)
    assert not (tmp_path / "out").exists()


def test_output_folder_that_cannot_be_written(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("precious")
    for out in (tmp_path / "file", tmp_path / "file" / "folder"):
        message = user_error(capsys, "--solvers", "kmeans-nearest", "--instances", inputs.small, "--out", out)
        assert f"{out}/results.csv: cannot be written" in message and "choose another output folder" in message
    assert (tmp_path / "file").read_text() == "precious"


def test_packages_that_are_not_installed(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SOLVERS, "absent", "a_module_that_is_not_installed:Solver")
    common = ("--instances", inputs.small, "--out", tmp_path, "--solvers")
    assert "No module named 'a_module_that_is_not_installed'" in user_error(capsys, *common, "absent")
    monkeypatch.setitem(sys.modules, "rich.console", None)
    assert "pip install 'sb3-uav[solvers]'" in user_error(capsys, *common, "kmeans-nearest")
    assert list(tmp_path.iterdir()) == []


def test_nothing_to_evaluate_in_python(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one solver"):
        evaluate([], UniformGenerator(3)(1, np.random.default_rng(0)), tmp_path)
    with pytest.raises(ValueError, match="at least one solver and one set"):
        evaluate([make_solver("random-nearest")], {}, tmp_path)


# -------------------------------------------------------------------------------------------------------------- the command


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    for option, text in (("--version", f"sb3-uav {sb3_uav.__version__}\n"), ("--help", "evaluate zips and solvers")):
        with pytest.raises(SystemExit) as stop:
            cli.main([option])
        assert stop.value.code == 0
        assert text in capsys.readouterr().out


def test_unknown_command_names_the_choices(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fly"])
    assert stop.value.code == 2
    assert "evaluate" in capsys.readouterr().err


@pytest.mark.parametrize("command", sorted(cli.FORWARDED))
def test_forwarded_commands(command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Everything after the command reaches its own parser, options included; its exit code comes back."""
    module = types.ModuleType(f"sb3_uav.zoo.{command}")
    received: list[Any] = []

    def main(argv: list[str]) -> int | None:
        received.append(argv)
        if "fail" in argv:
            raise FileNotFoundError("no\nsuch file")
        return 3 if "three" in argv else None

    module.main = main  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    assert cli.main([command, "--help", "-f", "x", "three"]) == 3
    assert cli.main([command]) == 0
    assert received == [["--help", "-f", "x", "three"], []]
    assert cli.main([command, "fail"]) == 2
    assert capsys.readouterr().err == "sb3-uav: error: no such file\n"


def test_as_a_process(inputs: Inputs, tmp_path: Path) -> None:
    """What a shell sees: a table on the standard output, remarks on the standard error, the exit code."""
    command = [sys.executable, "-m", "sb3_uav.zoo.cli", "evaluate", "--instances", str(inputs.small), "--out", str(tmp_path)]
    done = subprocess.run([*command, "--solvers", "random-nearest"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr.endswith("random-nearest on U3-N20: 4 instances\n")
    assert "random-nearest" in done.stdout
    assert [row["solver"] for row in read_results(tmp_path)] == ["random-nearest"] * 4
    assert tuple(read_results(tmp_path)[0]) == RESULT_COLUMNS


def test_unreachable_tasks_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They are no error, because the paper's distribution has them too, but a user should know."""
    far = Instances.from_arrays([0.0, 0.0], [[0.5, 0.0], [3.0, 0.0], [0.0, 1.1]], max_distance=2.0, n_uavs=1)
    far.save(tmp_path / "far.npz")
    assert run("--solvers", "kmeans-nearest", "--instances", tmp_path / "far.npz", "--out", tmp_path / "out") == 0
    assert "far: 2 of 3 tasks lie farther than max_distance / 2 from their depot" in capsys.readouterr().err
    assert read_results(tmp_path / "out")[0]["objective"] == "1.0"

"""``sb3-uav evaluate``: the files it writes, the table it prints, and what it says to wrong input."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from test_evaluation import Stub

import sb3_uav
from sb3_uav.cli import main as cli
from sb3_uav.common.files import file_hash
from sb3_uav.common.optional import install_command
from sb3_uav.envs import BatchedVecEnv, Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import schedule_from_json
from sb3_uav.evaluation.results import RESULT_COLUMNS
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import SOLVERS, SolverResult
from sb3_uav.solvers.limits import deadline_after

TINY = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)


class Inputs:
    """Files on disk: a pair of zips for 3 UAVs, and instances of two sizes."""

    def __init__(self, folder: Path) -> None:
        self.allocator, self.router = folder / "allocator.zip", folder / "router.zip"
        self.small, self.large = folder / "U3-N20.npz", folder / "U3-N60.npz"
        env = make_vec_env("TaskAllocation-U3-N20-v0", 4, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
        # Two algorithms, because a zip may come from any.
        policy: Any = AllocatorPolicy
        PPO(policy, env, n_steps=16, policy_kwargs=dict(TINY, shared_scorer=False), seed=0, device="cpu").save(self.allocator)
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
        assert tuple(reader.fieldnames or ()) == RESULT_COLUMNS
        return list(reader)


def read_summary(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_schedules(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "schedules.jsonl").read_text().splitlines()]


def user_error(capsys: pytest.CaptureFixture[str], *arguments: Any) -> str:
    """Run a command that must fail, and return its one line on the standard error."""
    capsys.readouterr()
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("sb3-uav evaluate: error: ")]
    assert len(lines) == 1 and "Traceback" not in captured.err and captured.out == ""
    return lines[0]


class Interrupted(Stub):
    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        raise KeyboardInterrupt


class Refusing(Stub):
    def __init__(self, time_limit: float) -> None:
        deadline_after(time_limit, "refusing")


class Timed(Stub):
    """Visits a task only if it has more than a second, and refuses to work without any time."""

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        if time_limit is None or time_limit == 0:
            raise ValueError("Give timed a time limit above 0.")
        tasks = [[int(reachable.nonzero()[0, 0])] if time_limit > 1 else [] for reachable in instances.reachable()]
        return [SolverResult(Schedule([route]), time_limit) for route in tasks]


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
        _, index, schedule = schedule_from_json(line, "schedules.jsonl")
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
    monkeypatch.setitem(SOLVERS, "broken", f"{__name__}:OutOfRange")
    assert run("--solvers", "broken", "random-nearest", "--instances", inputs.small, "--out", tmp_path) == 1
    assert "sb3-uav: wrong: broken, instance 0 of U3-N20: UAV 1 visits task 99" in capsys.readouterr().err
    assert [row["feasible"] for row in read_results(tmp_path)] == ["False"] * 4 + ["True"] * 4


def test_pairs_side_by_side(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Zips are solvers like others; the options of the pair and those of a spec give the same schedules."""
    zips = f"allocator={inputs.allocator},router={inputs.router}"
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


def test_device_and_batch_size_are_for_all_networks(inputs: Inputs, tmp_path: Path) -> None:
    zips = f"allocator={inputs.allocator},router={inputs.router}"
    common = ("--instances", inputs.small, "--out", tmp_path, "--batch-size", 3, "--device", "cpu", "--solvers")
    assert run(*common, f"kmeans-am:router={inputs.router}", f"dl-drl:{zips},batch_size=2", "random-nearest") == 0
    assert [row["batch_size"] for row in read_results(tmp_path)] == ["3"] * 3 + ["1"] + ["2"] * 4 + ["1"] * 4


# ------------------------------------------------------------------------------------------- interruptions and other troubles


def test_going_on_after_ctrl_c(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was found stays; the same call goes on from there, and --overwrite starts anew."""
    common = ("--instances", inputs.small, "--out", tmp_path, "--solvers", "random-nearest")
    monkeypatch.setitem(SOLVERS, "halting", f"{__name__}:Interrupted")
    assert run(*common, "halting") == 130
    message = capsys.readouterr().err
    assert f"{tmp_path} holds the results so far; the same command goes on from there" in message
    assert message.endswith("sb3-uav evaluate: interrupted\n")
    before = (tmp_path / "results.csv").read_text()
    assert [row["solver"] for row in read_results(tmp_path)] == ["random-nearest"] * 4

    monkeypatch.setitem(SOLVERS, "halting", f"{__name__}:Stub")
    assert run(*common, "halting") == 0
    assert "random-nearest on U3-N20: 4 instances, 4 of them done before" in capsys.readouterr().err
    assert (tmp_path / "results.csv").read_text().startswith(before)
    assert len(read_results(tmp_path)) == 8

    assert run(*common, "--overwrite", "--seed", 1) == 0
    assert "done before" not in capsys.readouterr().err
    assert [row["seed"] for row in read_results(tmp_path)] == ["1"] * 4
    # The instances are other ones than those of the folder.
    assert "holds results of other instances" in user_error(capsys, *common, "--instances", inputs.large)
    assert [row["seed"] for row in read_results(tmp_path)] == ["1"] * 4


def test_zips_of_other_parameters_are_not_mixed_up(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A zip that was trained on, under its old name, is another solver."""
    env = make_vec_env("RoutePlanning-N20-v0", 1, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
    router = tmp_path / "router.zip"
    arguments = ("--instances", inputs.small, "--out", tmp_path / "out", "--solvers", f"kmeans-am:router={router},name=AM")
    for seed in (1, 2):
        REINFORCE(RouterPolicy, env, policy_kwargs=dict(TINY), seed=seed, device="cpu").save(router)
        if seed == 1:
            assert run(*arguments) == run(*arguments) == 0
    message = user_error(capsys, *arguments)
    assert re.search(r"holds results of another 'AM', whose router was '[0-9a-f]{8}' and not '[0-9a-f]{8}'; give it", message)
    assert run(*arguments, "--overwrite") == 0


def test_solvers_that_fail_leave_the_others(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not installed, not for this fleet, no time: each is named, the others are evaluated, the exit code is 3."""
    monkeypatch.setitem(SOLVERS, "absent", "a_module_that_is_not_installed:Solver")
    monkeypatch.setitem(SOLVERS, "timed", f"{__name__}:Timed")
    monkeypatch.setitem(SOLVERS, "refusing", f"{__name__}:Refusing")
    UniformGenerator(5, n_uavs=5)(1, np.random.default_rng(0)).save(tmp_path / "U5.npz")
    code = run(
        *inputs.pair, "--instances", inputs.small, tmp_path / "U5.npz", "--out", tmp_path / "out",
        "--time-limit", 0, "--solvers", "absent", "refusing:time_limit=0", "timed", "random-nearest",
    )  # fmt: skip
    assert code == 3
    captured = capsys.readouterr()
    for message in (
        "DL-DRL (greedy) failed on 1 of 1 instances of U5: The allocator was trained for 3 UAVs",
        "absent failed on 4 of 4 instances of U3-N20: No module named 'a_module_that_is_not_installed'",
        "refusing:time_limit=0 failed on 4 of 4 instances of U3-N20: time_limit of refusing is 0 seconds; it must be",
        "timed failed on 4 of 4 instances of U3-N20: Give timed a time limit above 0.",
    ):
        assert f"sb3-uav: {message}" in captured.err
    printed = [line.split() for line in captured.out.splitlines() if "random-nearest" in line]
    assert [line[-1] for line in printed] == ["4/4", "1/1"]
    good = [(row["solver"], row["source"]) for row in read_results(tmp_path / "out") if row["status"] == "ok"]
    assert good == [
        *[("DL-DRL (greedy)", "U3-N20")] * 4,
        *[("random-nearest", "U3-N20")] * 4,
        ("random-nearest", "U5"),
    ]


def test_gurobi_without_a_licence(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The others are evaluated."""
    pytest.importorskip("gurobipy")
    licence = tmp_path / "gurobi.lic"
    licence.write_text("EXPIRATION=2001-01-01\nKEY=00000000\n")
    monkeypatch.setenv("GRB_LICENSE_FILE", str(licence))
    arguments = ("--instances", inputs.small, "--out", tmp_path / "out", "--time-limit", 1)
    assert run(*arguments, "--solvers", "random-nearest", "milp:backend=gurobi,name=exact") == 3
    assert "sb3-uav: exact failed on 4 of 4 instances of U3-N20: Gurobi found no valid licence" in capsys.readouterr().err
    assert [row["status"] for row in read_results(tmp_path / "out")] == ["ok"] * 4 + ["failed"] * 4


@pytest.mark.parametrize("solver", ["pyvrp", "ortools", "ortools-gls", "milp", "kmeans-vnd"])
def test_a_package_that_goes_and_comes_back(
    solver: str, inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A solver has the same name and the same time limits without its package: nothing is lost, nothing stays failed."""
    packages = {"pyvrp": "pyvrp", "milp": "highspy", "kmeans-vnd": "numba"}
    common = ("--instances", inputs.small, "--out", tmp_path, "--time-limit", 0.05, "--reference", "best")
    arguments = (*common, "--solvers", f"{solver}:name=best", "random-nearest")

    def statuses() -> list[str]:
        return [row["status"] for row in read_results(tmp_path) if row["solver"] == "best"]

    with monkeypatch.context() as context:
        context.setitem(sys.modules, packages.get(solver, "ortools.constraint_solver.pywrapcp"), None)
        assert run(*arguments) == 3
        assert "sb3-uav: best failed on 4 of 4 instances" in (message := capsys.readouterr().err)
        assert install_command("solvers") in message and statuses() == ["failed"] * 4
    assert run(*arguments) == 0 and statuses() == ["ok"] * 4
    with monkeypatch.context() as context:
        context.setitem(sys.modules, packages.get(solver, "ortools.constraint_solver.pywrapcp"), None)
        assert run(*arguments) == 0 and statuses() == ["ok"] * 4


def test_a_solver_of_which_nothing_was_known(inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Failures at a time limit do not outlive that the solver turns out to use none."""
    monkeypatch.setitem(SOLVERS, "late", "a_module_that_is_not_installed:Solver")
    arguments = ("--instances", inputs.small, "--out", tmp_path, "--time-limit", 1, "--solvers", "late", "random-nearest")
    assert run(*arguments) == 3
    monkeypatch.setitem(SOLVERS, "late", SOLVERS["random-nearest"])
    assert run(*arguments) == 0
    assert [row["status"] for row in read_results(tmp_path)] == ["ok"] * 8


def test_wrong_schedules_count_more_than_failures(inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOLVERS, "absent", "a_module_that_is_not_installed:Solver")
    monkeypatch.setitem(SOLVERS, "broken", f"{__name__}:OutOfRange")
    common = ("--instances", inputs.small, "--out", tmp_path, "--solvers")
    assert run(*common, "broken", "absent", "random-nearest") == 1
    assert run(*common, "absent", "random-nearest") == 3
    assert run(*common, "random-nearest") == 0


def test_several_time_limits(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SOLVERS, "timed", f"{__name__}:Timed")
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
    message = user_error(capsys, *inputs.pair, "--instances", tmp_path / "U5.npz", "--out", tmp_path / "out")
    assert "U5: DL-DRL (greedy) cannot solve these instances" in message and "trained for 3 UAVs" in message
    zips = f"allocator={inputs.router},router={inputs.router}"
    assert "exchanged" in user_error(capsys, *common, "--solvers", "random-nearest", f"dl-drl:{zips}")
    assert "no such file" in user_error(capsys, *common, "--solvers", "random-nearest", "kmeans-am:router=none.zip")
    assert not (tmp_path / "out").exists()


def test_wrong_arguments(inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("--instances", inputs.small, "--out", tmp_path / "out")
    solver = (*common, "--solvers", "kmeans-nearest")
    for arguments, message in (
        (common, "There is nothing to evaluate: give --allocator with --router, or --solvers."),
        ((*common, "--allocator", inputs.allocator), "--allocator and --router go together; --router is missing."),
        ((*solver, "--router", inputs.router), "--allocator and --router go together; --allocator is missing."),
        ((*solver, "--untrained"), "--untrained needs --allocator and --router"),
        ((*common, "--solvers", "magic"), "Unknown solver 'magic'; choose one of ['dl-drl', 'dl-drl-i'"),
        ((*common, "--solvers", "kmeans-nearest:k=3"), "has no option 'k=3'; its options are: name=<str>, restarts=<int>"),
        ((*solver, "kmeans-nearest"), "Solver 'kmeans-nearest' is given twice"),
        ((*solver, "--seed", -1), "The seed is -1; it must be at least 0."),
        ((*solver, "--jobs", 0), "The number of jobs is 0; give at least 1."),
        ((*solver, "--time-limit", 1, -1), "A time limit is -1.0; it must be a number of seconds, at least 0."),
        ((*solver, "--reference", "magic"), "The reference 'magic' is none of the solvers ['kmeans-nearest']."),
        ((*common, "--solvers", "kmeans-am"), "Solver 'kmeans-am' needs the option router=<str>"),
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
    message = user_error(capsys, *common, "absent")
    assert "absent cannot solve these instances: No module named 'a_module_that_is_not_installed'" in message
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with monkeypatch.context() as context:
        context.setitem(sys.modules, "tqdm", None)
        message = user_error(capsys, *common, "kmeans-nearest")
        assert f"progress bar needs tqdm; run: {install_command('solvers')}" in message
    monkeypatch.setitem(sys.modules, "rich.console", None)
    assert install_command("solvers") in user_error(capsys, *common, "kmeans-nearest")
    assert list(tmp_path.iterdir()) == []


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
        "  3    a solver or its licence is missing",
        "dl-drl-i:",
    ):
        assert word in text


@pytest.mark.parametrize("argv", [[], ["--"], ["--", "evaluate"], ["--nonsense"]])
def test_no_command(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(argv)
    assert stop.value.code == 2 and "sb3-uav: error: " in capsys.readouterr().err


@pytest.mark.parametrize("command", sorted(cli.FORWARDED))
def test_forwarded_commands(command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Everything after the command reaches its own parser, options included; its exit code comes back."""
    module = types.ModuleType(cli.FORWARDED[command][0])
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
    assert capsys.readouterr().err == f"sb3-uav {command}: error: no such file\n"


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

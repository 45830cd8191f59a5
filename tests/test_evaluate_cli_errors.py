"""``sb3-uav evaluate``: what it says to wrong input, and to solvers that fail."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluate_cli_helpers import TINY, Inputs, read_results, run, user_error
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.common.optional import install_command
from sb3_uav.envs import BatchedVecEnv, UniformGenerator
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import SOLVERS

# ------------------------------------------------------------------------------------------- interruptions and other troubles


def test_resuming_after_ctrl_c(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Results stay; the same command resumes, and --overwrite starts over."""
    common = ("--instances", inputs.small, "--out", tmp_path, "--solvers", "random-nearest")
    monkeypatch.setitem(SOLVERS, "halting", "evaluate_cli_helpers:Interrupted")
    assert run(*common, "halting") == 130
    message = capsys.readouterr().err
    line = message.splitlines()[-1]
    assert (
        line.startswith("sb3-uav evaluate: interrupted; continue with sb3-uav evaluate --instances ") and str(tmp_path) in line
    )
    before = (tmp_path / "results.csv").read_text()
    assert [row["solver"] for row in read_results(tmp_path)] == ["random-nearest"] * 4

    monkeypatch.setitem(SOLVERS, "halting", "evaluation_helpers:Stub")
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
    monkeypatch.setitem(SOLVERS, "timed", "evaluate_cli_helpers:Timed")
    monkeypatch.setitem(SOLVERS, "refusing", "evaluate_cli_helpers:Refusing")
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


def test_gurobi_without_a_license(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The others are evaluated."""
    pytest.importorskip("gurobipy")
    license = tmp_path / "gurobi.lic"
    license.write_text("EXPIRATION=2001-01-01\nKEY=00000000\n")
    monkeypatch.setenv("GRB_LICENSE_FILE", str(license))
    arguments = ("--instances", inputs.small, "--out", tmp_path / "out", "--time-limit", 1)
    assert run(*arguments, "--solvers", "random-nearest", "milp:backend=gurobi,name=exact") == 3
    assert "sb3-uav: exact failed on 4 of 4 instances of U3-N20: Gurobi found no valid license" in capsys.readouterr().err
    assert [row["status"] for row in read_results(tmp_path / "out")] == ["ok"] * 4 + ["failed"] * 4


@pytest.mark.parametrize(
    "spec, message",
    [
        ("kmeans-nearest:restarts=0", "restarts of kmeans-nearest is 0; K-means needs at least 1 start"),
        ("kmeans-nearest:restart=3", "has no option 'restart=3'; its options are: name=<str>, restarts=<int>"),
        ("kmeans-am:router=none.zip", "none.zip: no such file"),
        ("dl-drl:allocator='a.zip,router=b.zip", "begins with a quote; end it with another one"),
        ("kmeans-neerest", "Unknown solver 'kmeans-neerest'; choose one of"),
    ],
)
def test_a_bad_option_of_one_solver_leaves_the_others(
    spec: str, message: str, inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is named, and failed rows stand for it; alone, it is wrong input."""
    common = ("--instances", inputs.small, "--out", tmp_path / "out", "--solvers")
    assert message in user_error(capsys, *common, spec)
    assert not (tmp_path / "out").exists()
    assert run(*common, spec, "random-nearest") == 3
    assert f"{spec} failed on 4 of 4 instances of U3-N20: " in (text := capsys.readouterr().err) and message in text
    assert [row["status"] for row in read_results(tmp_path / "out")] == ["failed"] * 4 + ["ok"] * 4


def test_a_corrected_option_takes_the_place_of_the_failure(inputs: Inputs, tmp_path: Path) -> None:
    """Also under the same name; and a solver that worked once is not forgotten while it cannot be made."""
    common = ("--instances", inputs.small, "--out", tmp_path, "--solvers", "random-nearest")
    assert run(*common, "kmeans-am:router=none.zip,name=AM") == 3
    assert run(*common, f"kmeans-am:router={inputs.router},name=AM") == 0
    assert run(*common, "kmeans-am:router=none.zip,name=AM") == 0
    told = json.loads((tmp_path / "evaluation.json").read_text())["solvers"]
    assert list(told) == ["random-nearest", "AM"] and told["AM"]["settings"]["restarts"] == 10
    assert [row["status"] for row in read_results(tmp_path)] == ["ok"] * 8


@pytest.mark.parametrize("solver", ["pyvrp", "ortools", "ortools-gls", "milp", "kmeans-vnd"])
def test_a_package_that_goes_and_comes_back(
    solver: str, inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A solver has the same name and the same time limits without its package: nothing is lost, nothing stays failed."""
    packages = {"pyvrp": "pyvrp", "milp": "highspy", "kmeans-vnd": "numba"}
    UniformGenerator(4, 2)(4, np.random.default_rng(0)).save(tmp_path / "tiny.npz")
    # MILP needs as long as the machine needs; the others always find something.
    limit = 600 if solver == "milp" else 0.05
    common = ("--instances", tmp_path / "tiny.npz", "--out", tmp_path / "out", "--time-limit", limit, "--reference", "best")
    arguments = (*common, "--solvers", f"{solver}:name=best", "random-nearest")

    def statuses() -> list[str]:
        return [row["status"] for row in read_results(tmp_path / "out") if row["solver"] == "best"]

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
    monkeypatch.setitem(SOLVERS, "broken", "evaluate_cli_helpers:OutOfRange")
    common = ("--instances", inputs.small, "--out", tmp_path, "--solvers")
    assert run(*common, "broken", "absent", "random-nearest") == 1
    assert run(*common, "absent", "random-nearest") == 3
    assert run(*common, "random-nearest") == 0


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
    assert "exchanged" in user_error(capsys, *common, "--solvers", f"dl-drl:{zips}")
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

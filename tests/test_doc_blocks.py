"""Every code block of the README, the guide for contributors, the docs and the model cards runs; see `doc_blocks.py`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from doc_blocks import (
    NOT_RUN,
    PAGES,
    ROOT,
    RULES,
    TESTED_ELSEWHERE,
    blocks_to_run,
    code_blocks,
    command_lines,
    named_file,
    prepare,
    run_command_line,
    smaller,
    train_yaml,
    without_lines,
)
from forked import run_forked
from PIL import Image

from sb3_uav.envs import Instances, check_schedule
from sb3_uav.missions import load_plan
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE

# Seconds for one command.
LIMIT = 600.0
# Packages that are needed where a word stands in a block.
NEEDED = {
    "ortools": "ortools",
    "pyvrp": "pyvrp",
    "repair": "numba",
    "kmeans-vnd": "numba",
    "onnx": "onnxscript",
    "sb3-uav": "rl_zoo3",
    "sb3-uav solve": "plotly",
    "read_tasks": "pyproj",
}
ALGORITHMS = ("reinforce", "ppo", "ppo_mask", "a2c")


def test_every_rule_is_used() -> None:
    """Otherwise a page has changed, and its block would run in full."""
    used: set[Any] = set()
    for page in PAGES:
        for _, text in code_blocks(page):
            smaller(page, without_lines(page, text, used), used)
    assert [rule for rule in (*RULES, *NOT_RUN) if rule not in used] == []


def test_rules_leave_no_command_out() -> None:
    """Only `NOT_RUN` does, which says why."""
    for page in PAGES:
        for language, text in code_blocks(page):
            if language in ("bash", "sh"):
                before, after = (list(command_lines(block)) for block in (text, smaller(page, text)))
                assert [line.split()[0] for line in before] == [line.split()[0] for line in after], f"{page}: {text}"
    assert all(len(entry.reason.split()) > 3 for entry in NOT_RUN)


# ------------------------------------------------------------------------------------------------------ pages

Check = Callable[[Path, dict[str, Any]], None]


def check_readme(folder: Path, variables: dict[str, Any]) -> None:
    for name, kind in (("allocator", AllocatorPolicy), ("router", RouterPolicy)):
        load_policy(folder / "run" / f"{name}.zip", expected=kind)
    instances = Instances.load(folder / "my_instances.npz")
    assert instances.n_uavs == 4 and len(variables["schedules"]) == 2
    for row, schedule in enumerate(variables["schedules"]):
        assert check_schedule(instances, row, schedule).objective > 60
    runs = folder / "logs" / "reinforce"
    assert (runs / "TaskAllocation-U4-N80-v0_2" / "TaskAllocation-U4-N80-v0.zip").is_file()


def check_training(folder: Path, variables: dict[str, Any]) -> None:
    assert type(variables["model"].policy) is RouterPolicy and variables["model"].num_timesteps >= 320
    assert (folder / "logs" / "ppo" / "RoutePlanning-N20-v0_1" / "RoutePlanning-N20-v0.zip").is_file()


def check_tensorboard(folder: Path, variables: dict[str, Any]) -> None:
    assert len(variables["maps"]) >= 2 and variables["drawn"].step > 0
    for drawn in variables["maps"]:
        with Image.open(folder / f"step_{drawn.step}.png") as picture:
            assert picture.format == "PNG" and min(picture.size) > 100


def check_policies(folder: Path, variables: dict[str, Any]) -> None:
    assert (folder / "policy.onnx").stat().st_size > 1000


def check_fine_tuning(folder: Path, variables: dict[str, Any]) -> None:
    assert type(variables["model"]) is REINFORCE and type(variables["again"].policy) is RouterPolicy
    runs = folder / "logs" / "reinforce"
    for name in ("TaskAllocation-U4-N100-v0_1", "TaskAllocation-U4-N150-v0_1"):
        # Of the shipped pair, not of the YAML.
        assert load_policy(runs / name / "router.zip").settings.n_layers == 4
    rows = (folder / "results" / "results.csv").read_text(encoding="utf-8").splitlines()
    assert sum("sb3:zip=" in row for row in rows) == 2 * 16


def check_benchmarks(folder: Path, variables: dict[str, Any]) -> None:
    rows = (folder / "results" / "p7" / "gaps.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 1 + 2 * 4 and all(",ok," in row for row in rows[1:])
    assert (folder / "results" / "p7" / "anytime.png").is_file()
    assert [row.instance for row in variables["rows"]] == ["a1.2.a", "a1.2.b"]


def check_missions(folder: Path, variables: dict[str, Any]) -> None:
    for name, n_tasks, least in (("orchard", 120, 108), ("city", 400, 180), ("lattice", 100, 88)):
        plan = load_plan(folder / name / "mission.json")
        assert len(plan.tasks) == n_tasks and plan.n_served >= least and not plan.unserved
    again = load_plan(folder / "lattice-replanned" / "mission.json")
    assert [uav.id for uav in again.fleet] == ["uav-1", "uav-2", "uav-4"] and "gate" in again.tasks.ids
    assert {path.name for path in variables["files"]} == {path.name for path in (folder / "orchard").iterdir()}


CHECKS: dict[str, Check] = {
    "docs/missions.md": check_missions,
    "docs/benchmarks.md": check_benchmarks,
    "docs/fine_tuning.md": check_fine_tuning,
    "README.md": check_readme,
    "docs/training.md": check_training,
    "docs/tensorboard.md": check_tensorboard,
    "docs/policies.md": check_policies,
}


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if code_blocks(page)])
def test_code_blocks_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = list(blocks_to_run(page))
    for word, package in NEEDED.items():
        if any(word in block.text for block in blocks):
            pytest.importorskip(package)
    prepare(tmp_path, page)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    variables: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks:
        where = f"{page}, code block {block.number}"
        name = named_file(block)
        if name is not None:
            (tmp_path / name).write_text(block.text, encoding="utf-8")
        try:
            if block.language == "python":
                exec(compile(block.text, where, "exec"), variables)
            elif block.language == "yaml":
                algo = Path(name or "").stem
                run_forked(train_yaml, tmp_path, block.text, algo if algo in ALGORITHMS else "reinforce", limit=LIMIT)
            else:
                for line in command_lines(block.text):
                    where = f"{page}, code block {block.number}: {line}"
                    run_forked(run_command_line, tmp_path, line, limit=LIMIT)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"{where}\n{error}") from error
    if page in CHECKS:
        CHECKS[page](tmp_path, variables)


@pytest.mark.parametrize(("page", "test"), TESTED_ELSEWHERE.items())
def test_pages_with_a_test_of_their_own(page: str, test: str) -> None:
    """The page exists, and that test reads it."""
    assert (ROOT / page).is_file() and Path(page).name in (Path(__file__).parent / test).read_text(encoding="utf-8")

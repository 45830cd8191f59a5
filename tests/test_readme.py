"""What the README shows works as it stands, but for the size of the run."""

import io
import re
import shlex
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from sb3_uav.cli import main as cli
from sb3_uav.envs import Instances, check_schedule
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy

ROOT = Path(__file__).parents[1]


def python_examples(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)


PLANNING, TRAINING = python_examples("README.md")
(PPO,) = python_examples("docs/training.md")


def test_example_of_training(tmp_path, monkeypatch):
    example = TRAINING
    assert len([line for line in example.splitlines() if line and "import" not in line]) <= 8
    for full, small in (
        ("n_envs=64", "n_envs=4"),
        ("instances_per_epoch=2560", "instances_per_epoch=8"),
        ("n_epochs=10", "n_epochs=1"),
    ):
        assert full in example
        example = example.replace(full, small)
    monkeypatch.chdir(tmp_path)
    exec(example, {})
    load_policy(tmp_path / "run" / "allocator.zip", expected=AllocatorPolicy)
    load_policy(tmp_path / "run" / "router.zip", expected=RouterPolicy)


def test_example_of_ppo():
    example = PPO
    for full, small in (("n_envs=64", "n_envs=4"), ("learn(300_000)", "learn(320)")):
        assert full in example
        example = example.replace(full, small)
    variables: dict[str, Any] = {}
    exec(example, variables)
    assert type(variables["model"].policy) is RouterPolicy and variables["model"].num_timesteps >= 320


def test_example_of_planning(tmp_path, monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.chdir(tmp_path)
    variables: dict[str, Any] = {}
    exec(PLANNING.replace("rand(16, ", "rand(2, "), variables)
    instances = Instances.load(tmp_path / "my_instances.npz")
    assert instances.n_uavs == 4 and len(variables["schedules"]) == 2
    for row, schedule in enumerate(variables["schedules"]):
        assert check_schedule(instances, row, schedule).objective > 60


# ------------------------------------------------------------------------------------------------------ shell commands

PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]


def shell_commands() -> list[list[str]]:
    """Every `sb3-uav ...` of the pages, as a list of words."""
    found = []
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8").replace("\\\n", " ")
        for block in re.findall(r"```(?:bash|sh)\n(.*?)```", text, flags=re.DOTALL):
            lines = [shlex.split(line, comments=True) for line in block.splitlines()]
            found += [words for words in lines if words[:1] == ["sb3-uav"]]
    return found


@cache
def help_text(command: str) -> str:
    """What the command prints for --help."""
    printed = io.StringIO()
    with redirect_stdout(printed), pytest.raises(SystemExit):
        cli.main([command, "--help"])
    return printed.getvalue()


@pytest.mark.parametrize("words", shell_commands(), ids=lambda words: " ".join(words)[:60])
def test_shell_commands_have_the_flags_that_pages_show(words):
    pytest.importorskip("rl_zoo3")
    if "plot" in words[1]:
        # rl_zoo3 imports it before it parses anything.
        pytest.importorskip("seaborn")
    known = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", help_text(words[1])))
    assert {word for word in words[2:] if re.match(r"--?[a-zA-Z]", word)} <= known

"""docs/zoo.md: every block runs, in the order of the page, with small networks and budgets."""

from __future__ import annotations

import re
import shlex
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rl_zoo3")
from tiny_zoo import ENV, NETWORK, entry
from zoo_hub import Hub

from sb3_uav.cli import main as cli

PAGE = (Path(__file__).parents[1] / "docs" / "zoo.md").read_text(encoding="utf-8")
NEEDED = {"record-video": ["moviepy"]}
NEEDED |= {name: ["seaborn", "scipy.spatial"] for name in ("all-plots", "plot-from-file", "plot-train")}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


def commands() -> list[list[str]]:
    lines = [line for block in blocks("bash") for line in block.replace("\\\n", " ").splitlines()]
    return [[word for word in shlex.split(line) if word != "PYTHONPATH=."] for line in lines]


def can_run(command: str) -> bool:
    try:
        for name in NEEDED.get(command, []):
            __import__(name)
    except ImportError:
        return False
    return True


def small(words: list[str]) -> list[str]:
    """The arguments of a command with a small budget."""
    arguments = [{"100000": "160", "200": "60", "2000": "60"}.get(word, word) for word in words[1:]]
    if words[1] == "train":
        arguments += ["--eval-freq", "160", "--eval-episodes", "2"]
        arguments += [] if "--conf-file" in words else ["--conf-file", "tiny.yml"]
    return arguments + (["--n-eval-episodes", "2", "--no-render"] if words[1] == "push-to-hub" else [])


@pytest.mark.slow
def test_every_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)
    Hub.install(tmp_path / "hub", monkeypatch)
    fake = types.ModuleType("wandb")
    fake.init = lambda **_: types.SimpleNamespace(config=types.SimpleNamespace(setdefaults=print))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", fake)
    (code,), (settings,) = blocks("python"), blocks("yaml")
    Path("my_fleet.py").write_text(code)
    entries = yaml.safe_load(settings)
    entries["TaskAllocation-v0"] |= dict(policy_kwargs=NETWORK, n_envs=2, n_samples=2, n_timesteps=80, instances_per_epoch=2)
    Path("my_fleet.yml").write_text(yaml.safe_dump(entries))
    plain = {key: value for key, value in entry(n_timesteps=40).items() if key != "callback"}
    others = {name: {**plain, "n_envs": 2} for name in ("TaskAllocation-v0", "TaskAllocation-U4-N80-v0")}
    Path("tiny.yml").write_text(yaml.safe_dump({ENV: entry(), **others}))

    listed = commands()
    assert {words[1] for words in listed} >= {*NEEDED, "train", "enjoy", "benchmark", "load-from-hub"}
    for words in listed:
        if can_run(words[1]):
            assert cli.main(small(words)) == 0, (words, capsys.readouterr().err)
        if words == listed[0]:
            # plot-from-file needs two runs.
            assert cli.main([*small(words), "--seed", "7"]) == 0
    run = tmp_path / "logs" / "reinforce" / f"{ENV}_1"
    assert {"router.zip", "best_router.zip", "router_160_steps.zip", "rl_model_160_steps.zip"} <= {
        p.name for p in run.iterdir()
    }
    assert np.load(run / "evaluations.npz")["successes"].shape == (3, 2)
    assert "TaskAllocation-U3-N20-v0" in (tmp_path / "benchmark.md").read_text()
    assert (tmp_path / "repository" / "README.md").is_file() and (tmp_path / "hub" / "me" / f"reinforce-{ENV}").is_dir()
    for name, command in (("curves.png", "all-plots"), ("boxes.png", "plot-from-file"), ("train.png", "plot-train")):
        assert (tmp_path / name).is_file() == can_run(command)
    assert bool(list((tmp_path / "logs").rglob("*.mp4"))) == can_run("record-video")

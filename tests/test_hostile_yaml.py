"""YAML of strangers: endless aliases, wrong tags, and values of other kinds than a training needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")
import tiny_zoo

from sb3_uav.zoo.configs import default_config, read_yaml
from sb3_uav.zoo.saved import read_saved


def _laughs(merge: bool, levels: int = 30) -> str:
    lines = ["l0: &l0 {a: 1}"]
    for level in range(1, levels):
        aliases = "[" + ", ".join([f"*l{level - 1}"] * 9) + "]"
        lines.append(f"l{level}: &l{level} " + (f"{{<<: {aliases}}}" if merge else aliases))
    return "\n".join(lines)


@pytest.mark.parametrize("read", [read_yaml, read_saved])
@pytest.mark.parametrize(
    "text",
    [
        _laughs(merge=False),
        _laughs(merge=True),
        "a: &a [*a]",
        "a: &a {b: *a}",
        "[" * 3000,
        "a: " + "[" * 60 + "]" * 60,
        "a: !!bool x",
        "a: !!timestamp x",
        "a: !!int x",
        "a: !!python/object/apply:os.abort []",
        "a: 2026-13-45",
        "? [1]\n: 2",
        "a: \0",
        "%YAML 9.9\n--- a",
        "a: b: c",
        "- 1",
        "",
        "a: " + "x" * 2**20,
        "[" + "1," * 2**16 + "]",
        "a: " + "1:" * 2**16 + "1",
        "a: " + "1:" * 2**16 + "1.0",
        "a: 0x" + "f" * 200,
    ],
)
def test_hostile_yaml_is_refused_with_its_name(tmp_path: Path, read: Any, text: str) -> None:
    path = tmp_path / "conf.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"conf\.yml") as found:
        read(path)
    assert len(str(found.value)) < 2000


def test_aliases_and_merges_are_read(tmp_path: Path) -> None:
    path = tmp_path / "conf.yml"
    path.write_text("a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: [*a, *a]\n")
    assert read_yaml(path) == {"a": {"x": 1}, "b": {"x": 1, "y": 2}, "c": [{"x": 1}, {"x": 1}]}
    shipped = default_config("reinforce")
    assert shipped is not None and len(read_yaml(shipped)) > 3


def test_huge_numbers_can_be_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Python refuses to write numbers of more than 4,300 digits, with an error that names nothing."""
    config = tiny_zoo.write_config(tmp_path)
    config.write_text(config.read_text().replace("n_envs: 4", "n_envs: 0x" + "f" * 9000, 1))
    assert tiny_zoo.run(tmp_path, config) == 2
    assert "tiny.yml" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changes",
    [
        tiny_zoo.its_with(
            router=dict(tiny_zoo.its_with()["callback"][0]["sb3_uav.training.ITSCallback"]["router"], n_envs=[])
        ),
        tiny_zoo.its_with(router=dict(policy="RouterPolicy", algo=7)),
        tiny_zoo.its_with(router=dict(policy="RouterPolicy", learning_rate=[])),
        tiny_zoo.its_with(router=dict(policy="RouterPolicy", policy_kwargs=dict(tiny_zoo.NETWORK, n_heads=float("nan")))),
        dict(policy_kwargs=dict(tiny_zoo.NETWORK, mixed_precision=float("inf"))),
    ],
    ids=["n_envs", "algo", "learning_rate", "n_heads", "mixed_precision"],
)
def test_wrong_values_that_training_meets_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any]
) -> None:
    """One line with the file, although the router is made when the training has begun."""
    assert tiny_zoo.run(tmp_path, tiny_zoo.write_config(tmp_path, **changes)) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "error: " in line]
    assert len(errors) == 1 and "tiny.yml" in errors[0]

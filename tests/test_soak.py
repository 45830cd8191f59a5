"""The short form of ``make soak``: what was killed and started again equals what was not."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from forked import run_forked

pytest.importorskip("rl_zoo3")
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def kill_a_few(seed: int) -> None:
    """In a process of its own, whose torch has started no threads."""
    sys.path.insert(0, str(BENCHMARKS))
    import soak

    tally = soak.soak(6, seed, Path("."), say=False)
    print(json.dumps({"kills": tally.n_kills, "chains": dict(tally.chains), "failures": tally.failures}))


@pytest.mark.slow
def test_killed_runs_equal_unbroken_ones(tmp_path: Path) -> None:
    found: dict[str, Any] = json.loads(run_forked(kill_a_few, tmp_path, 3, limit=600.0).splitlines()[-1])
    assert found["failures"] == []
    assert found["kills"] == 6 and set(found["chains"]) == {"train", "evaluate"}


def kill_at_operations(step: int) -> None:
    sys.path.insert(0, str(BENCHMARKS))
    import soak

    scene = soak.evaluation_scene(Path(".").resolve())

    def run(name: str, kill: Any = None) -> Any:
        folder = Path(name).resolve()
        folder.mkdir(exist_ok=True)
        return soak.run_forked(scene.run, folder, kill)

    whole = run("unbroken")
    expected = scene.read(Path("unbroken"))
    for number in range(1, whole.n_operations + 1, step):
        died = run(f"killed_{number}", soak.Kill("before a file operation", number, 0.0))
        assert died.code is None, died
        assert run(f"killed_{number}").code == 0, (died, Path(f"killed_{number}.log").read_text(encoding="utf-8"))
        assert scene.read(Path(f"killed_{number}")) == expected, died
    print(whole.n_operations)


@pytest.mark.slow
def test_evaluations_killed_at_any_instant_are_resumed(tmp_path: Path) -> None:
    assert int(run_forked(kill_at_operations, tmp_path, 3, limit=600.0).splitlines()[-1]) > 30

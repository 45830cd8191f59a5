"""Zips that an earlier version wrote load with the stock classes and still play the same episodes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
ACTIONS: dict[str, list[int]] = json.loads((GOLDEN / "actions.json").read_text(encoding="utf-8"))


def test_there_is_a_zip_of_every_algorithm_and_level():
    names = {
        f"{algorithm}-{level}" for algorithm in ("a2c", "ppo", "ppo_mask", "reinforce") for level in ("allocator", "router")
    }
    assert names == set(ACTIONS) == {path.stem for path in GOLDEN.glob("*.zip")}


@pytest.mark.slow
def test_golden_zips_play_the_episodes_they_played():
    zips = sorted(str(path) for path in GOLDEN.glob("*.zip"))
    done = subprocess.run(
        [sys.executable, str(GOLDEN / "greedy_episodes.py"), *zips], capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {name: [actions, 0] for name, actions in ACTIONS.items()}

"""Zips that an earlier version wrote load with the stock classes and still play the same episodes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
ACTIONS: dict[str, list[int]] = json.loads((GOLDEN / "actions.json").read_text(encoding="utf-8"))

# What a user's script would say: it imports sb3_uav for the environments, and the class of each algorithm.
SCRIPT = """
import json, sys
from pathlib import Path
import gymnasium as gym
import sb3_uav
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO

classes = {"a2c": A2C, "ppo": PPO, "ppo_mask": MaskablePPO}
results = {}
for path in sys.argv[1:]:
    name = Path(path).stem
    algorithm, level = name.split("-")
    if algorithm == "reinforce":
        from sb3_uav.reinforce import REINFORCE
        classes["reinforce"] = REINFORCE
    model = classes[algorithm].load(path, device="cpu")
    if level == "allocator":
        env = gym.make("TaskAllocation-U4-N80-v0", n_tasks=6, n_uavs=2)
    else:
        env = gym.make("RoutePlanning-N80-v0", n_tasks=6)
    observation, _ = env.reset(seed=0)
    actions, done = [], False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, done, truncated, info = env.step(int(action))
        actions.append(int(action))
    results[name] = [actions, info["illegal_actions"]]
print(json.dumps(results))
"""


def test_there_is_a_zip_of_every_algorithm_and_level():
    names = {
        f"{algorithm}-{level}" for algorithm in ("a2c", "ppo", "ppo_mask", "reinforce") for level in ("allocator", "router")
    }
    assert names == set(ACTIONS) == {path.stem for path in GOLDEN.glob("*.zip")}


@pytest.mark.slow
def test_golden_zips_play_the_episodes_they_played():
    zips = sorted(str(path) for path in GOLDEN.glob("*.zip"))
    done = subprocess.run([sys.executable, "-c", SCRIPT, *zips], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {name: [actions, 0] for name, actions in ACTIONS.items()}

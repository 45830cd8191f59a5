"""
Play the greedy episode of every zip named on the command line.

As a user's script would, it imports sb3_uav for the environments, and the class of each algorithm.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO

import sb3_uav  # noqa: F401  (registers the environments)

CLASSES: dict[str, Any] = {"a2c": A2C, "ppo": PPO, "ppo_mask": MaskablePPO}


def greedy_episode(model: Any, level: str) -> tuple[list[int], int]:
    """:return: The actions of the greedy episode on the instance of seed 0, and how many of them were illegal"""
    if level == "allocator":
        env = gym.make("TaskAllocation-U4-N80-v0", n_tasks=6, n_uavs=2)
    else:
        env = gym.make("RoutePlanning-N80-v0", n_tasks=6)
    observation, _ = env.reset(seed=0)
    actions: list[int] = []
    done = False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, done, _, info = env.step(int(action))
        actions.append(int(action))
    return actions, info["illegal_actions"]


def main() -> None:
    results = {}
    for path in sys.argv[1:]:
        algorithm, level = Path(path).stem.split("-")
        if algorithm == "reinforce":
            from sb3_uav.reinforce import REINFORCE

            CLASSES["reinforce"] = REINFORCE
        results[Path(path).stem] = greedy_episode(CLASSES[algorithm].load(path, device="cpu"), level)
    print(json.dumps(results))


if __name__ == "__main__":
    main()

"""
Make the golden zips: what a release wrote, every later version must read.

    python tests/golden/make_golden.py

Run it only to add a zip for a new format, never to repair one that no longer loads.
"""

from __future__ import annotations

import json
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

from greedy_episodes import greedy_episode
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE

FOLDER = Path(__file__).parent
ALGORITHMS: dict[str, Any] = {"a2c": A2C, "ppo": PPO, "ppo_mask": MaskablePPO, "reinforce": REINFORCE}
# Everything that shapes the network is given, so that new defaults do not change what the zips say.
NETWORK = dict(preset="paper", embed_dim=8, n_layers=1, n_heads=2, ff_dim=8, normalization="instance", use_values=True)


def make_env(level: str) -> Any:
    return TaskAllocationEnv(6, 2) if level == "allocator" else RoutePlanningEnv(6)


def repack(path: Path) -> None:
    """Compress a zip, and leave out the description of the machine that wrote it."""
    with zipfile.ZipFile(path) as written:
        contents = {name: written.read(name) for name in written.namelist() if name != "system_info.txt"}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in contents.items():
            packed.writestr(name, content)


def main() -> None:
    expected = {}
    for name, algorithm in ALGORITHMS.items():
        for level, policy in (("allocator", AllocatorPolicy), ("router", RouterPolicy)):
            settings: dict[str, Any] = dict(policy_kwargs=NETWORK, learning_rate=0.01, device="cpu", seed=0)
            if name in ("ppo", "ppo_mask"):
                settings.update(n_steps=12, batch_size=24)
            env = BatchedVecEnv([partial(make_env, level)] * 4)
            model = algorithm(policy, env, **settings)
            model.learn(480)
            model.save(FOLDER / f"{name}-{level}")
            repack(FOLDER / f"{name}-{level}.zip")
            expected[f"{name}-{level}"] = greedy_episode(model, level)[0]
    (FOLDER / "actions.json").write_text(json.dumps(expected, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""A tiny training of both levels through `sb3-uav train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from sb3_uav.zoo import train

ENV = "TaskAllocation-U3-N20-v0"
NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
# Steps of an epoch: 8 instances of 20 tasks.
EPOCH = 8 * 20


def entry(**changes: Any) -> dict[str, Any]:
    router: dict[str, Any] = dict(algo="reinforce", policy="RouterPolicy", n_envs=4, policy_kwargs=NETWORK, learning_rate=1e-3)
    its = dict(router=router, n_epochs=3, n_pretraining_epochs=1, n_intensive_epochs=2, n_continuous_epochs=2)
    settings = dict(
        policy="sb3_uav.policies.AllocatorPolicy",
        policy_kwargs=NETWORK,
        n_envs=4,
        n_timesteps=3 * EPOCH,
        instances_per_epoch=8,
        learning_rate=1e-3,
        callback=[{"sb3_uav.training.ITSCallback": its}],
    )
    return {**settings, **changes}


def write_config(folder: Path, **changes: Any) -> Path:
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump({ENV: entry(**changes)}))
    return path


def run(folder: Path, config: Path, *flags: str) -> int:
    return train.main(["--env", ENV, "--conf-file", str(config), "-f", str(folder / "logs"), "--seed", "1", *flags])


def its_with(**changes: Any) -> dict[str, Any]:
    callback = entry()["callback"]
    callback[0]["sb3_uav.training.ITSCallback"].update(changes)
    return dict(callback=callback)

"""What the tests of ``sb3-uav evaluate`` share: inputs on disk, solvers that fail, and the files read back."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_helpers import Stub
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.cli import main as cli
from sb3_uav.envs import BatchedVecEnv, Instances, Schedule, UniformGenerator
from sb3_uav.evaluation.results import RESULT_COLUMNS
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import SolverResult
from sb3_uav.solvers.limits import deadline_after

TINY = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)


class Inputs:
    """Files on disk: a pair of zips for 3 UAVs, and instances of two sizes."""

    def __init__(self, folder: Path) -> None:
        self.allocator, self.router = folder / "allocator.zip", folder / "router.zip"
        self.small, self.large = folder / "U3-N20.npz", folder / "U3-N60.npz"
        env = make_vec_env("TaskAllocation-U3-N20-v0", 4, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
        # Two algorithms, because a zip may come from any.
        policy: Any = AllocatorPolicy
        PPO(policy, env, n_steps=16, policy_kwargs=dict(TINY, shared_scorer=False), seed=0, device="cpu").save(self.allocator)
        env = make_vec_env("RoutePlanning-N20-v0", 4, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
        REINFORCE(RouterPolicy, env, policy_kwargs=dict(TINY), seed=0, device="cpu").save(self.router)
        UniformGenerator(20, n_uavs=3)(4, np.random.default_rng(0)).save(self.small)
        UniformGenerator(60, n_uavs=3)(2, np.random.default_rng(1)).pad(64).save(self.large)

    @property
    def zips(self) -> str:
        return f"allocator={self.allocator},router={self.router}"

    @property
    def pair(self) -> list[str]:
        return ["--allocator", str(self.allocator), "--router", str(self.router), "--device", "cpu"]


def run(*arguments: Any) -> int:
    return cli.main(["evaluate", *map(str, arguments)])


def read_results(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        assert tuple(reader.fieldnames or ()) == RESULT_COLUMNS
        return list(reader)


def read_summary(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def user_error(capsys: pytest.CaptureFixture[str], *arguments: Any) -> str:
    """Run a command that must fail, and return its one line on the standard error."""
    capsys.readouterr()
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("sb3-uav evaluate: error: ")]
    assert len(lines) == 1 and "Traceback" not in captured.err and captured.out == ""
    return lines[0]


class Interrupted(Stub):
    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        raise KeyboardInterrupt


class Refusing(Stub):
    def __init__(self, time_limit: float) -> None:
        deadline_after(time_limit, "refusing")


class Timed(Stub):
    """Visits a task only if it has more than a second, and refuses to work without any time."""

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        if time_limit is None or time_limit == 0:
            raise ValueError("Give timed a time limit above 0.")
        tasks = [[int(reachable.nonzero()[0, 0])] if time_limit > 1 else [] for reachable in instances.reachable()]
        return [SolverResult(Schedule([route]), time_limit) for route in tasks]


class OutOfRange(Stub):
    def __init__(self) -> None:
        super().__init__([[], [99]])

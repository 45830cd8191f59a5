"""What importing the package registers."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import warnings
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env

import sb3_uav
from sb3_uav.envs import (
    RoutePlanningEnv,
    TaskAllocationEnv,
    UniformGenerator,
)
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.registration import register_envs

PAPER_SIZES = (80, 100, 150, 200, 300, 500)
SMALL_IDS = ["TaskAllocation-U3-N20-v0", "RoutePlanning-N20-v0"]


def test_every_scenario_of_the_paper_is_registered() -> None:
    for n_tasks in PAPER_SIZES:
        routing = gym.spec(f"RoutePlanning-N{n_tasks}-v0").make().unwrapped
        assert isinstance(routing, RoutePlanningEnv) and routing.problem.generator == UniformGenerator(n_tasks, 1, 2.0)
        for n_uavs in (4, 6):
            allocation = gym.spec(f"TaskAllocation-U{n_uavs}-N{n_tasks}-v0").make().unwrapped
            assert isinstance(allocation, TaskAllocationEnv)
            assert allocation.problem.generator == UniformGenerator(n_tasks, n_uavs, 2.0)


@pytest.mark.parametrize(
    ("env_id", "n_tasks", "n_actions", "max_distance"),
    [
        ("TaskAllocation-U3-N20-v0", 20, 3, 1.5),
        ("TaskAllocation-U4-N80-v0", 80, 4, 2.0),
        ("TaskAllocation-U6-N500-v0", 500, 6, 2.0),
        ("RoutePlanning-N20-v0", 20, 21, 1.5),
        ("RoutePlanning-N300-v0", 300, 301, 2.0),
    ],
)
def test_ids_make_what_they_say(env_id: str, n_tasks: int, n_actions: int, max_distance: float) -> None:
    """The benchmark's instances: D = 2 (less in the demo), unit square, unit values."""
    env = gym.make(env_id)
    assert isinstance(env.action_space, gym.spaces.Discrete) and env.action_space.n == n_actions
    env.reset(seed=0)
    problem_env = env.unwrapped
    assert isinstance(problem_env, ProblemEnv)
    instance = problem_env.instance
    assert instance.n_tasks == n_tasks and instance.max_distance.tolist() == [max_distance]
    assert (instance.values == 1).all() and instance.tasks.min() >= 0 and instance.tasks.max() <= 1


def test_registering_again_changes_nothing() -> None:
    before = dict(gym.registry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_envs()
    assert gym.registry == before


def test_import_registers_and_does_nothing_else(tmp_path: Path) -> None:
    """In a fresh process: no heavy module, no output, no change of the command line or the random numbers."""
    script = """
        import random, sys
        import numpy as np
        before = random.getstate(), np.random.get_state()[1].tolist(), list(sys.argv)
        import sb3_uav
        assert (random.getstate(), np.random.get_state()[1].tolist(), list(sys.argv)) == before
        heavy = {"torch", "rl_zoo3", "matplotlib", "stable_baselines3", "sb3_contrib", "pandas"} & set(sys.modules)
        assert not heavy, heavy
        import gymnasium as gym
        assert "TaskAllocation-U4-N80-v0" in gym.registry
        assert sb3_uav.__version__.count(".") >= 1
    """
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(script), "--algo", "unknown"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# Environment checkers


@pytest.mark.parametrize(
    "env_id",
    [
        *SMALL_IDS,
        "TaskAllocation-U4-N80-v0",
        "TaskAllocation-U6-N80-v0",
        "RoutePlanning-N80-v0",
        "TaskAllocation-U6-N500-v0",
        "RoutePlanning-N500-v0",
        "TaskAllocation-U4-N1500-v0",
        "RoutePlanning-N1500-v0",
    ],
)
@pytest.mark.parametrize("wrapped", [True, False])
def test_stable_baselines_env_checker(env_id: str, wrapped: bool) -> None:
    """Without any warning, with and without Gymnasium's own wrappers."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(env_id, render_mode="rgb_array")
        check_env(env if wrapped else env.unwrapped, skip_render_check="1500" in env_id)


@pytest.mark.parametrize("env_id", SMALL_IDS)
def test_gymnasium_env_checker(env_id: str) -> None:
    """Without a warning but the one about unbounded Boxes: coordinates may lie anywhere."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=r".*(minimum|maximum) value is -?infinity")
        gymnasium_check_env(gym.make(env_id).unwrapped)


def test_version() -> None:
    assert sb3_uav.__version__ == (Path(sb3_uav.__file__).parent / "version.txt").read_text().strip()

"""What `docs/fine_tuning.md` shows works as it stands, but for the size of the run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml
from stable_baselines3 import PPO

from sb3_uav.envs import RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE, transfer
from sb3_uav.training import ITSCallback

PAGE = (Path(__file__).parents[1] / "docs" / "fine_tuning.md").read_text(encoding="utf-8")
SHIPPED, OWN = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
(ITS,) = re.findall(r"```yaml\n(.*?)```", PAGE, flags=re.DOTALL)


def test_example_of_the_shipped_pair() -> None:
    example = SHIPPED
    for full, small in (("n_tasks=60", "n_tasks=12"), ("n_envs=16", "n_envs=2"), ("learn(100_000)", "learn(100)")):
        assert full in example
        example = example.replace(full, small)
    variables: dict[str, Any] = {}
    exec(example, variables)
    model = variables["model"]
    assert model.num_timesteps >= 100 and model.problem.generator.n_uavs == 3 and model.problem.task_order == "sweep"


def test_example_of_transfer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    variables: dict[str, Any] = {}
    exec(OWN, variables)
    assert type(variables["model"]) is REINFORCE and type(variables["again"]) is PPO
    assert isinstance(variables["again"].policy, RouterPolicy) and variables["again"].n_epochs == 4


def test_example_of_both_levels() -> None:
    ((name, arguments),) = yaml.safe_load(ITS)["callback"][0].items()
    its = ITSCallback(**arguments)
    assert name == "sb3_uav.training.ITSCallback" and its.router_kwargs == {"learning_rate": 0.0003}
    assert its.router_zip is not None and its.schedule.n_pretraining_epochs == 0
    # The forms in its comment.
    for form in ("universal", {"zip": str(its.router_zip), "algo": "ppo"}):
        assert ITSCallback(form).router_zip == its.router_zip


def test_table_of_settings() -> None:
    """The numbers of the page are those of the code."""
    for env, n_steps in ((TaskAllocationEnv(30), 30), (RoutePlanningEnv(30), 40)):
        assert transfer.fine_tuning_settings("ppo", env) == dict(
            learning_rate=1e-4, n_steps=n_steps, gamma=1.0, gae_lambda=0.98, vf_coef=0.05, n_epochs=4,
            batch_size=n_steps // (4 if n_steps == 40 else 3),
        )  # fmt: skip
        expected = dict(learning_rate=1e-4, n_samples=8, baseline="shared", normalize_advantage=True, max_grad_norm=1.0)
        assert transfer.fine_tuning_settings("reinforce", env) == expected
        assert transfer.fine_tuning_settings("a2c", env)["n_steps"] == n_steps
    with pytest.raises(ValueError, match="env has the spaces of no environment of this package"):
        transfer.fine_tuning_settings("ppo", gym.make("CartPole-v1"))

"""Ids of any size, the YAML entries that they use, and arguments of environments from a YAML."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml

from sb3_uav.envs import RoutePlanningEnv, UniformGenerator
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.registration import ensure_registered, size_of

pytest.importorskip("rl_zoo3")
from stable_baselines3 import PPO
from tiny_zoo import NETWORK, entry

from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.studies.compare.variants import read_variants
from sb3_uav.zoo import enjoy, train
from sb3_uav.zoo.configs import default_config, read_yaml
from sb3_uav.zoo.entries import find_entry, scaled_values
from sb3_uav.zoo.experiment import UAVExperimentManager

GENERIC, NEW = "TaskAllocation-v0", "TaskAllocation-U2-N9-v0"


@pytest.fixture(autouse=True)
def same_registry() -> Iterator[None]:
    before = dict(gym.registry)
    yield
    gym.registry.clear()
    gym.registry.update(before)


def problem(env_id: str, **kwargs: Any) -> Any:
    env = gym.make(env_id, **kwargs).unwrapped
    assert isinstance(env, ProblemEnv)
    return env.problem


def train_tiny(folder: Path, entries: dict[str, Any], env_id: str, *flags: str, algo: str = "reinforce") -> int:
    config = folder / "own.yml"
    config.write_text(yaml.safe_dump(entries))
    arguments = ["--algo", algo, "--env", env_id, "--conf-file", str(config), "-f", str(folder / "logs"), "--seed", "1"]
    return train.main([*arguments, *flags])


# ------------------------------------------------------------------------------------------------------------------ ids


def test_ids_of_any_size_are_registered_when_they_are_needed() -> None:
    assert "TaskAllocation-U7-N123-v0" not in gym.registry and "RoutePlanning-N37-v0" not in gym.registry
    ensure_registered("TaskAllocation-U7-N123-v0")
    ensure_registered("RoutePlanning-N37-v0")
    assert problem("TaskAllocation-U7-N123-v0").generator == UniformGenerator(123, 7, 2.0)
    assert problem("RoutePlanning-N37-v0").generator == UniformGenerator(37, 1, 2.0)
    ensure_registered("TaskAllocation-U3-N20-v0")
    assert problem("TaskAllocation-U3-N20-v0").generator.max_distance == 1.5


def test_ids_without_a_size_take_it_from_their_arguments() -> None:
    assert problem(GENERIC).generator == UniformGenerator(80, 4, 2.0)
    assert problem(GENERIC, n_tasks=40, n_uavs=3, max_distance=1.0).generator == UniformGenerator(40, 3, 1.0)
    assert problem("RoutePlanning-v0").generator == UniformGenerator(80, 1, 2.0)
    assert problem("RoutePlanning-v0", n_tasks=7).generator == UniformGenerator(7, 1, 2.0)


@pytest.mark.parametrize(
    ("env_id", "nearest"),
    [
        ("TaskAlocation-U4-N80-v0", "did you mean TaskAllocation-U4-N80-v0 or"),
        ("TaskAllocation-U04-N80-v0", "did you mean TaskAllocation-U4-N80-v0 or"),
        ("TaskAllocation-U0-N80-v0", "did you mean TaskAllocation-U"),
        ("RoutePlanning-80-v0", "did you mean RoutePlanning-N"),
        ("CartPole-v11", "did you mean CartPole-v1"),
        ("xyz", "which no environment has; There are TaskAllocation-U{V}-N{N}-v0 for any V UAVs and N tasks"),
    ],
)
def test_unknown_ids_are_answered_with_what_exists(env_id: str, nearest: str, tmp_path: Path, capsys: Any) -> None:
    assert size_of(env_id) is None
    with pytest.raises(ValueError, match=re.escape(f"--env is {env_id!r}, which no environment has; ")) as caught:
        ensure_registered(env_id)
    message = str(caught.value)
    assert nearest in message and "TaskAllocation-Universal-v0" in message and "--gym-packages" in message
    for command in (train, enjoy):
        assert command.main(["--env", env_id, "-f", str(tmp_path / "logs")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


# -------------------------------------------------------------------------------------------------------------- entries

SIZES: dict[str, Any] = {"TaskAllocation-U4-N80-v0": {}, "TaskAllocation-U6-N200-v0": {}, "RoutePlanning-N80-v0": {}}


@pytest.mark.parametrize(
    ("entries", "env_id", "env_kwargs", "expected"),
    [
        (SIZES, "TaskAllocation-U4-N80-v0", {}, "TaskAllocation-U4-N80-v0"),
        (SIZES, "TaskAllocation-U5-N120-v0", {}, "TaskAllocation-U4-N80-v0"),
        (SIZES, "TaskAllocation-U5-N150-v0", {}, "TaskAllocation-U6-N200-v0"),
        (SIZES, GENERIC, {"n_tasks": 300, "n_uavs": 7}, "TaskAllocation-U6-N200-v0"),
        (SIZES, GENERIC, {}, "TaskAllocation-U4-N80-v0"),
        (SIZES, "RoutePlanning-N9-v0", {}, "RoutePlanning-N80-v0"),
        ({**SIZES, GENERIC: {}}, "TaskAllocation-U6-N210-v0", {}, "TaskAllocation-U6-N200-v0"),
        ({**SIZES, GENERIC: {}}, GENERIC, {"n_tasks": 210}, GENERIC),
        ({"RoutePlanning-N80-v0": {}, GENERIC: {}}, "TaskAllocation-U6-N210-v0", {}, GENERIC),
        (SIZES, GENERIC, {"n_tasks": "many"}, "TaskAllocation-U4-N80-v0"),
        ({**SIZES, GENERIC: {}}, "RoutePlanning-N9-v0", {}, "RoutePlanning-N80-v0"),
        ({**SIZES, "default": {}}, "TaskAllocation-U6-N210-v0", {}, "TaskAllocation-U6-N200-v0"),
        ({"default": {}}, "TaskAllocation-U6-N210-v0", {}, None),
        (SIZES, "TaskAllocation-Universal-v0", {}, None),
        (SIZES, "CartPole-v1", {}, None),
        ({"CartPole-v1": {}}, "TaskAllocation-U4-N80-v0", {}, None),
        ({"anchor": {}, 3: {}}, "RoutePlanning-N80-v0", {}, None),
    ],
)
def test_the_entry_of_an_environment(
    entries: dict[Any, Any], env_id: str, env_kwargs: dict[str, Any], expected: str | None
) -> None:
    assert find_entry(entries, env_id, env_kwargs) == expected


@pytest.mark.parametrize("algo", ["reinforce", "ppo", "ppo_mask", "a2c"])
def test_other_sizes_get_the_recipe_of_the_nearest_one(algo: str) -> None:
    """The fault was the recipe for 80 tasks, scaled: four times the steps of that for 500."""
    path = default_config(algo)
    assert path is not None
    entries = read_yaml(path)
    ensure_registered("TaskAllocation-U5-N450-v0")
    large, kwargs = "TaskAllocation-U6-N500-v0", {"n_tasks": 450, "n_uavs": 5}
    assert find_entry(entries, "TaskAllocation-U5-N450-v0") == find_entry(entries, GENERIC, kwargs) == large
    scaled = scaled_values(entries[large], large, GENERIC, kwargs)
    assert scaled["n_timesteps"] == entries[large]["n_timesteps"] * 450 / 500
    assert find_entry(entries, GENERIC) == "TaskAllocation-U4-N80-v0"
    assert find_entry(entries, "RoutePlanning-v0", {"n_tasks": 160}) == "RoutePlanning-N150-v0"


def test_an_allocators_entry_is_scaled_to_the_length_of_its_episodes() -> None:
    allocator = dict(n_timesteps=8000, n_steps=80, batch_size=1600, n_envs=4)
    expected = dict(n_timesteps=12000, n_steps=120, batch_size=2400)
    assert scaled_values(allocator, "TaskAllocation-U4-N80-v0", "TaskAllocation-U5-N120-v0") == expected
    assert scaled_values(allocator, GENERIC, GENERIC, {"n_tasks": 120}) == expected
    assert scaled_values(allocator, "TaskAllocation-U4-N80-v0", "TaskAllocation-U4-N80-v0") == {}
    assert scaled_values(allocator, GENERIC, "TaskAllocation-U6-N80-v0") == {}
    # The entry's own size.
    sized = {**allocator, "env_kwargs": {"n_tasks": 60}}
    assert scaled_values(sized, GENERIC, GENERIC) == {}
    assert scaled_values(sized, GENERIC, GENERIC, {"n_tasks": 120}) == {"n_timesteps": 16000}
    # The arguments that are given replace those of the entry as a whole.
    assert scaled_values(sized, GENERIC, GENERIC, {"n_uavs": 3}) == {"n_timesteps": 10667}
    # Tours end when the distance is used up, whatever the number of tasks.
    assert scaled_values(allocator, "RoutePlanning-N80-v0", "RoutePlanning-N20-v0") == {}
    assert scaled_values(allocator, "CartPole-v1", "CartPole-v1") == {}


def test_comparisons_use_the_same_entries(tmp_path: Path) -> None:
    ensure_registered(NEW)
    entries = {"TaskAllocation-U4-N80-v0": dict(policy="AllocatorPolicy", n_steps=80, n_timesteps=800)}
    (tmp_path / "own.yml").write_text(yaml.safe_dump(entries))
    (tmp_path / "variants.yml").write_text(yaml.safe_dump({"a": dict(algo="ppo", conf_file=str(tmp_path / "own.yml"))}))
    (variant,) = read_variants(tmp_path / "variants.yml", NEW)
    assert variant.entry == dict(policy="AllocatorPolicy", n_steps=9, n_timesteps=90)


# ----------------------------------------------------------------------------------------------------------- trainings


@pytest.mark.slow
def test_an_id_of_any_size_trains_and_is_replayed(tmp_path: Path, capsys: Any) -> None:
    """With the entry of another size, scaled to its own."""
    other = entry(n_timesteps=2 * 8 * 20)
    other["callback"][0]["sb3_uav.training.ITSCallback"].update(n_epochs=2)
    assert train_tiny(tmp_path, {"TaskAllocation-U3-N20-v0": other}, NEW, "--eval-episodes", "2") == 0
    printed = capsys.readouterr().out
    assert f"own.yml has no entry for {NEW}; using that of TaskAllocation-U3-N20-v0" in printed
    assert "n_timesteps is for another number of tasks: 320 becomes 144" in printed
    run = tmp_path / "logs" / "reinforce" / f"{NEW}_1"
    model = REINFORCE.load(run / f"{NEW}.zip")
    assert model.num_timesteps == 144 and model.action_space == gym.spaces.Discrete(2)
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [72, 144]
    assert enjoy.main(["--env", NEW, "-f", str(tmp_path / "logs"), "-n", "18", "--no-render"]) == 0
    printed = capsys.readouterr().out
    assert "2 Episodes" in printed and "Mean episode length: 9.00" in printed


@pytest.mark.parametrize("custom", [{}, {"n_steps": 7}])
def test_arguments_of_the_command_line_scale_an_entry_with_its_own(tmp_path: Path, custom: dict[str, Any]) -> None:
    """The fault was the number of steps of the entry's own size, 5, for 10 tasks."""
    config = tmp_path / "own.yml"
    settings = dict(policy="AllocatorPolicy", n_timesteps=100, n_steps=5, env_kwargs=dict(n_tasks=5, n_uavs=2))
    config.write_text(yaml.safe_dump({GENERIC: settings}))
    args = argparse.Namespace(conf_file=str(config))
    given: dict[str, Any] = dict(hyperparams=custom, env_kwargs=dict(n_tasks=10, n_uavs=2), config=str(config))
    manager = UAVExperimentManager(args, "ppo", GENERIC, str(tmp_path), **given)
    hyperparams, saved = manager.read_hyperparameters()
    assert hyperparams["n_timesteps"] == saved["n_timesteps"] == 200
    assert hyperparams["n_steps"] == custom.get("n_steps", 10) and hyperparams["env_kwargs"] == given["env_kwargs"]


@pytest.mark.slow
@pytest.mark.parametrize("source", ["command line", "yaml"])
def test_arguments_reach_training_evaluation_and_replay(tmp_path: Path, capsys: Any, source: str) -> None:
    """Sizes, a generator, a router and a reward, by dotted path; PPO's rollouts hold whole episodes of this size."""
    kwargs = dict(
        n_tasks=9, n_uavs=2, generator="zoo_hooks.Corner", router="zoo_hooks.one_task", reward="zoo_hooks.plain_value"
    )
    settings = dict(
        policy="sb3_uav.policies.AllocatorPolicy",
        policy_kwargs=NETWORK,
        n_envs=4,
        n_steps=80,
        batch_size=160,
        n_timesteps=80 * 4,
        callback="sb3_uav.training.EpisodeBufferCallback",
    )
    flags = ["--eval-freq", "36", "--eval-episodes", "2"]
    if source == "yaml":
        settings["env_kwargs"] = kwargs
        settings |= dict(n_steps=9, batch_size=18, n_timesteps=36)
    else:
        flags += ["--env-kwargs", *(f"{key}:{value!r}" for key, value in kwargs.items())]
    assert train_tiny(tmp_path, {GENERIC: settings}, GENERIC, *flags, algo="ppo") == 0
    run = tmp_path / "logs" / "ppo" / f"{GENERIC}_1"
    model = PPO.load(run / f"{GENERIC}.zip")
    assert (model.n_steps, model.batch_size, model.num_timesteps) == (9, 18, 36)
    assert model.action_space == gym.spaces.Discrete(2)
    # One task of each of the two subsets, in both.
    assert set(np.load(run / "evaluations.npz")["results"].flatten()) <= {1.0, 2.0}
    assert "is_success" not in (run / "0.monitor.csv").read_text()
    assert load_policy(run / f"{GENERIC}.zip") is not None
    capsys.readouterr()
    replay = ["--algo", "ppo", "--env", GENERIC, "-f", str(tmp_path / "logs"), "-n", "18", "--no-render"]
    assert enjoy.main(replay) == 2
    assert "env_kwargs names code, 'zoo_hooks." in capsys.readouterr().err
    assert enjoy.main([*replay, "--gym-packages", "zoo_hooks"]) == 0
    printed = capsys.readouterr().out
    rewards = {float(found) for found in re.findall(r"Episode Reward: ([\d.]+)", printed)}
    assert "2 Episodes" in printed and rewards <= {1.0, 2.0}


@pytest.mark.slow
def test_a_value_that_cannot_be_used_ends_the_command(tmp_path: Path, capsys: Any) -> None:
    """In one line, before any step, with the file, the entry, the argument, the value and what to do."""
    entries = {"TaskAllocation-U3-N20-v0": entry(env_kwargs={"generator": "zoo_hooks.OtherSize"})}
    assert train_tiny(tmp_path, entries, "TaskAllocation-U3-N20-v0") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{tmp_path / 'own.yml'}, TaskAllocation-U3-N20-v0: generator is" in error
    assert "'zoo_hooks.OtherSize': it drew 2 instances of 21 tasks and 3 UAVs instead of 2 instances of 20 tasks" in error
    assert not list(tmp_path.rglob("*.zip"))


@pytest.mark.slow
def test_monitor_files_say_whether_episodes_succeed(tmp_path: Path) -> None:
    """With enough flight distance every episode does; keywords of the YAML replace ours."""
    env_id = "RoutePlanning-v0"
    settings: dict[str, Any] = dict(
        policy="sb3_uav.policies.RouterPolicy", policy_kwargs=NETWORK, n_envs=2, n_timesteps=12, instances_per_epoch=2
    )
    settings["env_kwargs"] = dict(n_tasks=5, max_distance=100.0)
    assert train_tiny(tmp_path, {env_id: settings}, env_id, "--eval-freq", "-1") == 0
    header, *rows = (tmp_path / "logs/reinforce/RoutePlanning-v0_1/0.monitor.csv").read_text().splitlines()[1:]
    assert header == "r,l,t,is_success" and rows and all(row.endswith(",True") for row in rows)
    settings |= dict(monitor_kwargs=dict(info_keywords=["objective", "illegal_actions"]))
    settings["env_kwargs"] = dict(n_tasks=5, max_distance=0.1)
    assert train_tiny(tmp_path, {env_id: settings}, env_id, "--eval-freq", "-1") == 0
    header = (tmp_path / "logs/reinforce/RoutePlanning-v0_2/0.monitor.csv").read_text().splitlines()[1]
    assert header == "r,l,t,objective,illegal_actions"


class Rewarded(RoutePlanningEnv):
    """An environment of a user with a reward of its own."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs, reward="zoo_hooks.plain_value")


@pytest.mark.parametrize(("env_class", "kwargs"), [(RoutePlanningEnv, {"reward": "zoo_hooks.plain_value"}), (Rewarded, {})])
def test_rewards_of_a_registered_id_train(env_class: Any, kwargs: dict[str, Any], tmp_path: Path) -> None:
    """The fault was a KeyError at the end of the first episode, as the monitor looked for is_success."""
    gym.register("Rewarded-v0", entry_point=env_class, kwargs={"n_tasks": 5, **kwargs})
    settings = dict(policy="sb3_uav.policies.RouterPolicy", policy_kwargs=NETWORK, n_envs=2, n_timesteps=12)
    assert train_tiny(tmp_path, {"Rewarded-v0": settings}, "Rewarded-v0", "--eval-freq", "-1") == 0
    header, *rows = (tmp_path / "logs/reinforce/Rewarded-v0_1/0.monitor.csv").read_text().splitlines()[1:]
    assert header == "r,l,t" and rows

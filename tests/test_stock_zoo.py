"""rl_zoo3 as it is installed, in processes of its own: training, evaluation, replay, resuming and tuning."""

import csv
import os
import re
import subprocess
import sys
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

from sb3_uav.common.sb3_compat import n_updates
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.registration import PAPER_FLEETS, PAPER_SIZES, allocation_id, routing_id

pytest.importorskip("rl_zoo3")
from sb3_uav.training import EpisodeBufferCallback, FixedSetEvalCallback, ITSCallback
from sb3_uav.zoo import enjoy, train
from sb3_uav.zoo.configs import default_config

ROUTING, ALLOCATION = "RoutePlanning-N20-v0", "TaskAllocation-U3-N20-v0"
TINY_NETWORK = "dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)"
TINY = ["n_envs:4", "batch_size:40", "n_epochs:1", f"policy_kwargs:{TINY_NETWORK}"]

# Written beside the logs and named in --gym-packages: notes the illegal actions of every episode of a single environment.
SPY = """
from sb3_uav.envs.gym_env import ProblemEnv

step = ProblemEnv.step


def noting_step(self, action):
    result = step(self, action)
    if result[2]:
        with open("illegal_actions.txt", "a") as file:
            print(result[4]["illegal_actions"], file=file)
    return result


ProblemEnv.step = noting_step
"""


def config(algo: str = "ppo") -> Path:
    path = default_config(algo)
    assert path is not None
    return path


def zoo(module: str, folder: Path, *arguments: str) -> str:
    """Run a module of rl_zoo3 in a process that knows nothing of this one; what it printed."""
    command = [sys.executable, "-m", f"rl_zoo3.{module}", "--algo", "ppo", "-f", "logs", "--num-threads", "1", *arguments]
    finished = subprocess.run(command, cwd=folder, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def illegal_actions(folder: Path) -> list[int]:
    """Of every episode that single environments have played since the last call."""
    path = folder / "illegal_actions.txt"
    found = [int(line) for line in path.read_text().splitlines()] if path.is_file() else []
    path.unlink(missing_ok=True)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stock")
    (folder / "spy.py").write_text(SPY)
    return folder


@pytest.fixture(scope="module")
def routing(folder: Path) -> Path:
    """The run folder of the router's training, with `DummyVecEnv`."""
    zoo(
        *("train", folder, "--env", ROUTING, "--gym-packages", "sb3_uav", "spy", "--conf-file", str(config()), "--seed", "1"),
        *("-n", "160", "--eval-freq", "80", "--eval-episodes", "4", "-params", *TINY),
    )
    return folder / "logs" / "ppo" / f"{ROUTING}_1"


@pytest.fixture(scope="module")
def allocation(folder: Path) -> Path:
    """The run folder of both levels' training, with `BatchedVecEnv`."""
    router = f"dict(algo='ppo', policy='RouterPolicy', policy_kwargs={TINY_NETWORK}, n_envs=4, n_steps=20, batch_size=40)"
    its = f"dict(router={router}, instances_per_epoch=8, n_epochs=4, n_pretraining_epochs=1, n_intensive_epochs=1)"
    (folder / "its.txt").write_text(f"callback:[{{'sb3_uav.training.ITSCallback': {its}}}]")
    zoo(
        *("train", folder, "--env", ALLOCATION, "--gym-packages", "sb3_uav.zoo.batched", "spy", "--conf-file", str(config())),
        *("--seed", "1", "-n", "320", "--eval-freq", "160", "--eval-episodes", "4"),
        *("-params", *TINY, (folder / "its.txt").read_text()),
    )
    return folder / "logs" / "ppo" / f"{ALLOCATION}_1"


@pytest.mark.slow
def test_training_leaves_the_zoos_files(folder, routing):
    expected = {f"{ROUTING}.zip", ROUTING, "best_model.zip", "evaluations_eval_callback.npz"}
    ours = {"evaluations.npz", "evaluation_instances.npz"}
    assert expected | ours | {f"{row}.monitor.csv" for row in range(4)} == {path.name for path in routing.iterdir()}
    saved = yaml.load((routing / ROUTING / "config.yml").read_text(), Loader=yaml.UnsafeLoader)  # written by rl_zoo3 just now
    assert dict(saved)["policy"] == "sb3_uav.policies.RouterPolicy" and dict(saved)["gamma"] == 1.0
    # rl_zoo3's EvalCallback, and ours on the fixed set.
    stock = np.load(routing / "evaluations_eval_callback.npz")
    assert stock["timesteps"].tolist() == [80, 160] and stock["results"].shape == (2, 4)
    ours_evaluated = np.load(routing / "evaluations.npz")
    assert ours_evaluated["timesteps"].tolist() == [0, 160] and ours_evaluated["results"].shape == (2, 256)
    assert (ours_evaluated["sampled"].mean(1) > ours_evaluated["results"].mean(1)).all()
    # 160 steps and both evaluations, without an illegal action.
    with (routing / "0.monitor.csv").open() as file:
        assert all(2 <= float(row["l"]) <= 21 for row in list(csv.DictReader(file.readlines()[1:])))
    illegal = illegal_actions(folder)
    assert len(illegal) >= 8 + 160 // 21 and not any(illegal)


@pytest.mark.slow
def test_zips_are_stock_ppo(routing):
    for name in (f"{ROUTING}.zip", "best_model.zip"):
        model = PPO.load(routing / name, device="cpu")
        assert type(model) is PPO and isinstance(model.policy, RouterPolicy)
    with zipfile.ZipFile(routing / f"{ROUTING}.zip") as archive:
        assert "spy" not in archive.read("data").decode()


@pytest.mark.slow
def test_enjoy_replays_with_masks(folder, routing):
    illegal_actions(folder)
    flags = ["-n", "60", "--no-render", "--load-best"]
    printed = zoo("enjoy", folder, "--env", ROUTING, "--gym-packages", "sb3_uav", "spy", *flags)
    rewards = [float(found) for found in re.findall(r"Episode Reward: ([\d.]+)", printed)]
    assert f"{len(rewards)} Episodes" in printed and f"Mean reward: {np.mean(rewards):.2f} +/-" in printed
    illegal = illegal_actions(folder)
    assert len(illegal) == len(rewards) >= 3 and not any(illegal)


@pytest.mark.slow
def test_training_goes_on_in_a_batched_environment(folder, routing):
    """`-i`, and the shim in `--gym-packages`: no single environment is stepped."""
    illegal_actions(folder)
    printed = zoo(
        *("train", folder, "--env", ROUTING, "--gym-packages", "sb3_uav.zoo.batched", "spy", "--conf-file", str(config())),
        # Two updates, because a linear schedule is at 0 for the last one.
        *("--seed", "2", "-n", "160", "--eval-freq", "80", "-i", str(routing / f"{ROUTING}.zip"), "-params", *TINY),
    )
    assert "Loading pretrained agent" in printed and illegal_actions(folder) == []
    second = folder / "logs" / "ppo" / f"{ROUTING}_2"
    assert {path.name for path in second.iterdir() if path.suffix == ".csv"} == {"0.monitor.csv"}
    assert np.load(second / "evaluations.npz")["timesteps"].tolist() == [0, 160, 320]
    before, after = PPO.load(routing / f"{ROUTING}.zip"), PPO.load(second / f"{ROUTING}.zip")
    assert n_updates(after) == n_updates(before) + 2
    old, new = before.policy.state_dict(), after.policy.state_dict()
    assert old.keys() == new.keys() and any(not th.equal(old[key], new[key]) for key in old)


@pytest.mark.slow
def test_both_levels_train(allocation):
    names = {path.name for path in allocation.iterdir()}
    assert {"router.zip", "best_router.zip", "its_log.csv", "its_checkpoint", "best_model.zip", "0.monitor.csv"} <= names
    with (allocation / "its_log.csv").open() as file:
        levels = [(row["level"], row["phase"]) for row in csv.DictReader(file)]
    assert levels[0] == ("router", "pre-training") and levels[1:3] == [("allocator", "intensive"), ("allocator", "alternate")]
    assert isinstance(load_policy(allocation / "router.zip"), RouterPolicy)
    assert np.load(allocation / "evaluations.npz")["timesteps"].tolist() == [160, 320]


@pytest.mark.slow
def test_both_levels_continue(folder, allocation):
    """Stock rl_zoo3 does not tell the callback where the router is; the allocator's zip does."""
    zoo(
        *("train", folder, "--env", ALLOCATION, "--gym-packages", "sb3_uav.zoo.batched", "--conf-file", str(config())),
        *("--seed", "2", "-n", "160", "--eval-freq", "-1", "-i", str(allocation / f"{ALLOCATION}.zip")),
        *("-params", *TINY, (folder / "its.txt").read_text()),
    )
    first, second = allocation / "its_log.csv", folder / "logs" / "ppo" / f"{ALLOCATION}_2" / "its_log.csv"
    assert second.read_text().startswith(first.read_text())
    epochs = [row.split(",")[:2] for row in second.read_text().splitlines()]
    assert epochs.count(["3", "allocator"]) == 1 and sum(row[1] == "allocator" for row in epochs) == 3


@pytest.mark.slow
def test_enjoy_replays_an_allocator(folder, allocation):
    illegal_actions(folder)
    printed = zoo("enjoy", folder, "--env", ALLOCATION, "--gym-packages", "sb3_uav", "spy", "-n", "60", "--no-render")
    assert printed.count("Episode Reward:") == 3 and "3 Episodes" in printed
    assert illegal_actions(folder) == [0, 0, 0]


@pytest.mark.slow
def test_stock_search_space_runs(folder):
    """It replaces the network's arguments by its own `net_arch` and `activation_fn`, which our policies take."""
    illegal_actions(folder)
    zoo(
        *("train", folder, "--env", ROUTING, "--gym-packages", "sb3_uav", "spy", "--conf-file", str(config())),
        # A seed that draws two cheap trials.
        *("--seed", "2", "-n", "32", "-optimize", "--n-trials", "2", "--sampler", "random", "--pruner", "none"),
        *("--n-evaluations", "1", "--eval-episodes", "3", "--no-optim-plots"),
        *("-params", "n_envs:2", "callback:'sb3_uav.training.EpisodeBufferCallback'"),
    )
    (report,) = (folder / "logs" / "ppo").glob(f"report_{ROUTING}_2-trials-32-random-none_*.csv")
    with report.open() as file:
        trials = list(csv.DictReader(file))
    assert [trial["state"] for trial in trials] == ["COMPLETE", "COMPLETE"]
    assert all(0 < float(trial["value"]) <= 20 and trial["params_net_arch"] for trial in trials)
    assert report.with_suffix(".pkl").stat().st_size > 0
    illegal = illegal_actions(folder)
    assert len(illegal) >= 2 * 3 and not any(illegal)


@pytest.mark.slow
def test_our_front_end_knows_maskable_ppo(tmp_path, capsys):
    arguments = ["--algo", "ppo_mask", "--env", ROUTING, "-f", str(tmp_path), "--seed", "1", "-n", "80", "-params", *TINY]
    assert train.main(arguments) == 0
    run = tmp_path / "ppo_mask" / f"{ROUTING}_1"
    assert isinstance(MaskablePPO.load(run / f"{ROUTING}.zip").policy, RouterPolicy)
    # With our evaluation in the YAML, that of rl_zoo3 is left out unless it is asked for.
    assert (run / "evaluations.npz").is_file() and not (run / "evaluations_eval_callback.npz").exists()
    capsys.readouterr()
    assert enjoy.main(["--algo", "ppo_mask", "--env", ROUTING, "-f", str(tmp_path), "-n", "60", "--no-render"]) == 0
    rewards = [float(found) for found in re.findall(r"Episode Reward: ([\d.]+)", capsys.readouterr().out)]
    # Without masks, the first visited task that is chosen again ends an episode.
    assert len(rewards) >= 60 // 21 and np.mean(rewards) > 2.5


# ------------------------------------------------------------------------------------------ the shipped YAMLs

SCENARIOS = [allocation_id(n_uavs, n_tasks) for n_uavs in PAPER_FLEETS for n_tasks in PAPER_SIZES]
SCENARIOS += [routing_id(n_tasks) for n_tasks in PAPER_SIZES] + [ROUTING, ALLOCATION]


@cache
def shipped(algo: str) -> dict:
    return yaml.safe_load(config(algo).read_text())


def callbacks_of(entry: dict) -> dict:
    """Those that have arguments, by name."""
    return {name: value for item in entry["callback"] if isinstance(item, dict) for name, value in item.items()}


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_rollouts_hold_whole_minibatches(env_id):
    """Of whole episodes for the allocator; none is cut short, as a minibatch of one step would break MaskablePPO."""
    entry = shipped("ppo")[env_id]
    blocks = [entry]
    arguments = callbacks_of(entry)
    if "Allocation" in env_id:
        n_tasks = int(re.findall(r"N(\d+)", env_id)[0])
        assert entry["n_steps"] == n_tasks and entry["batch_size"] % n_tasks == 0 and entry["gae_lambda"] >= 0.95
        its = ITSCallback(**arguments["sb3_uav.training.ITSCallback"])
        assert its.instances_per_epoch is not None
        assert entry["n_timesteps"] == its.n_epochs * its.instances_per_epoch * n_tasks
        blocks.append(its.router_kwargs)
    for block in blocks:
        assert block["gamma"] == 1.0 and block["n_steps"] * block["n_envs"] % block["batch_size"] == 0
    assert entry["callback"][0] == f"sb3_uav.training.{EpisodeBufferCallback.__name__}"
    FixedSetEvalCallback(**arguments["sb3_uav.training.FixedSetEvalCallback"])


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_maskable_ppo_has_the_settings_of_ppo(env_id):
    assert str(shipped("ppo_mask")[env_id]) == str(shipped("ppo")[env_id]).replace("'algo': 'ppo'", "'algo': 'ppo_mask'")


@pytest.mark.parametrize("env_id", [ALLOCATION, ROUTING])
def test_algorithms_compare_on_equal_terms(env_id):
    """The same network on both levels, the same number of steps, the same fixed set."""

    def terms(algo: str) -> list:
        entry = shipped(algo)[env_id]
        callbacks = callbacks_of(entry)
        its = callbacks.get("sb3_uav.training.ITSCallback", {})
        phases = [its.get(key) for key in ("n_epochs", "n_pretraining_epochs", "n_intensive_epochs", "n_continuous_epochs")]
        routers = its.get("router", {}).get("policy_kwargs")
        evaluation = callbacks["sb3_uav.training.FixedSetEvalCallback"]
        return [entry["policy_kwargs"], entry["n_timesteps"], routers, phases, evaluation]

    assert terms("ppo") == terms("ppo_mask") == terms("reinforce")


def test_every_scenario_has_an_entry():
    for algo in ("reinforce", "ppo", "ppo_mask", "a2c"):
        entries = shipped(algo)
        for env_id in SCENARIOS:
            expected = AllocatorPolicy if "Allocation" in env_id else RouterPolicy
            assert entries[env_id]["policy"] == f"sb3_uav.policies.{expected.__name__}"
    assert shipped("ppo").keys() == shipped("ppo_mask").keys() == shipped("a2c").keys()


def test_a_yaml_of_rl_zoo3_is_used_where_ours_does_not_know_the_environment():
    assert default_config("ppo", "CartPole-v1") is None
    for env_id in (ROUTING, ALLOCATION):
        assert default_config("ppo", env_id) == config()
    assert default_config("reinforce", "Pendulum-v1") == config("reinforce")

"""Files of an evaluation on a fixed set, and resuming it."""

import csv
import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fixed_set_runs import (
    N_ENVS,
    N_TASKS,
    NETWORK,
    POLICIES,
    ROLLOUT,
    allocation_env,
    equal,
    load,
    make_callback,
    make_model,
)
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.envs import BatchedVecEnv, Instances, TaskAllocationEnv
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, ITSCallback, fixed_set
from sb3_uav.training.best_pair import BestPair
from sb3_uav.training.fixed_set_returns import evaluate_fixed_set, fingerprint
from sb3_uav.training.its_checkpoint import read_state

pytestmark = pytest.mark.filterwarnings("ignore:FixedSetEvalCallback saves nothing")


def test_files_and_log(tmp_path):
    model = make_model(PPO)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    callback = make_callback()
    model.learn(4 * ROLLOUT, callback=callback)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"progress.csv", "evaluations.npz", "evaluation_instances.npz", "best_model.zip"}
    saved, used = Instances.load(tmp_path / "evaluation_instances.npz"), callback.instances
    assert used is not None and fingerprint(saved, 3) == fingerprint(used, 3) != fingerprint(used, 4)
    history = load(tmp_path)
    assert history.results.shape == history.sampled.shape == history.ep_lengths.shape == (5, 6)
    # What rl_zoo3's plots and SB3's users read.
    stock = np.load(tmp_path / "evaluations.npz")
    assert {"timesteps", "results", "ep_lengths"} <= set(stock.files)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"eval/fixed_greedy", "eval/fixed_sampled", "eval/fixed_best", "eval/fixed_ep_length"} <= set(header)
    policy = load_policy(tmp_path / "best_model.zip")
    again = evaluate_fixed_set(policy, allocation_env().problem, callback.instances, 3)  # type: ignore[arg-type]
    assert again.greedy.mean() == history.results.mean(1).max() == callback.best_mean_reward


@pytest.mark.parametrize("best_by", ["greedy", "sampled"])
def test_best_model_is_saved_when_the_mean_improves(best_by, tmp_path, monkeypatch):
    values = iter([3.0, 2.0, 3.0, 5.0, 4.0])
    saved = []

    def scripted(policy, problem, instances, n_samples, seed):
        value, other = np.full(6, next(values)), np.zeros(6)
        greedy, sampled = (value, other) if best_by == "greedy" else (other, value)
        return fixed_set.FixedSetResult(greedy, np.ones(6, dtype=np.int64), sampled)

    monkeypatch.setattr(fixed_set, "evaluate_fixed_set", scripted)
    monkeypatch.setattr(BestPair, "save", lambda self, model, router, **about: saved.append(model.num_timesteps))
    callback = make_callback(tmp_path, best_by=best_by)
    make_model(PPO).learn(4 * ROLLOUT, callback=callback)
    assert saved == [0, 3 * ROLLOUT]
    assert (callback.best_mean_reward, callback.last_mean_reward) == (5.0, 4.0)


def test_failing_disk_leaves_the_older_files(tmp_path, monkeypatch):
    make_model(PPO).learn(ROLLOUT, callback=make_callback(tmp_path))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fail(*args):
        raise OSError("No space left on device")

    for module in ("sb3_uav.common.files.os.replace",):
        monkeypatch.setattr(module, fail)
    with pytest.raises(OSError, match="No space"):
        make_model(PPO).learn(ROLLOUT, callback=make_callback(tmp_path, best_by="sampled"))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_says_when_nothing_is_saved():
    with pytest.warns(UserWarning, match="saves nothing: set save_path to a folder"):
        make_model(PPO).learn(ROLLOUT, callback=make_callback())


@pytest.mark.parametrize("vec_env", [BatchedVecEnv, DummyVecEnv])
def test_run_folder_is_that_of_the_monitor_files(vec_env, tmp_path):
    """As in stock rl_zoo3 with `--eval-freq -1`."""
    env = make_vec_env("TaskAllocation-U3-N20-v0", n_envs=2, monitor_dir=str(tmp_path), vec_env_cls=vec_env)
    callback = make_callback()
    PPO(POLICIES["allocation"], env, n_steps=20, batch_size=40, policy_kwargs=NETWORK).learn(40, callback=callback)
    assert callback.folder == tmp_path and (tmp_path / "best_model.zip").is_file()


def test_stock_evaluation_of_the_same_folder_steps_aside(tmp_path):
    """One writer per file: the best model is that of the fixed set, both results are kept."""
    folder, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    stock, other = (
        EvalCallback(
            BatchedVecEnv([allocation_env]),
            n_eval_episodes=2,
            eval_freq=3,
            best_model_save_path=str(path),
            log_path=str(path),
            verbose=0,
        )
        for path in (folder, elsewhere)
    )
    callback = make_callback()
    make_model(PPO).learn(3 * ROLLOUT, callback=[callback, stock, other])
    assert callback.folder == folder
    assert load(folder).results.shape == (4, 6)
    assert np.load(folder / "evaluations_eval_callback.npz")["results"].shape == (5, 2)
    assert not (folder / "best_model.zip").read_bytes() == (elsewhere / "best_model.zip").read_bytes()
    best = load_policy(folder / "best_model.zip")
    again = evaluate_fixed_set(best, allocation_env().problem, callback.instances, 0)  # type: ignore[arg-type]
    assert again.greedy.mean() == callback.best_mean_reward
    assert np.load(elsewhere / "evaluations.npz")["results"].shape == (5, 2) and stock.best_model_save_path is None


def test_two_sets_need_two_folders(tmp_path):
    def callbacks(*folders: Path) -> list[BaseCallback]:
        return [make_callback(folder, seed=seed) for seed, folder in enumerate(folders)]

    make_model(PPO).learn(ROLLOUT, callback=callbacks(tmp_path / "a", tmp_path / "b"))
    assert not np.array_equal(load(tmp_path / "a").results, load(tmp_path / "b").results)
    with pytest.raises(ValueError, match="give one of them another save_path"):
        make_model(PPO).learn(ROLLOUT, callback=callbacks(tmp_path / "a", tmp_path / "a"))


@pytest.mark.parametrize("algorithm", [PPO, REINFORCE])
@pytest.mark.parametrize("reset", [True, False])
def test_resumed_run_continues_the_earlier_one(algorithm, reset, tmp_path):
    """As `-i` of rl_zoo3 does: a new folder, and SB3 counts steps from 0 again unless told otherwise."""
    first, second = tmp_path / "first", tmp_path / "second"
    model = make_model(algorithm)
    model.learn(3 * ROLLOUT, callback=make_callback(first))
    model.save(first / "model")
    earlier = load(first)
    model = algorithm.load(first / "model", env=BatchedVecEnv([allocation_env] * N_ENVS), device="cpu")
    callback = make_callback(second)
    model.learn(2 * ROLLOUT, callback=callback, reset_num_timesteps=reset)
    history = load(second)
    assert history.timesteps.tolist() == [0, 20, 40, 60, 80, 100]
    assert np.array_equal(history.results[:4], earlier.results) and np.array_equal(history.sampled[:4], earlier.sampled)
    assert np.all(np.diff(history.train_seconds) > 0) and np.array_equal(history.train_seconds[:4], earlier.train_seconds)
    assert callback.best_mean_reward == history.results.mean(1).max()
    best = load_policy(second / "best_model.zip")
    again = evaluate_fixed_set(best, allocation_env().problem, callback.instances, 0)  # type: ignore[arg-type]
    assert again.greedy.mean() == callback.best_mean_reward


def test_resumed_from_an_earlier_checkpoint(tmp_path, monkeypatch):
    """Later evaluations of the earlier run are no part of the new one, nor is its best model, which is of a later time."""
    values = iter([1.0, 2.0, 3.0, 4.0, 2.5, 2.6])

    def scripted(policy, problem, instances, n_samples, seed):
        return fixed_set.FixedSetResult(np.full(6, next(values)), np.ones(6, dtype=np.int64), np.zeros(6))

    monkeypatch.setattr(fixed_set, "evaluate_fixed_set", scripted)
    first, second = tmp_path / "first", tmp_path / "second"
    make_model(PPO).learn(3 * ROLLOUT, callback=[make_callback(first), CheckpointCallback(N_TASKS, str(first), "rl_model")])
    assert load(first).results.mean(1).tolist() == [1.0, 2.0, 3.0, 4.0]
    model = PPO.load(first / "rl_model_20_steps", env=BatchedVecEnv([allocation_env] * N_ENVS), device="cpu")
    model.learn(2 * ROLLOUT, callback=make_callback(second))
    history = load(second)
    assert history.timesteps.tolist() == [0, 20, 40, 60] and history.results.mean(1).tolist() == [1.0, 2.0, 2.5, 2.6]
    assert PPO.load(second / "best_model", device="cpu").num_timesteps == 40


def test_same_callback_goes_on_without_files():
    model, callback = make_model(PPO), make_callback()
    for _ in range(2):
        model.learn(ROLLOUT, callback=callback, reset_num_timesteps=False)
    assert callback.history.timesteps.tolist() == [0, 20, 40]


@pytest.mark.parametrize("change", [dict(n_samples=2), dict(seed=1), dict(n_instances=7)])
def test_other_sets_are_not_continued(change, tmp_path):
    """Steps are still counted from the start, and the model keeps the folder of the earlier set."""
    model = make_model(PPO)
    model.learn(ROLLOUT, callback=make_callback(tmp_path / "one"))
    model.learn(ROLLOUT, callback=make_callback(tmp_path / "other", **change))
    assert load(tmp_path / "other").timesteps.tolist() == [20, 40]
    model.learn(ROLLOUT, callback=[make_callback(tmp_path / "both"), make_callback(tmp_path / "other", **change)])
    assert load(tmp_path / "both").timesteps.tolist() == [0, 20, 40, 60]
    assert load(tmp_path / "other").timesteps.tolist() == [20, 40, 60]


@pytest.mark.parametrize("damage", ["missing", "truncated", "stock"])
def test_damaged_earlier_results_do_not_stop_a_training(damage, tmp_path):
    model = make_model(PPO)
    model.learn(ROLLOUT, callback=make_callback(tmp_path))
    path = tmp_path / "evaluations.npz"
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:100])
    else:
        np.savez(path, timesteps=[1], results=[[1.0]], ep_lengths=[[1]])
    with pytest.warns(UserWarning, match=r"cannot be continued, new ones begin: .*evaluations\.npz: "):
        model.learn(ROLLOUT, callback=make_callback(tmp_path))
    assert load(tmp_path).timesteps.tolist() == [20, 40]


def test_zips_remember_in_plain_data(tmp_path):
    """No pickle is added, so that zips stay safe to read and load with the stock class."""
    model = make_model(PPO)
    model.learn(ROLLOUT, callback=make_callback(tmp_path))
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model")
    state = loaded.fixed_set_evaluations  # type: ignore[attr-defined]
    assert (list(state["folders"].values()), state["timesteps"]) == ([str(tmp_path)], ROLLOUT)
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert json.loads(archive.read("data"))["fixed_set_evaluations"] == state


@pytest.mark.slow
def test_stock_rl_zoo3_trains_with_it_and_goes_on(tmp_path):
    """Unmodified `python -m rl_zoo3.train`, its own evaluation beside ours, then `-i`."""
    pytest.importorskip("rl_zoo3")
    env_id = "TaskAllocation-U3-N20-v0"
    entry = dict(
        policy="sb3_uav.policies.AllocatorPolicy",
        policy_kwargs=NETWORK,
        n_envs=2,
        n_timesteps=120,
        n_steps=20,
        batch_size=40,
        n_epochs=1,
        gamma=1.0,
        callback=[{"sb3_uav.training.FixedSetEvalCallback": dict(n_instances=4, n_samples=2, eval_freq=40)}],
    )
    config = tmp_path / "ppo.yml"
    config.write_text(yaml.safe_dump({env_id: entry}))
    first, second = (tmp_path / "logs" / "ppo" / f"{env_id}_{number}" for number in (1, 2))
    flags = ["--algo", "ppo", "--env", env_id, "--gym-packages", "sb3_uav", "--conf-file", str(config), "-f", "logs"]
    again = ["-i", str(first / f"{env_id}.zip"), "-n", "80", "--eval-freq", "-1"]
    # What `python -m rl_zoo3.train` runs, twice in one process, because importing it takes long.
    script = f"""
import sys, rl_zoo3.train
for flags in ({[*flags, "--eval-freq", "60"]}, {[*flags, *again]}):
    sys.argv = ["train", *flags]
    rl_zoo3.train.train()
"""
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, cwd=tmp_path)
    assert load(first).timesteps.tolist() == [0, 40, 80, 120] and load(first).results.shape == (4, 4)
    assert np.load(first / "evaluations_eval_callback.npz")["timesteps"].tolist() == [60, 120]
    assert (first / "best_model.zip").is_file() and (first / "evaluation_instances.npz").is_file()
    history = load(second)
    assert history.timesteps.tolist() == [0, 40, 80, 120, 160, 200]
    assert np.array_equal(history.results[:4], load(first).results)
    best = PPO.load(second / "best_model.zip", device="cpu").policy
    instances = Instances.load(second / "evaluation_instances.npz")
    problem = TaskAllocationEnv(20, 3, max_distance=1.5).problem
    assert evaluate_fixed_set(best, problem, instances, 0).greedy.mean() == history.results.mean(1).max()  # type: ignore[arg-type]


class Killed(FixedSetEvalCallback):
    """Ends the run right before or after an evaluation, as a kill does."""

    number, is_after = 3, False

    def evaluate(self) -> float:
        is_due = len(self.history.timesteps) == self.number
        if is_due and not self.is_after:
            raise KeyboardInterrupt
        score = super().evaluate()
        if is_due:
            raise KeyboardInterrupt
        return score


@pytest.mark.slow
@pytest.mark.parametrize("is_after", [False, True])
@pytest.mark.parametrize("settings", [{}, dict(eval_updates=2), dict(sizes=[[2, 5, 4], [2, 6, 3]])])
def test_an_evaluation_that_was_due_is_made_up_for(settings, is_after, tmp_path, monkeypatch):
    """The checkpoint of an epoch comes first. A second kill, before the new folder has an evaluation, loses nothing either."""
    router = dict(policy="RouterPolicy", n_envs=N_ENVS, policy_kwargs=NETWORK, seed=1)
    common = {**({} if "sizes" in settings else dict(n_instances=6)), "n_samples": 3, **settings}

    def callbacks(folder: Path, evaluation: type[FixedSetEvalCallback] = FixedSetEvalCallback) -> list[Any]:
        its = ITSCallback(router, n_epochs=6, n_pretraining_epochs=1, save_path=str(folder))
        return [its, evaluation(save_path=folder, **common)]

    def resume(folder: Path) -> Any:
        checkpoint = folder / "its_checkpoint"
        file = checkpoint / read_state(checkpoint)["allocator"]
        return REINFORCE.load(file, env=BatchedVecEnv([allocation_env] * N_ENVS), device="cpu")

    limit = 10**6
    make_model(REINFORCE).learn(limit, callback=callbacks(tmp_path / "unbroken"))
    first, second, third = (tmp_path / name for name in ("first", "second", "third"))
    with pytest.raises(KeyboardInterrupt):
        monkeypatch.setattr(Killed, "is_after", is_after)
        make_model(REINFORCE).learn(limit, callback=callbacks(first, Killed))
    monkeypatch.setattr(Killed, "is_after", False)
    monkeypatch.setattr(Killed, "number", 4)
    with pytest.raises(KeyboardInterrupt):
        resume(first).learn(limit, callback=callbacks(second, Killed))
    resume(second).learn(limit, callback=callbacks(third))
    found, unbroken = load(third), load(tmp_path / "unbroken")
    for name in ("timesteps", "results", "sampled", "ep_lengths"):
        assert np.array_equal(getattr(found, name), getattr(unbroken, name)), name
    for name in ("best_model.zip", "best_router.zip"):
        one, other = (load_policy(folder / name) for folder in (third, tmp_path / "unbroken"))
        assert equal(one.state_dict(), other.state_dict()), name
    if "sizes" in settings:
        rows = []
        for folder in (third, tmp_path / "unbroken"):
            with (folder / "size_grid.csv").open() as file:
                rows.append([{**row, "seconds": None} for row in csv.DictReader(file)])
        assert rows[0] == rows[1]

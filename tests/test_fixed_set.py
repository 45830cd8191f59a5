"""Evaluation on a fixed set during training: what it measures, what it writes, and that the training does not notice it."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, nearest_feasible
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, ITSCallback, PretrainedRouterCallback, fixed_set
from sb3_uav.training.fixed_set import EvaluationHistory, draw_fixed_set, evaluate_fixed_set, fingerprint

NETWORK: dict[str, Any] = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
BATCH_NORM: dict[str, Any] = dict(NETWORK, preset="paper")
N_TASKS, N_UAVS, N_ENVS = 5, 2, 4
ROLLOUT = N_TASKS * N_ENVS
POLICIES: dict[str, Any] = {"allocation": AllocatorPolicy, "routing": RouterPolicy}

pytestmark = pytest.mark.filterwarnings("ignore:FixedSetEvalCallback saves nothing")


def allocation_env() -> TaskAllocationEnv:
    return TaskAllocationEnv(N_TASKS, N_UAVS, max_distance=1.5, task_order="sweep")


def routing_env() -> RoutePlanningEnv:
    return RoutePlanningEnv(N_TASKS, max_distance=1.5)


ENVS: dict[str, Any] = {"allocation": allocation_env, "routing": routing_env}


def make_model(algorithm: Any = PPO, level: str = "allocation", vec_env: Any = BatchedVecEnv, **kwargs: Any) -> Any:
    env = vec_env([ENVS[level]] * N_ENVS)
    settings: dict[str, Any] = dict(learning_rate=1e-2, seed=0, device="cpu", policy_kwargs=dict(NETWORK))
    if algorithm is REINFORCE:
        settings.update(instances_per_epoch=2 * N_ENVS)
    else:
        settings.update(n_steps=N_TASKS, gamma=1.0)
    if algorithm in (PPO, MaskablePPO):
        settings.update(batch_size=ROLLOUT, n_epochs=1)
    return algorithm(POLICIES[level], env, **{**settings, **kwargs})


def make_callback(folder: Path | None = None, **kwargs: Any) -> FixedSetEvalCallback:
    return FixedSetEvalCallback(**{**dict(n_instances=6, n_samples=3, eval_freq=ROLLOUT, save_path=folder), **kwargs})


def parameters(model: Any) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def equal(a: dict[str, th.Tensor], b: dict[str, th.Tensor]) -> bool:
    return a.keys() == b.keys() and all(th.equal(value, b[name]) for name, value in a.items())


def load(folder: Path) -> EvaluationHistory:
    return EvaluationHistory.load(folder / "evaluations.npz")


# ------------------------------------------------------------------------------------------ what it measures


@pytest.mark.parametrize("level", ["allocation", "routing"])
def test_values_are_those_of_sb3s_loop(level):
    """The greedy returns and lengths are what `predict` earns, instance by instance, in the Gymnasium environment."""
    model = make_model(level=level)
    callback = make_callback()
    model.learn(2 * ROLLOUT, callback=callback)
    env = ENVS[level]()
    assert callback.instances is not None
    for row in range(6):
        obs, _ = env.reset(options={"instance": callback.instances[row]})
        total, length, done = 0.0, 0, False
        while not done:
            action, _ = model.predict(obs, deterministic=True)
            obs, reward, done, _, _ = env.step(action)
            total, length = total + reward, length + 1
        assert callback.history.results[-1, row] == pytest.approx(total)
        assert callback.history.ep_lengths[-1, row] == length


def test_samples_are_the_best_of_their_number():
    """More samples only add; they come from the same numbers every time, and from no global generator."""
    policy, problem = make_model(level="routing").policy, routing_env().problem
    instances = draw_fixed_set(problem, 40, 0)
    th.manual_seed(1)
    state = th.get_rng_state()
    one, many = evaluate_fixed_set(policy, problem, instances, 1), evaluate_fixed_set(policy, problem, instances, 64)
    assert th.equal(th.get_rng_state(), state)
    assert many.sampled.mean() > one.sampled.mean() and many.sampled.mean() > many.greedy.mean()
    assert np.array_equal(many.sampled, evaluate_fixed_set(policy, problem, instances, 64).sampled)
    assert not np.array_equal(one.sampled, evaluate_fixed_set(policy, problem, instances, 1, seed=1).sampled)
    none = evaluate_fixed_set(policy, problem, instances, 0)
    assert none.sampled.shape == (0,) and np.array_equal(none.greedy, many.greedy)


def test_chunks_change_nothing(monkeypatch):
    policy, problem = make_model().policy, allocation_env().problem
    instances = draw_fixed_set(problem, 7, 0)
    whole = evaluate_fixed_set(policy, problem, instances, 0)
    monkeypatch.setattr(fixed_set, "CHUNK_ROWS", 2)
    assert np.array_equal(evaluate_fixed_set(policy, problem, instances, 0).greedy, whole.greedy)
    assert evaluate_fixed_set(policy, problem, instances, 3).sampled.shape == (7,)


def test_the_set_is_the_same_for_every_training_and_unknown_to_it():
    """It depends on the callback's seed alone; REINFORCE and SB3's loop draw other instances even with the same seed."""
    callbacks = [make_callback(seed=5), make_callback(seed=5), make_callback(seed=6)]
    for callback, seed in zip(callbacks, (5, 0, 5), strict=True):
        make_model(REINFORCE, seed=seed).learn(ROLLOUT, callback=callback)
    sets: list[Any] = [callback.instances for callback in callbacks]
    names = [fingerprint(instances, 3) for instances in sets]
    assert names[0] == names[1] != names[2]
    model = make_model(REINFORCE, seed=5)
    drawn = [model.draw_batch(index).depot for index in range(3)]
    env = BatchedVecEnv([allocation_env] * N_ENVS)
    env.seed(5)
    drawn.append(th.as_tensor(env.reset()["depot"]).double())  # type: ignore[call-overload]
    distances = th.cdist(th.cat(drawn).float(), sets[0].depot.float())
    assert distances.min() > 1e-6


# ------------------------------------------------------------------------------------------ the training does not notice


@pytest.mark.parametrize("level", ["allocation", "routing"])
@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO, REINFORCE])
def test_parameters_are_bit_equal_with_and_without(algorithm, level, tmp_path):
    """The network has batch normalization, whose statistics would change if the mode did."""
    trained = []
    for callback in (None, make_callback(tmp_path)):
        model = make_model(algorithm, level, policy_kwargs=dict(BATCH_NORM))
        model.learn(3 * ROLLOUT, callback=callback)
        trained.append(parameters(model))
    assert equal(*trained)
    assert len(load(tmp_path).timesteps) >= 4


def test_policy_keeps_its_mode():
    policy, problem = make_model().policy, allocation_env().problem
    instances = draw_fixed_set(problem, 2, 0)
    for mode in (True, False):
        policy.set_training_mode(mode)
        evaluate_fixed_set(policy, problem, instances, 2)
        assert policy.training is mode and policy.features_extractor.training is mode


def test_its_and_the_router_do_not_notice_either(tmp_path):
    trained = []
    for folder in (None, tmp_path):
        router = dict(policy="RouterPolicy", n_envs=4, learning_rate=1e-2, policy_kwargs=NETWORK)
        its = ITSCallback(
            router, n_epochs=3, n_pretraining_epochs=1, n_intensive_epochs=2, n_continuous_epochs=1, save_path=str(tmp_path)
        )
        callbacks: list[BaseCallback] = [its] if folder is None else [its, make_callback(eval_freq=None)]
        model = make_model(REINFORCE).learn(10**9, callback=callbacks)
        trained.append((parameters(model), parameters(its.router)))
    assert equal(trained[0][0], trained[1][0]) and equal(trained[0][1], trained[1][1])
    # Before training, after each of three epochs of two batches; in the folder of ITS, with the router of the best.
    history = load(tmp_path)
    assert history.timesteps.tolist() == [0, 2 * ROLLOUT, 4 * ROLLOUT, 6 * ROLLOUT]
    best = [load_policy(tmp_path / name) for name in ("best_model.zip", "best_router.zip")]
    assert isinstance(best[0], AllocatorPolicy) and isinstance(best[1], RouterPolicy)
    problem = allocation_env().problem
    problem.router = best[1].plan
    again = evaluate_fixed_set(best[0], problem, Instances.load(tmp_path / "evaluation_instances.npz"), 3)
    assert again.greedy.mean() == pytest.approx(history.results.mean(1).max())


# ------------------------------------------------------------------------------------------ when


@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO, REINFORCE])
def test_times_of_evaluation(algorithm, tmp_path):
    """At the start, before the rollout after each multiple of eval_freq, and at the end; steps are those learned from."""
    make_model(algorithm).learn(5 * ROLLOUT, callback=make_callback(tmp_path, eval_freq=30))
    assert load(tmp_path).timesteps.tolist() == [0, 40, 60, 100]


def test_once_per_epoch_of_reinforce(tmp_path):
    make_model(REINFORCE).learn(5 * ROLLOUT, callback=make_callback(tmp_path, eval_freq=None))
    assert load(tmp_path).timesteps.tolist() == [0, 40, 80, 100]


def test_seldom_without_epochs(tmp_path, monkeypatch):
    monkeypatch.setattr(fixed_set, "DEFAULT_EVAL_FREQ", 50)
    make_model(PPO).learn(6 * ROLLOUT, callback=make_callback(tmp_path, eval_freq=None))
    assert load(tmp_path).timesteps.tolist() == [0, 60, 100, 120]


class Stop(BaseCallback):
    """Ends the training in the middle of a rollout."""

    def _on_step(self) -> bool:
        return self.num_timesteps < 2 * ROLLOUT + N_ENVS


def test_steps_of_a_rollout_that_is_cut_do_not_count(tmp_path):
    make_model(PPO).learn(5 * ROLLOUT, callback=[make_callback(tmp_path, eval_freq=10**6), Stop()])
    assert load(tmp_path).timesteps.tolist() == [0, 2 * ROLLOUT]


def test_time_of_evaluations_is_left_out(tmp_path, monkeypatch):
    """On a clock that evaluations put forward by 1,000 s each, the training takes none of them."""
    clock = [0.0]
    monkeypatch.setattr(FixedSetEvalCallback, "_now", staticmethod(lambda: np.array([clock[0], clock[0]])))
    slow = evaluate_fixed_set

    def put_forward(*args):
        clock[0] += 1000.0
        return slow(*args)

    class Tick(BaseCallback):
        def _on_step(self) -> bool:
            clock[0] += 1.0
            return True

    monkeypatch.setattr(fixed_set, "evaluate_fixed_set", put_forward)
    make_model(PPO).learn(3 * ROLLOUT, callback=[make_callback(tmp_path), Tick()])
    history = load(tmp_path)
    assert history.train_seconds.tolist() == history.cpu_seconds.tolist() == [0.0, 5.0, 10.0, 15.0]
    two = [make_callback(tmp_path / name, seed=seed) for seed, name in enumerate("ab")]
    make_model(PPO).learn(3 * ROLLOUT, callback=[*two, Tick()])
    assert [callback.history.train_seconds.tolist() for callback in two] == [[0.0, 5.0, 10.0, 15.0]] * 2


# ------------------------------------------------------------------------------------------ files


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
    monkeypatch.setattr(fixed_set, "save_atomically", lambda model, path: saved.append((model.num_timesteps, path.name)))
    callback = make_callback(tmp_path, best_by=best_by)
    make_model(PPO).learn(4 * ROLLOUT, callback=callback)
    assert saved == [(0, "best_model.zip"), (3 * ROLLOUT, "best_model.zip")]
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


# ------------------------------------------------------------------------------------------ going on


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
    """But steps are counted on, and the model still knows where those of the earlier set are."""
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


# ------------------------------------------------------------------------------------------ the pretrained router


def test_pretrained_router_gives_the_rewards(tmp_path):
    router = make_model(REINFORCE, "routing")
    router.learn(10 * ROLLOUT)
    router.save(tmp_path / "pretrained")
    evaluation = EvalCallback(BatchedVecEnv([allocation_env]), eval_freq=10**6)
    run = tmp_path / "run"
    instances = UniformGenerator(12, N_UAVS, max_distance=1.5)(30, np.random.default_rng(0))
    fixed = make_callback(run, instances=instances, eval_freq=10**6)
    callbacks = [PretrainedRouterCallback(tmp_path / "pretrained.zip", run), fixed, evaluation]
    model = make_model(PPO)
    model.learn(ROLLOUT, callback=callbacks)
    for env in (model.env, evaluation.eval_env):
        plan = env.get_attr("problem")[0].router
        assert equal(parameters(router), plan.__self__.state_dict())
    assert (run / "router.zip").read_bytes() == (tmp_path / "pretrained.zip").read_bytes()
    problem = allocation_env().problem
    problem.router = plan
    assert np.array_equal(load(run).results[-1], evaluate_fixed_set(model.policy, problem, instances, 0).greedy)
    problem.router = nearest_feasible
    assert not np.array_equal(load(run).results[-1], evaluate_fixed_set(model.policy, problem, instances, 0).greedy)


def test_pretrained_router_leaves_random_numbers_alone(tmp_path):
    make_model(REINFORCE, "routing").save(tmp_path / "router")

    class Watch(BaseCallback):
        states: Any = None

        def _on_training_start(self) -> None:
            self.states = (th.get_rng_state(), np.random.get_state()[1].tolist())  # type: ignore[index]

        def _on_step(self) -> bool:
            return True

    watches = []
    for first in ([], [PretrainedRouterCallback(tmp_path / "router.zip", tmp_path / "run")]):
        watches.append(Watch())
        make_model(PPO).learn(ROLLOUT, callback=[*first, watches[-1]])
    assert th.equal(watches[0].states[0], watches[1].states[0]) and watches[0].states[1] == watches[1].states[1]


def test_pretrained_router_is_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.zip: no such file"):
        PretrainedRouterCallback(tmp_path / "none.zip")
    make_model(PPO).save(tmp_path / "allocator")
    make_model(PPO, "routing").save(tmp_path / "router")
    with pytest.raises(ValueError, match="RouterPolicy is needed here"):
        make_model(PPO).learn(ROLLOUT, callback=PretrainedRouterCallback(tmp_path / "allocator.zip"))
    with pytest.raises(ValueError, match="needs a TaskAllocation environment"):
        make_model(PPO, "routing").learn(ROLLOUT, callback=PretrainedRouterCallback(tmp_path / "router.zip"))
    its = ITSCallback(dict(policy="RouterPolicy", policy_kwargs=NETWORK), save_path=str(tmp_path))
    with pytest.raises(ValueError, match="both bring a router"):
        make_model(REINFORCE).learn(ROLLOUT, callback=[PretrainedRouterCallback(tmp_path / "router.zip"), its])


# ------------------------------------------------------------------------------------------ arguments


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(n_instances=0), "n_instances is 0; it must be a whole number of at least 1"),
        (dict(n_samples=-1), "n_samples is -1; it must be a whole number of at least 0"),
        (dict(eval_freq=0), "eval_freq is 0"),
        (dict(eval_freq=1.5), r"eval_freq is 1\.5; it must be a whole number"),
        (dict(seed=-1), "seed is -1"),
        (dict(best_by="luck"), "best_by is 'luck'; choose 'greedy' or 'sampled'"),
        (dict(best_by="sampled", n_samples=0), "n_samples is 0; set it to at least 1"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        FixedSetEvalCallback(**arguments)


def test_bad_uses_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.npz"):
        FixedSetEvalCallback(instances=str(tmp_path / "none.npz"))
    other_fleet = UniformGenerator(N_TASKS, n_uavs=3)(2, np.random.default_rng(0))
    with pytest.raises(ValueError, match="trained for 2 UAVs, the instances have 3"):
        model = make_model(PPO, policy_kwargs=dict(NETWORK, shared_scorer=False))
        model.learn(ROLLOUT, callback=make_callback(tmp_path, instances=other_fleet))
    with pytest.raises(ValueError, match="needs an AllocatorPolicy or RouterPolicy on an environment of sb3_uav, found"):
        PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8).learn(8, callback=make_callback(tmp_path))


def test_instances_of_any_size_and_file(tmp_path):
    """The set may have another number of tasks than the training, and padding; a router takes instances of any fleet."""
    parts = [UniformGenerator(n_tasks, 4, max_distance=20.0)(2, np.random.default_rng(0)) for n_tasks in (9, 3)]
    Instances.concatenate(parts).save(tmp_path / "set.npz")
    callback = make_callback(tmp_path / "run", instances=str(tmp_path / "set.npz"))
    make_model(A2C, "routing").learn(ROLLOUT, callback=callback)
    history = load(tmp_path / "run")
    assert (history.results == [9, 9, 3, 3]).all() and (history.ep_lengths == [10, 10, 4, 4]).all()


def test_rewards_may_be_normalized_but_not_observations(tmp_path):
    def learn(**kwargs: Any) -> FixedSetEvalCallback:
        env = VecNormalize(BatchedVecEnv([allocation_env] * 2), **kwargs)
        callback = make_callback(tmp_path)
        PPO(POLICIES["allocation"], env, n_steps=5, batch_size=10, policy_kwargs=NETWORK).learn(10, callback=callback)
        return callback

    results = learn(norm_obs=False).history.results
    assert (results == results.round()).all()
    with pytest.raises(ValueError, match="without wrappers that change observations"):
        learn(norm_obs_keys=["tasks"])


# ------------------------------------------------------------------------------------------ stock rl_zoo3


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

"""Evaluation on a fixed set during training: what it measures and when, and that the training does not notice it."""

from typing import Any

import numpy as np
import pytest
import torch as th
from fixed_set_runs import (
    BATCH_NORM,
    ENVS,
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
    parameters,
    routing_env,
)
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uav.envs import BatchedVecEnv, Instances, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, ITSCallback, fixed_set, fixed_set_returns
from sb3_uav.training.fixed_set_returns import draw_fixed_set, evaluate_fixed_set, fingerprint

pytestmark = pytest.mark.filterwarnings("ignore:FixedSetEvalCallback saves nothing")


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
    monkeypatch.setattr(fixed_set_returns, "_CHUNK_ROWS", 2)
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


@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO, REINFORCE])
def test_times_of_evaluation(algorithm, tmp_path):
    """At the start, before the rollout after each multiple of eval_freq, and at the end; steps are those learned from."""
    make_model(algorithm).learn(5 * ROLLOUT, callback=make_callback(tmp_path, eval_freq=30))
    assert load(tmp_path).timesteps.tolist() == [0, 40, 60, 100]


def test_once_per_epoch_of_reinforce(tmp_path):
    make_model(REINFORCE).learn(5 * ROLLOUT, callback=make_callback(tmp_path, eval_freq=None))
    assert load(tmp_path).timesteps.tolist() == [0, 40, 80, 100]


def test_seldom_without_epochs(tmp_path, monkeypatch):
    monkeypatch.setattr(fixed_set, "_DEFAULT_EVAL_FREQ", 50)
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

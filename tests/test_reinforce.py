import io
import json
import subprocess
import sys
import zipfile
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_uav.common.statistics import significantly_positive, student_t_quantile
from sb3_uav.envs import (
    BatchedVecEnv,
    RoutePlanningEnv,
    TaskAllocationEnv,
    UniformGenerator,
    collected_value,
    nearest_feasible,
)
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE

SMALL: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)
BASELINES = ("none", "exponential", "shared", "critic", "rollout")


def make_env(level: str = "allocator", n_envs: int = 4, n_tasks: int = 6, max_distance: float = 1.2) -> Any:
    if level == "allocator":
        return BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks, 2, max_distance=max_distance)] * n_envs)
    return BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks, max_distance=max_distance)] * n_envs)


def make_model(level: str = "allocator", baseline: str = "shared", env=None, **kwargs) -> Any:
    policy = AllocatorPolicy if level == "allocator" else RouterPolicy
    settings: dict[str, Any] = dict(
        n_samples=3, instances_per_epoch=8, seed=0, device="cpu", policy_kwargs=SMALL, learning_rate=1e-3
    )
    if baseline == "rollout":
        settings["baseline_kwargs"] = dict(n_test_instances=16)
    return REINFORCE(policy, env or make_env(level), baseline=baseline, **{**settings, **kwargs})


def assert_equal_parameters(a: REINFORCE, b: REINFORCE) -> None:
    one, two = a.get_parameters(), b.get_parameters()
    assert one.keys() == two.keys()
    for name in one:
        if name != "policy.optimizer":
            for key, value in one[name].items():
                assert th.equal(value, two[name][key]), (name, key)


# ------------------------------------------------------------------------------------------ learning


def test_cartpole_reaches_400():
    """With SB3's own policy and loop; a random agent scores about 20."""
    env = make_vec_env("CartPole-v1", 8, seed=0)
    kwargs: dict[str, Any] = dict(learning_rate=5e-3, n_steps=256, gamma=0.99, normalize_advantage=True, seed=0, device="cpu")
    model = REINFORCE("MlpPolicy", env, baseline="exponential", **kwargs)
    model.learn(150_000)
    mean = np.mean(evaluate_policy(model, make_vec_env("CartPole-v1", 8, seed=100), n_eval_episodes=20)[0])
    assert mean >= 400


@pytest.mark.slow
@pytest.mark.parametrize("baseline", BASELINES)
def test_router_learns_with_every_baseline(baseline):
    """Greedy tours of 15 tasks with D = 2, against those that always fly to the nearest feasible task."""
    test = UniformGenerator(15, 1, 2.0)(500, np.random.default_rng(1))
    nearest = collected_value(test, nearest_feasible(test)).mean().item()
    env = make_env("router", 64, 15, 2.0)
    # With geometry it would begin as good as nearest_feasible.
    network = dict(embed_dim=32, n_layers=1, n_heads=4, ff_dim=64, geometry=False)
    model = make_model(
        "router", baseline, env, n_samples=4, learning_rate=2e-3, policy_kwargs=network, instances_per_epoch=640
    )
    model.normalize_advantage = baseline != "critic"
    untrained = collected_value(test, model.policy.plan(test)).mean().item()
    model.learn_instances(64 * 100)
    trained = collected_value(test, model.policy.plan(test)).mean().item()
    assert untrained < 0.65 * nearest
    assert trained > (0.7 if baseline == "none" else 0.88) * nearest


@pytest.mark.slow
def test_allocator_learns_to_split():
    """Giving all tasks to one UAV, where an untrained network starts, is far from what the fleet can do."""
    test = UniformGenerator(8, 2, 1.2)(300, np.random.default_rng(1))
    env = make_env("allocator", 64, 8)
    # With geometry it would begin with an even split.
    kwargs: dict[str, Any] = dict(n_samples=6, learning_rate=2e-3, policy_kwargs={**SMALL, "geometry": False})
    model = make_model("allocator", "shared", env, normalize_advantage=True, **kwargs)
    problem = model.problem

    def objective() -> float:
        model.policy.set_training_mode(False)
        return problem.returns(test, model.policy.decode_episodes(test)).mean().item()

    untrained = objective()
    model.learn_instances(64 * 80)
    random_split = problem.returns(test, th.randint(2, (300, 1, 8), generator=th.Generator().manual_seed(0))).mean().item()
    assert objective() > max(untrained, random_split) + 0.25


# ------------------------------------------------------------------------------------------ the gradient


@pytest.mark.parametrize("baseline", ["none", "exponential", "shared", "rollout"])
def test_loss_is_the_papers(baseline):
    """mean((baseline - return) * sum of log-probabilities), by hand on one batch."""
    model = make_model(baseline=baseline)
    gradients = {}

    class Spy(BaseCallback):
        def _on_rollout_end(self) -> None:
            algorithm: Any = self.model
            batch = algorithm._batch
            evaluation = algorithm.policy.evaluate_episodes(batch.instances, batch.actions)
            mean = {"none": 0.0, "shared": batch.returns.mean(1, keepdim=True)}.get(baseline, batch.returns.mean())
            loss = ((mean - batch.returns).float() * evaluation.log_prob.sum(-1)).mean()
            gradients["expected"] = th.autograd.grad(loss, algorithm.policy.features_extractor.scorer.score.weight)[0]

        def _on_step(self) -> bool:
            return True

    model.max_grad_norm = 1e9
    model.learn_instances(4, Spy())
    th.testing.assert_close(
        model.policy.features_extractor.scorer.score.weight.grad, gradients["expected"], atol=1e-5, rtol=1e-4
    )


def test_shared_baseline_is_the_mean_of_the_samples():
    model = make_model()
    returns = th.tensor([[1.0, 2.0, 6.0], [0.0, 0.0, 3.0]])
    instances = UniformGenerator(6, 2)(2, np.random.default_rng(0))
    assert model._baseline.of_episodes(model.problem, instances, returns).tolist() == [[3.0], [1.0]]


def test_exponential_baseline():
    model = make_model(baseline="exponential", baseline_kwargs=dict(beta=0.8))
    found = [model._baseline.of_episodes(model.problem, None, th.full((2, 3), value)).item() for value in (10.0, 20.0, 0.0)]
    assert found == pytest.approx([10.0, 12.0, 9.6])


def test_rollout_baseline_uses_the_current_router():
    """After the router changes, the baseline's values are those of the new router."""
    env = make_env("allocator", 6)
    model = make_model(baseline="rollout", env=env, baseline_kwargs=dict(warmup_epochs=0, n_test_instances=4))
    instances = model.draw_batch(0)
    actions = model.baseline_policy.decode_episodes(instances)
    returns = th.zeros(6, 3, dtype=th.float64)
    for router in (nearest_feasible, lambda subsets: th.zeros(len(subsets), 1, dtype=th.int64)):
        env.env_method("set_router", router)
        values = model._baseline.of_episodes(model.problem, instances, returns)
        assert th.equal(values, model.problem.returns(instances, actions))
    assert (values == 0).all()


def test_rollout_baseline_is_replaced_only_when_better():
    kwargs: dict[str, Any] = dict(policy_kwargs={**SMALL, "geometry": False})
    env = make_env("router", 16, 10, 2.0)
    model = make_model("router", "rollout", env, baseline_kwargs=dict(n_test_instances=200), **kwargs)
    model.set_logger(Logger(None, []))
    start = {name: value.clone() for name, value in model.baseline_policy.state_dict().items()}
    # In the first epoch the moving average stands in.
    assert model._baseline.of_episodes(model.problem, None, th.full((2, 1), 3.0)).tolist() == [[3.0]]
    model._baseline.end_epoch(model.problem)
    assert model.logger.name_to_value["train/baseline_replaced"] == 0
    assert all(th.equal(value, start[name]) for name, value in model.baseline_policy.state_dict().items())

    env = make_env("router", 32, 10, 2.0)
    good = make_model("router", "shared", env, learning_rate=3e-3, **kwargs).learn_instances(32 * 60)
    model.policy.load_state_dict(good.policy.state_dict())
    model._baseline.end_epoch(model.problem)
    assert model.logger.name_to_value["train/baseline_replaced"] == 1
    assert model.logger.name_to_value["train/baseline_gain"] > 0.2
    assert all(th.equal(value, model.policy.state_dict()[name]) for name, value in model.baseline_policy.state_dict().items())


def test_paired_t_test_against_tables():
    table = {(0.95, 9): 1.8331, (0.95, 29): 1.6991, (0.975, 19): 2.0930, (0.95, 999): 1.6464, (0.99, 99): 2.3646}
    for (probability, degrees), expected in table.items():
        assert student_t_quantile(probability, degrees) == pytest.approx(expected, abs=1e-3)
    gain = np.array([0.2, -0.1, 0.3, 0.1, 0.0, 0.2, 0.1, -0.2, 0.3, 0.1])
    # t = 1.94 for 9 degrees of freedom: p = 0.042.
    assert significantly_positive(gain, 0.05) and not significantly_positive(gain, 0.04)
    assert not significantly_positive(-gain, 0.05)
    assert not significantly_positive(np.zeros(5), 0.05) and significantly_positive(np.ones(5), 0.05)


def test_critic_predicts_the_reward_to_go():
    model = make_model("router", "critic", make_env("router", 32), learning_rate=5e-3, n_samples=1)
    model.learn_instances(32 * 60)
    assert model.logger.name_to_value["train/explained_variance"] > 0.4


# ------------------------------------------------------------------------------------------ reproducibility and zips


@pytest.mark.parametrize("level", ["allocator", "router"])
def test_same_seed_same_parameters(level):
    first, second, other = (make_model(level, seed=seed).learn_instances(24) for seed in (0, 0, 1))
    assert_equal_parameters(first, second)
    assert any(not th.equal(a, b) for a, b in zip(first.policy.parameters(), other.policy.parameters(), strict=True))


@pytest.mark.parametrize("baseline", BASELINES)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_save_load_continue_equals_no_break(baseline, preset, tmp_path):
    kwargs: dict[str, Any] = dict(policy_kwargs={**SMALL, "preset": preset}, lr_decay=0.9)
    unbroken = make_model(baseline=baseline, **kwargs).learn_instances(40)
    broken = make_model(baseline=baseline, **kwargs).learn_instances(20)
    broken.save(tmp_path / "model")
    # Another seed given at loading must not matter either: the streams go on.
    resumed = REINFORCE.load(tmp_path / "model", env=make_env(), seed=7).learn_instances(20)
    assert_equal_parameters(unbroken, resumed)
    assert (resumed.n_instances, resumed.epoch, resumed.num_timesteps) == (40, 5, unbroken.num_timesteps)
    assert resumed.baseline_state == unbroken.baseline_state


def test_zip_holds_the_baseline_and_no_surprises(tmp_path):
    model = make_model(baseline="rollout", learning_rate=5e-2).learn_instances(40)
    model.save(tmp_path / "model.zip")
    data, parameters, _ = load_from_zip_file(tmp_path / "model.zip")
    assert set(parameters) == {"policy", "policy.optimizer", "baseline_policy"}
    assert data is not None
    assert data["baseline"] == "rollout" and "_batch" not in data and "_baseline" not in data
    raw = json.loads(zipfile.ZipFile(tmp_path / "model.zip").read("data"))
    ours = ("n_samples", "baseline", "baseline_kwargs", "instances_per_epoch", "lr_decay", "stream_seed", "baseline_state")
    for name in (*ours, "n_batches", "n_instances", "epoch", "policy_kwargs"):
        assert not (isinstance(raw[name], dict) and ":serialized:" in raw[name]), name
    loaded = REINFORCE.load(tmp_path / "model.zip")
    assert_equal_parameters(model, loaded)
    assert loaded.baseline_policy is not None
    for parameter in loaded.baseline_policy.parameters():
        assert not parameter.requires_grad


def test_zip_loads_in_a_fresh_process(tmp_path):
    model = make_model().learn_instances(8)
    model.save(tmp_path / "model")
    env = make_env()
    env.seed(3)
    observation = env.reset()
    expected = model.predict(observation, deterministic=True)[0].tolist()
    np.savez(tmp_path / "observation.npz", **observation)
    code = (
        "import sys, numpy as np; from sb3_uav.reinforce import REINFORCE; "
        "observation = dict(np.load(sys.argv[2])); model = REINFORCE.load(sys.argv[1]); "
        "print(model.predict(observation, deterministic=True)[0].tolist())"
    )
    arguments = [sys.executable, "-c", code, str(tmp_path / "model"), str(tmp_path / "observation.npz")]
    printed = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    assert json.loads(printed) == expected


def test_failed_save_keeps_the_old_zip(tmp_path, monkeypatch):
    model = make_model()
    model.save(tmp_path / "model.zip")
    before = (tmp_path / "model.zip").read_bytes()

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stable_baselines3.common.save_util.th.save", full_disk)
    with pytest.raises(OSError, match="No space left"):
        model.learn_instances(4).save(tmp_path / "model.zip")
    assert (tmp_path / "model.zip").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


def test_saves_to_a_buffer():
    buffer = io.BytesIO()
    model = make_model()
    model.save(buffer)
    assert_equal_parameters(model, REINFORCE.load(io.BytesIO(buffer.getvalue())))


# ------------------------------------------------------------------------------------------ SB3's manner


class Count(BaseCallback):
    """What a callback sees."""

    def __init__(self) -> None:
        super().__init__()
        self.calls, self.starts, self.ends, self.episodes = 0, 0, 0, 0

    def _on_rollout_start(self) -> None:
        self.starts += 1

    def _on_rollout_end(self) -> None:
        self.ends += 1

    def _on_step(self) -> bool:
        self.calls += 1
        assert self.num_timesteps == self.calls * self.training_env.num_envs
        self.episodes += sum("episode" in info for info in self.locals["infos"])
        return True


def test_callbacks_and_counters_follow_sb3():
    """One call per n_envs steps; all episodes reported; num_timesteps counts the steps of all samples."""
    counter = Count()
    model = make_model(n_samples=3).learn(4 * 6 * 3 * 5, callback=counter)
    assert model.num_timesteps == 4 * 6 * 3 * 5
    assert (counter.calls, counter.starts, counter.ends) == (6 * 3 * 5, 5, 5)
    assert counter.episodes == 4 * 3 * 5
    assert model.n_instances == 20 and model.epoch == 2 and model.n_batches == 5
    assert model.ep_info_buffer[-1]["l"] == 6


def test_logger_keys(tmp_path):
    model = make_model(baseline="critic")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * 6 * 3 * 2)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    train = "loss policy_gradient_loss entropy_loss value_loss explained_variance learning_rate n_updates grad_norm epoch"
    rollout = ["rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "time/iterations", "time/total_timesteps"]
    assert {*rollout, *(f"train/{name}" for name in train.split())} <= set(header)


def test_learning_rate_decays_per_epoch():
    model = make_model(lr_decay=0.5, learning_rate=0.01)
    rates = []
    for _ in range(4):
        model.learn_instances(4)
        rates.append(model.policy.optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([0.01, 0.01, 0.005, 0.005])


def test_a_callback_can_stop_the_training():
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.num_timesteps < 40

    model = make_model().learn(10_000, callback=Stop())
    assert model.num_timesteps == 40 and model.n_instances == 0


def test_eval_callback_and_predict(tmp_path):
    env = make_env()
    callback = EvalCallback(make_env(n_envs=2), n_eval_episodes=4, eval_freq=18, log_path=str(tmp_path), verbose=0)
    model = make_model(env=env).learn(4 * 6 * 3 * 2, callback=CallbackList([callback]))
    actions, _ = model.predict(env.reset(), deterministic=True)
    assert actions.shape == (4,) and env.action_masks()[np.arange(4), actions].all()
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (2, 4)


def test_progress_bar_reaches_the_end(capsys):
    make_model().learn(4 * 6 * 3 * 2, progress_bar=True)
    assert "144/144" in capsys.readouterr().out


@pytest.mark.parametrize("env_id", ["TaskAllocation-U3-N20-v0", "RoutePlanning-N20-v0"])
def test_env_by_name(env_id):
    policy = "AllocatorPolicy" if env_id.startswith("Task") else "RouterPolicy"
    model = REINFORCE(policy, env_id, policy_kwargs=SMALL, device="cpu", seed=0).learn(40)
    assert model.problem is not None and model.n_instances >= 1


def test_wrappers_that_change_rewards_leave_sb3s_loop():
    env = VecNormalize(make_env(), norm_obs=False, norm_reward=True)
    model = make_model(baseline="exponential", env=env, n_steps=12).learn(4 * 12 * 2)
    assert model.problem is None and model._n_updates == 2
    assert make_model(env=VecMonitor(make_env())).problem is not None
    with pytest.raises(ValueError, match="baseline 'shared' replays instances"):
        make_model(baseline="shared", env=VecNormalize(make_env(), norm_obs=False)).learn(48)


def test_advantages_of_the_step_loop_by_hand():
    """Discounted rewards to go, and 0 in episodes that have not ended."""
    env = make_vec_env("CartPole-v1", 2, seed=0)
    model = REINFORCE("MlpPolicy", env, n_steps=64, gamma=0.9, baseline="none", seed=0, device="cpu")
    _, callback = model._setup_learn(128)
    assert model.env is not None
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 64)
    assert model._last_episode_starts is not None
    buffer = model.rollout_buffer
    expected = np.zeros((64, 2))
    for i in range(2):
        ends = [*(np.flatnonzero(buffer.episode_starts[:, i])[1:] - 1), *([63] if model._last_episode_starts[i] else [])]
        assert len(ends) > 0
        for first, last in zip([0, *(end + 1 for end in ends)], ends, strict=False):
            for step in range(first, last + 1):
                expected[step, i] = sum(0.9 ** (t - step) for t in range(step, last + 1))
    complete = expected > 0
    assert 0 < (~complete).sum() < 100
    assert buffer.advantages == pytest.approx(expected * 128 / complete.sum(), rel=1e-5)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(baseline="rolout"), "baseline is 'rolout'; choose one of"),
        (dict(baseline="shared", n_samples=1), "set n_samples to at least 2"),
        (dict(n_samples=0), "n_samples is 0; it must be a whole number of at least 1"),
        (dict(n_samples=1.5), "n_samples is 1.5; it must be a whole number"),
        (dict(lr_decay=-1), "lr_decay is -1; it must be above 0"),
        (dict(baseline="rollout", baseline_kwargs=dict(alpha=2)), "alpha is 2; a significance level lies between 0 and 1"),
        (dict(instances_per_epoch=0), "instances_per_epoch is 0"),
        (dict(baseline="exponential", baseline_kwargs=dict(beta=1.5)), "beta of the exponential baseline is 1.5"),
        (dict(baseline="exponential", baseline_kwargs=dict(bet=0.5)), "do not fit baseline 'exponential'"),
        (dict(baseline="rollout", baseline_kwargs=dict(n_test_instances=1)), "n_test_instances is 1"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(**kwargs)


def test_a_single_advantage_is_no_division_by_zero():
    model = make_model(baseline="none", env=make_env(n_envs=1), n_samples=1, normalize_advantage=True).learn_instances(3)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_continuous_actions_are_refused():
    with pytest.raises(AssertionError, match=r"only supports.*Discrete"):
        REINFORCE("MlpPolicy", "Pendulum-v1")


@pytest.mark.parametrize(("before", "after"), [("rollout", "shared"), ("shared", "rollout")])
def test_another_baseline_after_loading(before, after, tmp_path):
    """A new rollout baseline starts as a copy of the policy."""
    model = make_model(baseline=before).learn_instances(8)
    model.save(tmp_path / "model")
    loaded: Any = REINFORCE.load(tmp_path / "model", env=make_env(), baseline=after, baseline_kwargs={})
    if after == "rollout":
        loaded._baseline.n_test_instances = 8
        for mine, copied in zip(loaded.policy.parameters(), loaded.baseline_policy.parameters(), strict=True):
            assert th.equal(mine, copied)
    assert loaded.learn_instances(8).n_instances == 16


def test_environment_can_be_set_after_loading_and_be_larger(tmp_path):
    model = make_model().learn_instances(8)
    model.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model")
    loaded.set_env(make_env())
    assert loaded.learn_instances(8).n_instances == 16
    larger = REINFORCE.load(tmp_path / "model", env=make_env(n_envs=12))
    assert larger.learn_instances(12).n_instances == 20


def test_rows_that_differ_leave_sb3s_loop():
    """One row of a DummyVecEnv cannot stand for others with another D."""
    alike = DummyVecEnv([lambda: TaskAllocationEnv(6, 2, max_distance=1.2)] * 2)
    distances = iter((0.5, 3.0))
    mixed = DummyVecEnv([lambda: TaskAllocationEnv(6, 2, max_distance=next(distances))] * 2)
    assert make_model(baseline="none", env=alike).problem is not None
    assert make_model(baseline="none", env=mixed).problem is None


def test_replaying_baselines_are_refused_elsewhere():
    with pytest.raises(ValueError, match="use 'none', 'exponential' or 'critic' here"):
        REINFORCE("MlpPolicy", "CartPole-v1", baseline="rollout")
    with pytest.raises(ValueError, match="use learn here"):
        REINFORCE("MlpPolicy", "CartPole-v1").learn_instances(3)


def test_no_instance_is_drawn_twice():
    """Reset of the environment, training batches and test of the baseline use disjoint streams, for seed 0 too."""
    model = make_model(baseline="rollout")
    drawn = []
    generator = model.problem.generator

    class Recorder:
        n_tasks, n_uavs = generator.n_tasks, generator.n_uavs

        def __call__(self, batch_size, rng):
            instances = generator(batch_size, rng)
            drawn.append(instances.depot)
            return instances

    model.problem.generator = Recorder()
    model.learn_instances(16)
    points = th.cat(drawn)
    assert len(points) == 4 + 16 + 2 * 16
    assert len(points.unique(dim=0)) == len(points)

"""REINFORCE as a Stable-Baselines3 algorithm: callbacks, logs, environments and arguments."""

import numpy as np
import pytest
import torch as th
from reinforce_models import SMALL, make_env, make_model
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_uav.envs import (
    TaskAllocationEnv,
)
from sb3_uav.reinforce import REINFORCE


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

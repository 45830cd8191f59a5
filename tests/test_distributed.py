"""Training shared by two processes: gradients, decisions and files as in a single one."""

import os
import signal
from typing import Any

import numpy as np
import pytest
import torch as th
from ranks import run_ranks
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.common import distributed
from sb3_uav.common.random_streams import PartGenerator, exponential_noise
from sb3_uav.envs.allocation import TaskAllocationEnv
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.reinforce import REINFORCE

SMALL: dict[str, Any] = dict(embed_dim=16, n_heads=2, n_layers=2, ff_dim=16)
# Seven instances: shares of 3 and 4.
N_ENVS = 7
SETTINGS: dict[str, dict[str, Any]] = {
    "shared": dict(baseline="shared", n_samples=3, normalize_advantage=True),
    "instance": dict(baseline="shared", n_samples=3, normalize_advantage="instance"),
    "exponential": dict(baseline="exponential", ent_coef=0.1),
    "rollout": dict(baseline="rollout", baseline_kwargs=dict(warmup_epochs=0, n_test_instances=11)),
    "critic": dict(baseline="critic", normalize_advantage=True),
    "none": dict(baseline="none", micro_batch_size=2),
}


def make(level="router", preset="default", n_envs=N_ENVS, **settings):
    make_env = (lambda: RoutePlanningEnv(n_tasks=9)) if level == "router" else lambda: TaskAllocationEnv(n_tasks=9, n_uavs=2)
    policy = "RouterPolicy" if level == "router" else "AllocatorPolicy"
    settings = {**SETTINGS["shared"], **settings}
    network = dict(preset=preset, **SMALL)
    env = BatchedVecEnv([make_env] * n_envs)
    return REINFORCE(
        policy, env, policy_kwargs=network, seed=3, learning_rate=1e-3, instances_per_epoch=14, device="cpu", **settings
    )


class Gradients(BaseCallback):
    """Keeps the first gradient, after clipping, and what was logged with it."""

    def __init__(self):
        super().__init__()
        self.gradient, self.logged = None, {}

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        if self.gradient is None and self.model._n_updates == 1:
            gradients = [p.grad.flatten() for p in self.model.policy.parameters() if p.grad is not None]
            self.gradient = th.cat(gradients).double().numpy()
            self.logged = dict(self.logger.name_to_value)


def train(model, n_updates=3):
    """:return: Gradient of the first update, parameters at the end, what the first update logged, and the counters"""
    kept = Gradients()
    model.learn_instances(n_updates * model.n_envs, kept, log_interval=10**6)
    parameters = {name: value.double().numpy().copy() for name, value in model.policy.state_dict().items()}
    counters = model.num_timesteps, model.n_instances, model.epoch, model.steps_ahead, model.baseline_state
    return kept.gradient, parameters, kept.logged, counters


@pytest.mark.parametrize("level, preset, kind", [
    ("router", "default", "shared"),
    ("router", "paper", "rollout"),
    ("router", "default", "critic"),
    ("router", "default", "none"),
    ("allocator", "paper", "exponential"),
    ("allocator", "default", "instance"),
])  # fmt: skip
def test_two_ranks_give_the_gradient_of_one(tmp_path, level, preset, kind):
    expected = train(make(level, preset, **SETTINGS[kind]))
    first, second = run_ranks(2, tmp_path, lambda _: train(make(level, preset, **SETTINGS[kind])))
    # float32, clipped to a norm of 1: the sums have another order.
    assert np.abs(expected[0]).max() > 1e-3
    np.testing.assert_allclose(first[0], expected[0], rtol=0, atol=1e-6)
    for name, values in first[1].items():
        # Several updates later both ranks are bit-equal ...
        np.testing.assert_array_equal(values, second[1][name], err_msg=name)
        # ... and near a single process; Adam's first steps have the size of the learning rate, whatever the gradient's.
        np.testing.assert_allclose(values, expected[1][name], atol=1e-4, err_msg=name)
    assert first[3] == second[3]
    assert first[3][:4] == expected[3][:4]
    for name in ("train/loss", "train/grad_norm", "train/policy_gradient_loss", "train/entropy_loss"):
        assert first[2][name] == pytest.approx(expected[2][name], rel=1e-4, abs=1e-6), name


def test_noise_of_some_rows_is_that_of_the_whole_batch():
    whole = exponential_noise(th.zeros(7, 2, 3), th.Generator().manual_seed(5))
    rows = slice(2, 5)
    part = PartGenerator.of(th.Generator().manual_seed(5), rows, 7)
    th.testing.assert_close(exponential_noise(th.zeros(3, 2, 3), part), whole[rows], rtol=0, atol=0)


def test_a_single_process_needs_no_others():
    assert (distributed.world_size(), distributed.rank(), distributed.is_main()) == (1, 0, True)
    rows = th.arange(6).view(3, 2)
    assert distributed.gather(rows, 3) is rows
    assert distributed.sum_with_gradient(rows) is rows
    assert distributed.on_main(lambda: 5) == 5
    assert distributed.all_agree(True) and not distributed.all_agree(False)


def collectives(rank):
    whole = th.arange(35).view(5, 7)
    part = whole[distributed.shard(5)]
    assert len(part) == 2 + rank
    # The last dimension differs, as that of tours does.
    th.testing.assert_close(distributed.gather(part[:, : 5 + 2 * rank], 5, ragged=True)[2:], whole[2:])
    assert distributed.gather(part > 3, 5).dtype == th.bool
    # One row for two ranks: both have it.
    assert distributed.shard(1) == slice(0, 1) and len(distributed.gather(whole[:1], 1)) == 1
    assert distributed.total(rank + 1) == 3
    assert not distributed.all_agree(rank == 0)
    assert distributed.broadcast(f"rank {rank}") == "rank 0"
    messages = []
    for call in (lambda: distributed.on_main(lambda: 1 // 0), lambda: distributed.require_equal("seed", rank)):
        try:
            call()
        except (ValueError, ZeroDivisionError) as error:
            messages.append(str(error))
    weight = th.nn.Parameter(th.ones(2))
    unused = th.nn.Parameter(th.ones(3))
    half = th.nn.Parameter(th.ones(1))
    weight.grad = th.full((2,), float(rank + 1))
    if rank == 1:
        half.grad = th.full((1,), 7.0)
    distributed.sum_gradients([weight, unused, half])
    assert weight.grad is not None and weight.grad.tolist() == [3.0, 3.0]
    assert half.grad is not None and half.grad.tolist() == [7.0]
    assert unused.grad is None
    return messages


def test_collective_operations(tmp_path):
    first, second = run_ranks(2, tmp_path, collectives)
    assert first[0] == second[0] and "by zero" in first[0]
    assert first[1].startswith("The processes of this run differ in seed (rank 0: 0, rank 0: 0)")
    assert "rank 1: 1, rank 0: 0" in second[1]


@pytest.mark.parametrize("before, after", [(1, 2), (2, 1)])
def test_any_number_of_ranks_goes_on_with_a_checkpoint(tmp_path, before, after):
    path = tmp_path / "model.zip"

    def first_half(rank):
        model = make("router", "paper")
        train(model, 2)
        if rank == 0:
            model.save(path)

    def second_half(rank):
        return train(REINFORCE.load(path, make("router").env, device="cpu"), 2)

    def run(n, name, function):
        return function(0) if n == 1 else run_ranks(n, tmp_path / name, function)[0]

    run(before, "first", first_half)
    _, parameters, _, counters = run(after, "second", second_half)
    whole = train(make("router", "paper"), 4)
    for name, values in parameters.items():
        np.testing.assert_allclose(values, whole[1][name], atol=1e-4, err_msg=name)
    assert counters[:4] == whole[3][:4]


def test_a_batch_smaller_than_the_number_of_ranks(tmp_path):
    expected = train(make(n_envs=1))
    first, second = run_ranks(2, tmp_path, lambda _: train(make(n_envs=1)))
    np.testing.assert_allclose(first[0], expected[0], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(first[0], second[0])


def test_ranks_that_differ_are_told_so(tmp_path):
    first, second = run_ranks(2, tmp_path, lambda rank: train(make(n_envs=5 + rank)))
    for error in (first, second):
        assert isinstance(error, ValueError) and "differ in settings or progress" in str(error)


def test_not_finite_on_one_rank_stops_both(tmp_path):
    def spoiled(rank):
        model = make()
        play = model.problem.returns
        # Instead of the returns of the second rank alone.
        type(model.problem).returns = lambda self, *args: play(*args) * (float("nan") if rank == 1 else 1.0)
        return train(model)

    for error in run_ranks(2, tmp_path, spoiled):
        assert isinstance(error, ValueError) and "nan" in str(error)


def test_step_loop_is_refused(tmp_path):
    def cart_pole(_):
        REINFORCE("MlpPolicy", "CartPole-v1", device="cpu").learn(10)

    for error in run_ranks(2, tmp_path, cart_pole):
        assert isinstance(error, ValueError) and "can only share whole episodes" in str(error)


@pytest.mark.parametrize("first", [0, 1])
def test_of_an_error_and_what_follows_only_the_error_is_reported(tmp_path, first):
    def one_fails(rank):
        with distributed.process_group():
            assert distributed.world_size() == 2
            if rank == first:
                raise OSError("no space left")
            distributed.barrier()

    results = run_ranks(2, tmp_path, one_fails, connected=False)
    assert isinstance(results[first], OSError)
    assert isinstance(results[1 - first], SystemExit) and results[1 - first].code == 2


def test_a_killed_process_ends_the_others(tmp_path):
    def one_is_killed(rank):
        with distributed.process_group():
            if rank == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            distributed.barrier()

    error, nothing = run_ranks(2, tmp_path, one_is_killed, connected=False)
    assert nothing is None
    assert isinstance(error, ValueError) and "another process of this run has ended" in str(error)

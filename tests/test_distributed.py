"""Training shared by two processes: gradients, decisions and files as in a single one."""


import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.envs.allocation import TaskAllocationEnv
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.reinforce import REINFORCE
from tests.ranks import run_ranks

SMALL = dict(embed_dim=16, n_heads=2, n_layers=2, ff_dim=16)
# Seven instances: shares of 3 and 4.
N_ENVS = 7
SETTINGS = {
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
        self.gradient = None

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

"""What REINFORCE learns, its gradient and its baselines."""

from typing import Any

import numpy as np
import pytest
import torch as th
from reinforce_models import BASELINES, SMALL, make_env, make_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger

from sb3_uav.common.statistics import significantly_positive, student_t_quantile
from sb3_uav.envs import (
    UniformGenerator,
    collected_value,
    nearest_feasible,
)
from sb3_uav.reinforce import REINFORCE

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

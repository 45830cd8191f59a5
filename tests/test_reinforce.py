"""What REINFORCE learns, its gradient and its baselines."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch as th
from reinforce_models import BASELINES, SMALL, make_env, make_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger

from sb3_uav.common.statistics import _student_t_quantile, significantly_positive
from sb3_uav.envs import (
    UniformGenerator,
    collected_value,
    nearest_feasible,
)
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce import REINFORCE, losses
from sb3_uav.reinforce.advantages import scale_by_instance

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
    model.learn_instances(64 * 120)
    random_split = problem.returns(test, th.randint(2, (300, 1, 8), generator=th.Generator().manual_seed(0))).mean().item()
    assert objective() > max(untrained, random_split) + 0.25


# ------------------------------------------------------------------------------------------ epochs


@pytest.mark.parametrize("baseline", ["exponential", "rollout"])
def test_every_epoch_that_a_batch_completes_is_closed(baseline):
    """640 instances at 20 an epoch are 32 epochs, whether or not a batch holds several."""
    model = make_model(baseline=baseline, env=make_env(n_envs=64), instances_per_epoch=20, lr_decay=0.9, learning_rate=0.01)
    model.learn_instances(64)
    assert model.epoch == 3
    model.learn_instances(64)
    assert model.epoch == 6
    # The second batch was learned at the rate of the epoch in which it began.
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(0.01 * 0.9**3)
    model.learn_instances(640 - 128)
    assert model.epoch == 32


def test_the_baseline_is_tested_once_per_update_as_at_the_end_of_its_last_epoch(monkeypatch):
    model = make_model(baseline="rollout", env=make_env(n_envs=64), instances_per_epoch=20)
    tested = []
    monkeypatch.setattr(model._baseline, "end_epoch", lambda problem: tested.append(model.epoch))
    for _ in range(3):
        model.learn_instances(64)
    # 64, 128 and 192 instances complete 3, 6 and 9 epochs; the epochs count from 0.
    assert tested == [2, 5, 8] and model.epoch == 9


# ------------------------------------------------------------------------------------------ the gradient


class GradientByHand(BaseCallback):
    """The gradient of a loss that is computed from the episodes of the last update, for one layer."""

    def __init__(self, loss: Callable[[Any, Any], th.Tensor]) -> None:
        super().__init__()
        self.loss = loss
        self.gradient: Any = None

    def _on_rollout_end(self) -> None:
        algorithm: Any = self.model
        batch = algorithm._batch
        evaluation = algorithm.policy.evaluate_episodes(batch.instances, batch.actions)
        self.gradient = th.autograd.grad(self.loss(batch, evaluation), watched(algorithm))[0]

    def _on_step(self) -> bool:
        return True


def watched(model: Any) -> th.nn.Parameter:
    extractor = model.policy.features_extractor
    return extractor.scorer.score.weight if isinstance(model.policy, AllocatorPolicy) else extractor.encoder.embed_task.weight


def assert_gradient(model: Any, by_hand: GradientByHand) -> None:
    assert by_hand.gradient.abs().max() > 1e-3
    th.testing.assert_close(watched(model).grad, by_hand.gradient, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("baseline", ["none", "exponential", "shared", "rollout"])
def test_loss_is_the_papers(baseline, normalize):
    """mean((baseline - return) * sum of log-probabilities), by hand on one batch; normalized by the standard deviation."""

    def loss(batch: Any, evaluation: Any) -> th.Tensor:
        mean = {"none": 0.0, "shared": batch.returns.mean(1, keepdim=True)}.get(baseline, batch.returns.mean())
        costs = (mean - batch.returns).float()
        costs = costs / costs.std() if normalize else costs
        return (costs * evaluation.log_prob.sum(-1)).mean()

    by_hand = GradientByHand(loss)
    model = make_model(baseline=baseline, normalize_advantage=normalize, max_grad_norm=1e9).learn_instances(4, by_hand)
    assert_gradient(model, by_hand)


def test_advantages_can_be_scaled_instance_by_instance():
    """An instance that is worth a million times as much does not weigh a million times as much."""
    advantages = th.tensor([[1.0, -1.0, 0.0], [2e6, -1e6, -1e6], [0.0, 0.0, 0.0], [3.0, 0.0, -3.0]])
    scaled = scale_by_instance(advantages)
    deviation = advantages.std(1)
    assert deviation.median() == deviation[0] == 1.0
    th.testing.assert_close(scaled[0], advantages[0] / 2)
    th.testing.assert_close(scaled[1], advantages[1] / (deviation[1] + 1))
    assert (scaled[2] == 0).all() and scaled.abs().max() < 2
    assert not scale_by_instance(th.zeros(4, 3)).any()

    def loss(batch: Any, evaluation: Any) -> th.Tensor:
        gain = scale_by_instance((batch.returns - batch.returns.mean(1, keepdim=True)).float())
        return -(gain * evaluation.log_prob.sum(-1)).mean()

    by_hand = GradientByHand(loss)
    model = make_model(baseline="shared", normalize_advantage="instance", max_grad_norm=1e9).learn_instances(4, by_hand)
    assert_gradient(model, by_hand)
    with pytest.raises(ValueError, match="normalize_advantage is 'row'; give True, False or 'instance'"):
        make_model(normalize_advantage="row")


@pytest.mark.parametrize("normalize", [False, True])
def test_critics_loss_weighs_every_step_by_its_own_advantage(normalize):
    """Rewards to go minus values, over the steps before the end of each episode only."""
    found = {}

    def loss(batch: Any, evaluation: Any) -> th.Tensor:
        total, advantages, terms = 0.0, [], []
        for row, sample in np.ndindex(*batch.returns.shape):
            actions = batch.actions[row, sample].tolist()
            # The tour is over when it is back at the depot.
            n_steps = actions.index(0) + 1
            rewards = [float(batch.instances.values[row, action - 1]) if action > 0 else 0.0 for action in actions[:n_steps]]
            for step in range(n_steps):
                advantages.append(sum(rewards[step:]) - evaluation.values[row, sample, step].item())
                terms.append(evaluation.log_prob[row, sample, step])
        found["n_steps"] = len(terms)
        scale = float(np.std(advantages, ddof=1)) if normalize else 1.0
        for advantage, term in zip(advantages, terms, strict=True):
            total = total - advantage / scale * term
        return total / batch.returns.numel()

    by_hand = GradientByHand(loss)
    kwargs: dict[str, Any] = dict(normalize_advantage=normalize, max_grad_norm=1e9, vf_coef=0.0)
    model = make_model("router", "critic", **kwargs).learn_instances(4, by_hand)
    assert found["n_steps"] < 4 * 3 * 7, "no episode ended before the last step"
    assert_gradient(model, by_hand)


def flat_parameters(model: REINFORCE) -> th.Tensor:
    return th.cat([parameter.detach().flatten().clone() for parameter in model.policy.parameters()])


@pytest.mark.parametrize("limit", [1e-3, 1e9])
def test_max_grad_norm_limits_the_update(limit):
    """With plain gradient descent and a learning rate of 1, an update is as long as its gradient, clipped."""
    network = dict(SMALL, optimizer_class=th.optim.SGD)
    model = make_model(max_grad_norm=limit, learning_rate=1.0, policy_kwargs=network)
    before = flat_parameters(model)
    model.learn_instances(4)
    gradient_norm = model.logger.name_to_value["train/grad_norm"]
    assert gradient_norm > 0.01
    length = (flat_parameters(model).double() - before).norm().item()
    assert length == pytest.approx(min(gradient_norm, limit), rel=0.02)


class MeanEntropy(BaseCallback):
    """The entropy that the training reports of every update."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[float] = []

    def _on_rollout_start(self) -> None:
        if "train/entropy_loss" in self.logger.name_to_value:
            self.values.append(-self.logger.name_to_value["train/entropy_loss"])

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("fused", [True, False])
def test_a_positive_ent_coef_favors_entropy(fused):
    changes = []
    for ent_coef in (30.0, -30.0):
        recorder = MeanEntropy()
        if fused:
            kwargs: dict[str, Any] = dict(ent_coef=ent_coef, learning_rate=3e-3, policy_kwargs={**SMALL, "geometry": False})
            make_model(**kwargs).learn_instances(4 * 15, recorder, log_interval=100)
        else:
            env = make_vec_env("CartPole-v1", 2, seed=0)
            model = REINFORCE("MlpPolicy", env, 1e-2, n_steps=64, ent_coef=ent_coef, seed=0, device="cpu")
            model.learn(2 * 64 * 15, recorder, log_interval=100)
        changes.append(recorder.values[-1] - recorder.values[0])
    assert changes[0] > changes[1] + 0.05


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
        assert _student_t_quantile(probability, degrees) == pytest.approx(expected, abs=1e-3)
    gain = np.array([0.2, -0.1, 0.3, 0.1, 0.0, 0.2, 0.1, -0.2, 0.3, 0.1])
    # t = 1.94 for 9 degrees of freedom: p = 0.042.
    assert significantly_positive(gain, 0.05) and not significantly_positive(gain, 0.04)
    assert not significantly_positive(-gain, 0.05)
    assert not significantly_positive(np.zeros(5), 0.05) and significantly_positive(np.ones(5), 0.05)


def test_critic_predicts_the_reward_to_go():
    model = make_model("router", "critic", make_env("router", 32), learning_rate=5e-3, n_samples=1)
    model.learn_instances(32 * 60)
    assert model.logger.name_to_value["train/explained_variance"] > 0.4


# ------------------------------------------------------------------------------------------ numbers that are not finite


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize(("bad", "name"), [(math.nan, "loss"), (math.inf, "loss"), (math.nan, "gradient norm")])
def test_a_loss_or_gradient_that_is_not_finite_stops_before_the_update(fused, bad, name, monkeypatch):
    """The parameters stay as they were, hence finite."""
    model: Any = make_model() if fused else REINFORCE("MlpPolicy", "CartPole-v1", n_steps=32, seed=0, device="cpu")
    learn = (lambda: model.learn_instances(4)) if fused else lambda: model.learn(32, reset_num_timesteps=False)
    learn()
    before = flat_parameters(model)
    if name == "loss":
        monkeypatch.setattr(losses, "_total_loss", lambda *args: bad * sum(p.sum() for p in model.policy.parameters()))
    else:
        next(model.policy.parameters()).register_hook(lambda gradient: gradient * bad)
    with pytest.raises(ValueError, match=rf"The {name} is (nan|-?inf) in update 2, after \d+ steps; .*smaller learning_rate"):
        learn()
    assert th.equal(flat_parameters(model), before) and th.isfinite(before).all()
    assert model._n_updates == 1


def test_a_learning_rate_that_is_far_too_large_stops_with_an_error():
    model = make_model("router", learning_rate=1e30)
    with pytest.raises(ValueError, match="is nan in update"):
        model.learn_instances(400)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


# ------------------------------------------------------------------------------------------ PyTorch's defaults


@pytest.fixture
def other_default(request: pytest.FixtureRequest) -> Iterator[None]:
    """``float64``, or the device ``meta``, on which every use of a tensor that should be on the CPU fails."""
    if request.param == "float64":
        th.set_default_dtype(th.float64)
    else:
        th.set_default_device(request.param)
    yield
    th.set_default_dtype(th.float32)
    th.set_default_device("cpu")


@pytest.mark.parametrize("other_default", ["float64", "meta"], indirect=True)
@pytest.mark.parametrize("baseline", BASELINES)
@pytest.mark.parametrize("level", ["allocator", "router"])
def test_pytorchs_default_dtype_and_device_do_not_matter(level, baseline, other_default):
    with th.device("cpu"):
        model = make_model(level, baseline)
    model.learn_instances(12)
    assert model.epoch == 1 and model.n_batches == 3
    assert all(parameter.dtype == th.float32 for parameter in model.policy.parameters())
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())

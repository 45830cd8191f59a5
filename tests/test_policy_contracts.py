"""What SB3 expects of a policy: saving, loading, training with stock algorithms, errors that name the cause."""

import inspect
import math
import warnings
from dataclasses import asdict, fields, replace
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from policy_helpers import LEVELS, SMALL, UNSET, draw, make_policy, make_vec
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorExtractor, AllocatorPolicy, RouterExtractor, RouterPolicy
from sb3_uav.policies.encoder import SelfAttention
from sb3_uav.policies.settings import _PRESETS, NetworkSettings


class GainAllocatorExtractor(AllocatorExtractor):
    """An extractor of a user, with an argument of its own."""

    def __init__(self, observation_space: Any, gain: float = 1.0, **settings: Any) -> None:
        super().__init__(observation_space, **settings)
        self.gain = nn.Parameter(th.tensor(gain))

    def decode(self, cache: Any, state: Any) -> th.Tensor:
        return self.gain * super().decode(cache, state)


class GainRouterExtractor(RouterExtractor):
    def __init__(self, observation_space: Any, gain: float = 1.0, **settings: Any) -> None:
        super().__init__(observation_space, **settings)
        self.gain = nn.Parameter(th.tensor(gain))

    def decode(self, cache: Any, state: Any) -> th.Tensor:
        return self.gain * super().decode(cache, state)


SUBCLASSES = {"allocator": GainAllocatorExtractor, "router": GainRouterExtractor}


@pytest.mark.parametrize("level", LEVELS)
def test_policy_save_and_load_keep_every_argument(level, tmp_path):
    """None of them has its default value, and all are here: the keys are those of the constructor and the settings."""
    given: dict[str, Any] = dict(
        preset="paper",
        embed_dim=12,
        n_layers=1,
        n_heads=3,
        ff_dim=20,
        normalization="layer",
        use_values=True,
        relative=True,
        geometry=True,
        bias_dim=9,
        shared_scorer=True,
        sweep=True,
        whole=True,
        mixed_precision=True,
        net_arch=dict(pi=[], vf=[8]),
        activation_fn=nn.ReLU,
        ortho_init=True,
        features_extractor_class=SUBCLASSES[level],
        features_extractor_kwargs=dict(gain=2.0),
        optimizer_class=th.optim.AdamW,
        optimizer_kwargs=dict(eps=1e-6, weight_decay=0.1),
    )
    policy = make_policy(level, **given)
    signature, defaults = inspect.signature(type(policy)).parameters, asdict(_PRESETS["paper"])
    settings = set(defaults)
    assert all(given[key] != (defaults[key] if key in settings else signature[key].default) for key in given)
    policy.save(tmp_path / "policy.pth")
    loaded = type(policy).load(tmp_path / "policy.pth", device="cpu")
    not_compared = {"observation_space", "action_space", "lr_schedule"}
    for each in (policy, loaded):
        parameters = each._get_constructor_parameters()
        # use_sde is refused unless False.
        assert set(parameters) == not_compared | set(given) == (set(signature) - {"use_sde", "settings"}) | settings
        for key, value in given.items():
            assert parameters[key] == value, key
        assert type(each.optimizer) is th.optim.AdamW
        assert each.optimizer.defaults["eps"] == 1e-6 and each.optimizer.defaults["weight_decay"] == 0.1
        encoder = each.features_extractor.encoder
        assert (len(encoder.layers), encoder.layers[0].attention.n_heads, encoder.use_values) == (1, 3, True)
    for name, value in policy.state_dict().items():
        assert th.equal(value, loaded.state_dict()[name])


def test_relative_attention_compares_exact_positions_in_mixed_precision():
    """In bfloat16 some of these positions would be the same."""
    th.manual_seed(0)
    attention = SelfAttention(8, 2, relative=True)
    with th.no_grad():
        attention.project_in.weight[:16] = 0.0
        cast(th.Tensor, attention.log_locality).fill_(math.log(1e7))
    nodes, coordinates = th.randn(1, 5, 8), 0.3 + 9e-4 * th.arange(5.0)[None, :, None].expand(1, 5, 2)
    exact = attention(nodes, None, coordinates)
    with th.autocast("cpu", th.bfloat16):
        mixed = attention(nodes, None, coordinates)
    # Every node attends to itself alone, so the five results differ as much as the nodes do.
    assert (exact - attention.project_out(attention.project_in(nodes)[..., 16:])).abs().max() < 0.05
    assert (mixed - exact).abs().max() < 0.02 < exact.std(dim=1).min()


@pytest.mark.parametrize("level", LEVELS)
def test_mixed_precision_changes_little(level):
    """Of what was learned; what the router starts with stays exact."""
    policies = [make_policy(level, mixed_precision=mixed) for mixed in (False, True)]
    instances = draw(4, n_uavs=1 if level == "router" else 3)
    actions = policies[0].decode_episodes(instances)
    for policy in policies:
        th.manual_seed(1)
        extractor = policy.features_extractor
        nn.init.normal_((extractor.move_bias if level == "router" else extractor.scorer).score.weight)
    exact, mixed = (policy.evaluate_episodes(instances, actions).log_prob for policy in policies)
    assert exact.dtype == mixed.dtype == th.float32
    assert not th.equal(exact, mixed)
    assert (exact - mixed).abs().max() < 0.1 < exact.abs().max()
    mixed.sum().backward()
    assert all(parameter.grad is None or parameter.grad.isfinite().all() for parameter in policies[1].parameters())


@pytest.mark.parametrize("task_order, sweep, warned", [("input", True, 1), ("input", False, 0), ("sweep", True, 0)])
def test_tasks_in_another_order_than_the_policys_are_reported_once(task_order, sweep, warned):
    policy: Any = AllocatorPolicy
    env: Any = BatchedVecEnv([lambda: TaskAllocationEnv(12, 3, task_order=task_order)] * 4)
    model = PPO(policy, env, n_steps=4, batch_size=8, n_epochs=1, policy_kwargs={**SMALL, "sweep": sweep}, device="cpu")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(32)
        model.predict(env.reset())
    assert sum("expects the tasks in the order of a sweep" in str(warning.message) for warning in caught) == warned


@pytest.mark.parametrize("level", LEVELS)
def test_extractors_serve_stock_multi_input_policy(level):
    extractor = AllocatorExtractor if level == "allocator" else RouterExtractor
    kwargs: dict[str, Any] = dict(features_extractor_class=extractor, features_extractor_kwargs=SMALL)
    model = PPO("MultiInputPolicy", make_vec(level), n_steps=16, batch_size=32, n_epochs=1, policy_kwargs=kwargs, device="cpu")
    before = [parameter.clone() for parameter in model.policy.features_extractor.parameters()]
    model.learn(128)
    changed = [not th.equal(a, b) for a, b in zip(before, model.policy.features_extractor.parameters(), strict=True)]
    assert sum(changed) > len(changed) / 2


@pytest.mark.parametrize("level", LEVELS)
def test_stock_ppo_trains_evaluates_and_reloads(level, tmp_path):
    env = make_vec(level)
    model = PPO(type(make_policy(level)), env, n_steps=16, batch_size=32, n_epochs=1, policy_kwargs=SMALL, device="cpu")
    model.learn(64)
    mean = np.mean(evaluate_policy(model, env, n_eval_episodes=8)[0])
    assert 0 < mean <= 7
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", device="cpu")
    observation = env.reset()
    assert (loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]).all()


def test_first_full_batch_epoch_of_ppo_has_ratio_one():
    """Catches dropout, normalization and cache faults at once: nothing may differ between acting and training."""
    for level in LEVELS:
        env = make_vec(level, 8)
        kwargs: dict[str, Any] = dict(n_steps=14, batch_size=112, n_epochs=1, policy_kwargs=SMALL, device="cpu", seed=0)
        model = PPO(type(make_policy(level)), env, **kwargs)
        model.learn(112)
        assert abs(model.logger.name_to_value["train/approx_kl"]) < 1e-6
        assert model.logger.name_to_value["train/clip_fraction"] == 0


def test_networks_take_any_number_of_tasks():
    for n_tasks in (1, 3, 50):
        instances = draw(2, n_tasks, 3)
        actions = make_policy("allocator").decode_episodes(instances, 4, False)
        assert actions.shape == (2, 4, n_tasks) and actions.min() >= 0 and actions.max() <= 2
        assert make_policy("router").plan(draw(2, n_tasks, 1)).shape[0] == 2


def test_wrong_fleet_is_refused():
    with pytest.raises(ValueError, match="trained for 3 UAVs, the instances have 5"):
        make_policy("allocator", preset="paper").decode_episodes(draw(2, n_uavs=5))


@pytest.mark.parametrize("n_uavs", [1, 2, 9])
def test_shared_scorer_serves_any_fleet(n_uavs):
    """Made for 3 UAVs: every UAV of another fleet gets tasks."""
    actions = make_policy("allocator", n_uavs=3).decode_episodes(draw(4, n_tasks=40, n_uavs=n_uavs))
    assert [sorted(set(row)) for row in actions[:, 0].tolist()] == [list(range(n_uavs))] * 4


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(preset="papper"), "preset is 'papper'"),
        (dict(normalization="batchnorm"), "normalization is 'batchnorm'"),
        (dict(embed_dim=10, n_heads=4), "embed_dim 10 must be a multiple of n_heads 4"),
        (dict(embed_dim=0), "embed_dim is 0; give a whole number, at least 1"),
        (dict(n_heads="4"), "n_heads is '4'; give a whole number, at least 1"),
        (dict(use_sde=True), "use_sde must be False"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_policy("allocator", **kwargs)


@pytest.mark.parametrize("level", LEVELS)
def test_unknown_settings_are_named(level):
    """By policies and by extractors, which both take every field of NetworkSettings by keyword."""
    policy = make_policy(level)
    with pytest.raises(TypeError, match=r"unexpected keyword arguments \['wings'\]; .*'embed_dim'"):
        make_policy(level, wings=2)
    extractor = type(policy).extractor_class
    with pytest.raises(TypeError, match=r"unexpected keyword arguments \['wings'\]"):
        extractor(policy.observation_space, **SMALL, wings=2)
    extractor(policy.observation_space, **{**asdict(NetworkSettings()), **SMALL})
    assert len(fields(NetworkSettings)) == 13


@pytest.mark.parametrize("level", LEVELS)
def test_settings_come_from_the_preset_unless_given(level):
    assert make_policy(level, **UNSET).settings == _PRESETS["default"]
    assert make_policy(level, preset="paper", **UNSET, relative=True).settings == replace(_PRESETS["paper"], relative=True)


@pytest.mark.parametrize("level", LEVELS)
def test_untrained_copies_have_the_same_architecture_and_their_own_seed(level):
    policy = make_policy(level, net_arch=dict(pi=[], vf=[8]), bias_dim=5)
    state = th.get_rng_state()
    same, equal, other = (policy.untrained_copy(seed) for seed in (0, 0, 1))
    assert th.equal(th.get_rng_state(), state)
    assert type(same) is type(policy) and not same.training
    for name, value in policy.state_dict().items():
        assert same.state_dict()[name].shape == value.shape
        assert th.equal(same.state_dict()[name], equal.state_dict()[name])
    assert any(not th.equal(value, other.state_dict()[name]) for name, value in same.state_dict().items())


@pytest.mark.parametrize("policy", [AllocatorPolicy, RouterPolicy])
def test_foreign_observation_space_is_refused(policy):
    env = make_vec_env("CartPole-v1")
    with pytest.raises(ValueError, match="needs the Dict observation of a sb3_uav environment"):
        policy(env.observation_space, env.action_space, lambda _: 1e-3)


@pytest.mark.parametrize(
    ("level", "environment", "missing"),
    [("allocator", "TaskAllocation", "assignment"), ("router", "RoutePlanning", "position")],
)
def test_observation_space_of_the_other_level_is_refused(level, environment, missing):
    env: Any = RoutePlanningEnv(7) if level == "allocator" else TaskAllocationEnv(7, 3)
    policy_class: Any = AllocatorPolicy if level == "allocator" else RouterPolicy
    message = f"needs the observation of a {environment} environment.*'{missing}'"
    with pytest.raises(ValueError, match=message):
        policy_class.extractor_class(env.observation_space)
    with pytest.raises(ValueError, match=message):
        policy_class(env.observation_space, env.action_space, lambda _: 1e-3)

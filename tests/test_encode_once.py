"""Encodings are kept while they are valid, and no longer."""

from functools import partial
from typing import Any

import pytest
import torch as th
from policy_helpers import LEVELS, SMALL, make_policy, make_vec, shake_statistics
from stable_baselines3 import PPO
from stable_baselines3.common.utils import obs_as_tensor, polyak_update
from torch.nn.utils.prune import random_unstructured

from sb3_uav.envs.problem import STATIC_KEYS
from sb3_uav.policies import AllocatorPolicy

CPU = th.device("cpu")


def parameters_after_training(level: str, n_envs: int, use_cache: bool) -> dict[str, th.Tensor]:
    env = make_vec(level, n_envs)
    env.seed(0)
    kwargs: dict[str, Any] = dict(
        n_steps=14, batch_size=14 * n_envs // 2, n_epochs=2, seed=1, policy_kwargs=SMALL, device="cpu"
    )
    model: Any = PPO(type(make_policy(level)), env, **kwargs)
    model.policy.features_extractor.use_cache = use_cache
    model.learn(14 * n_envs * 3)
    return model.policy.state_dict()


@pytest.mark.parametrize(("level", "n_envs"), [("allocator", 6), ("allocator", 1), ("router", 1)])
def test_cached_and_uncached_training_are_bit_equal(level, n_envs):
    uncached = parameters_after_training(level, n_envs, False)
    for name, value in parameters_after_training(level, n_envs, True).items():
        assert th.equal(value, uncached[name]), name


def test_cached_and_uncached_training_agree_when_episodes_end_apart():
    """Matrix products round differently when only some rows of a batch are encoded again; nothing else may differ."""
    uncached = parameters_after_training("router", 6, False)
    for name, value in parameters_after_training("router", 6, True).items():
        th.testing.assert_close(value, uncached[name], atol=1e-5, rtol=0)


def test_instances_are_encoded_once_per_episode():
    policy = make_policy("allocator")
    env = make_vec("allocator", 4)
    observation = env.reset()
    policy.features_extractor.n_encoded_rows = 0
    for _ in range(7 * 3):
        actions, _ = policy.predict(observation)
        observation, *_ = env.step(actions)
    assert policy.features_extractor.n_encoded_rows == 3 * 4


def test_only_changed_rows_are_encoded_again():
    policy = make_policy("router")
    env = make_vec("router", 5)
    observation = env.reset()
    policy.features_extractor.n_encoded_rows, n_episodes = 0, 5
    for _ in range(40):
        actions, _ = policy.predict(observation)
        expected = make_policy("router").predict(observation, deterministic=True)[0]
        assert (policy.predict(observation, deterministic=True)[0] == expected).all()
        observation, _, dones, _ = env.step(actions)
        n_episodes += dones.sum()
    assert policy.features_extractor.n_encoded_rows == n_episodes - dones.sum()


def load_state_dict(policy, other):
    policy.load_state_dict(other.state_dict())


def load_submodule(policy, other):
    policy.features_extractor.encoder.embed_task.load_state_dict(other.features_extractor.encoder.embed_task.state_dict())


def load_from_vector(policy, other):
    policy.load_from_vector(other.parameters_to_vector())


def train(policy, other):
    policy.set_training_mode(True)
    with th.no_grad():
        for mine, theirs in zip(policy.parameters(), other.parameters(), strict=True):
            mine.copy_(theirs)
    policy.set_training_mode(False)


def average(policy, other):
    polyak_update(other.parameters(), policy.parameters(), 0.5)


def average_data(policy, other):
    """Leaves data_ptr() and _version as they are."""
    for mine, theirs in zip(policy.parameters(), other.parameters(), strict=True):
        mine.data.lerp_(theirs.data, 0.5)


def replace_data(policy, other):
    for mine, theirs in zip(policy.parameters(), other.parameters(), strict=True):
        mine.data = theirs.data.clone()


def optimize(policy, other, optimizer_class: Any = th.optim.SGD, **kwargs):
    """In evaluation mode, as a training loop of one's own may."""
    optimizer = optimizer_class(policy.parameters(), lr=0.01, **kwargs)
    with th.enable_grad():
        level = "allocator" if isinstance(policy, AllocatorPolicy) else "router"
        tensor: Any = obs_as_tensor(make_vec(level).reset(), CPU)
        values, log_prob, _ = policy.evaluate_actions(tensor, tensor["action_mask"].argmax(1))
        (values.sum() - log_prob.sum()).backward()
    optimizer.step()


def negate(policy, other):
    """Keeps the norm of every parameter."""
    for parameter in policy.features_extractor.encoder.embed_task.parameters():
        parameter.data.neg_()


def exchange_rows(policy, other):
    """Keeps the norm and the sum of every parameter."""
    weight = policy.features_extractor.encoder.embed_task.weight
    weight.data = weight.data.flip(0)


def write_through_numpy(policy, other):
    policy.features_extractor.encoder.embed_task.bias.detach().numpy()[3] += 0.5


def prune(policy, other):
    random_unstructured(policy.features_extractor.encoder.embed_task, "weight", 0.5)


def exchange_parameter(policy, other):
    policy.features_extractor.encoder.embed_depot = other.features_extractor.encoder.embed_depot


def exchange_statistics(policy, other):
    """Buffers count too: those of batch normalization."""
    shake_statistics(policy)


CHANGES = [
    load_state_dict,
    load_submodule,
    load_from_vector,
    train,
    average,
    average_data,
    replace_data,
    optimize,
    partial(optimize, optimizer_class=th.optim.Adam, fused=True),
    negate,
    exchange_rows,
    write_through_numpy,
    prune,
    exchange_parameter,
    exchange_statistics,
]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: getattr(change, "__name__", "fused_adam"))
def test_kept_encodings_do_not_outlive_a_change_of_parameters(change, level):
    """However it is made: what a policy without a cache computes is right."""
    settings = {"preset": "paper"} if change is exchange_statistics else {"sweep": False}
    policy, other = (make_policy(level, seed=seed, **settings) for seed in (0, 1))
    tensor = obs_as_tensor(make_vec(level).reset(), CPU)
    with th.no_grad():
        before = policy.predict_values(tensor)
        change(policy, other)
        found = policy.predict_values(tensor)
        policy.features_extractor.use_cache = False
        assert th.equal(found, policy.predict_values(tensor))
        assert not th.equal(found, before)


@pytest.mark.parametrize("level", LEVELS)
def test_unchanged_parameters_keep_encodings(level):
    """Of parameters that are compared byte by byte, NaN among them."""
    policy = make_policy(level, sweep=False)
    policy.features_extractor.encoder.embed_task.bias.data[0] = th.nan
    tensor = obs_as_tensor(make_vec(level).reset(), CPU)
    with th.no_grad():
        for _ in range(3):
            policy.predict_values(tensor)
    assert policy.features_extractor.n_encoded_rows == 4


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("key", STATIC_KEYS)
def test_observations_overwritten_in_place_are_noticed(level, key):
    """Tensors share the memory of an environment's arrays, so the cache must not compare an array with itself."""
    policy, env = make_policy(level), make_vec(level)
    env.seed(0)
    observation = env.reset()
    tensor = obs_as_tensor(observation, CPU)
    with th.no_grad():
        before = policy(tensor, deterministic=True)
        for row in (2, slice(None)):
            if key == "task_mask":
                observation[key][row, -2 if row == 2 else -3 :] = 0
            else:
                observation[key][row] = 0.5 * observation[key][row] + 0.1
            assert th.equal(tensor[key], th.from_numpy(observation[key]))
            _, values, log_prob = policy(tensor, deterministic=True)
            _, fresh_values, fresh_log_prob = make_policy(level)(tensor, deterministic=True)
            th.testing.assert_close(values, fresh_values, atol=1e-6, rtol=0)
            th.testing.assert_close(log_prob, fresh_log_prob, atol=1e-6, rtol=0)
            assert (values != before[1])[row].all()

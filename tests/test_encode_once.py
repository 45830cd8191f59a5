"""Encodings are kept while they are valid, and no longer."""

from typing import Any

import pytest
import torch as th
from policy_helpers import LEVELS, SMALL, make_policy, make_vec
from stable_baselines3 import PPO
from stable_baselines3.common.utils import obs_as_tensor


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


def load_from_vector(policy, other):
    policy.load_from_vector(other.parameters_to_vector())


def train(policy, other):
    policy.set_training_mode(True)
    with th.no_grad():
        for mine, theirs in zip(policy.parameters(), other.parameters(), strict=True):
            mine.copy_(theirs)
    policy.set_training_mode(False)


@pytest.mark.parametrize("change", [load_state_dict, load_from_vector, train])
def test_changed_parameters_clear_the_cache(change):
    policy, other = make_policy("allocator"), make_policy("allocator", seed=1)
    tensor = obs_as_tensor(make_vec("allocator").reset(), th.device("cpu"))
    with th.no_grad():
        before = policy.predict_values(tensor)
        change(policy, other)
        assert th.equal(policy.predict_values(tensor), other.predict_values(tensor))
        assert not th.equal(policy.predict_values(tensor), before)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("key", ["depot", "tasks", "task_values"])
def test_observations_overwritten_in_place_are_noticed(level, key):
    """Tensors share the memory of an environment's arrays, so the cache must not compare an array with itself."""
    policy, env = make_policy(level), make_vec(level)
    env.seed(0)
    observation = env.reset()
    tensor = obs_as_tensor(observation, th.device("cpu"))
    with th.no_grad():
        before = policy(tensor, deterministic=True)
        for row in (2, slice(None)):
            observation[key][row] = 0.5 * observation[key][row] + 0.1
            assert th.equal(tensor[key], th.from_numpy(observation[key]))
            _, values, log_prob = policy(tensor, deterministic=True)
            _, fresh_values, fresh_log_prob = make_policy(level)(tensor, deterministic=True)
            th.testing.assert_close(values, fresh_values, atol=1e-6, rtol=0)
            th.testing.assert_close(log_prob, fresh_log_prob, atol=1e-6, rtol=0)
            assert (values != before[1])[row].all()

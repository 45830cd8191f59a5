"""REINFORCE on environments with masks, with policies of sb3-contrib and of SB3."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from foreign_envs import PickEnv
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy, MaskableMultiInputActorCriticPolicy
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import MultiInputActorCriticPolicy

from sb3_uav.policies import MaskedAttentionPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.masked_steps import MaskedDictRolloutBuffer, MaskedRolloutBuffer


class Flat(gym.ObservationWrapper):
    """A vector without a mask; ``action_masks`` is the environment's own."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(0, 1, (12,), np.float32)

    def observation(self, observation: Any) -> Any:
        return observation["nodes"].ravel()


class NoMethod(gym.Env[Any, Any]):
    """A mask in the observation alone."""

    def __init__(self) -> None:
        self.inner = PickEnv(n_others=1)
        self.observation_space, self.action_space = self.inner.observation_space, self.inner.action_space

    def reset(self, *, seed=None, options=None):
        return self.inner.reset(seed=seed)

    def step(self, action):
        return self.inner.step(action)

    @property
    def n_illegal(self) -> int:
        return self.inner.n_illegal


def make_model(policy: Any, env: Any, **kwargs: Any) -> Any:
    return REINFORCE(policy, env, n_steps=16, seed=0, device="cpu", learning_rate=1e-3, **kwargs)


ROWS: dict[str, tuple[Any, Any]] = {
    "Dict": (lambda: PickEnv(n_others=1), MaskableMultiInputActorCriticPolicy),
    "flat": (lambda: Flat(PickEnv(n_others=1)), MaskableActorCriticPolicy),
    "observed": (NoMethod, MaskableMultiInputActorCriticPolicy),
}


@pytest.mark.parametrize("given", ["class", "alias"])
@pytest.mark.parametrize("kind", ROWS)
def test_maskable_policies_play_no_illegal_action(kind, given, tmp_path):
    make, policy_class = ROWS[kind]
    env = make_vec_env(make, 4, seed=0)
    model = make_model(policy_class if given == "class" else "MlpPolicy" if kind == "flat" else "MultiInputPolicy", env)
    assert type(model.policy) is policy_class
    expected = MaskedRolloutBuffer if kind == "flat" else MaskedDictRolloutBuffer
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(512)
    assert isinstance(model.rollout_buffer, expected) and sum(env.get_attr("n_illegal")) == 0
    assert any(not th.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
    # The hook that passes masks is gone.
    assert not model.policy._forward_pre_hooks
    model.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model", env=env, device="cpu")
    assert type(loaded.policy) is policy_class
    loaded.learn(128)
    assert sum(env.get_attr("n_illegal")) == 0
    if kind != "flat":
        evaluate_policy(loaded, env, n_eval_episodes=20, deterministic=False, warn=False)
        assert sum(env.get_attr("n_illegal")) == 0
    only = np.zeros((4, 7), dtype=bool)
    only[:, 3] = True
    observation: Any = env.reset()
    assert (loaded.predict(observation, action_masks=only)[0] == 3).all()


@pytest.mark.slow
def test_no_illegal_action_in_a_hundred_thousand_draws():
    env = make_vec_env(lambda: PickEnv(12, n_others=1), 64, seed=0)
    model = make_model("MultiInputPolicy", env).learn(100_000)
    assert model.num_timesteps >= 100_000 and sum(env.get_attr("n_illegal")) == 0


def test_log_probabilities_in_training_are_those_of_the_rollout():
    """Masks are stored with the steps that they belong to."""
    env = make_vec_env(ROWS["flat"][0], 4, seed=0)
    model = make_model("MlpPolicy", env).learn(64)
    data = next(model.rollout_buffer.get())
    assert 0.1 < data.action_masks.mean() < 0.95
    fresh = make_model("MlpPolicy", make_vec_env(ROWS["flat"][0], 4, seed=0))
    _, log_prob, _ = fresh.policy.evaluate_actions(data.observations, data.actions.flatten(), action_masks=data.action_masks)
    th.testing.assert_close(log_prob, data.old_log_prob, atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", ["Dict", "observed"])
def test_a_policy_without_masks_is_reported_where_there_are_some(kind):
    env = make_vec_env(ROWS[kind][0], 2, seed=0)
    with pytest.warns(UserWarning, match="MultiInputActorCriticPolicy ignores the action masks of the environment"):
        model = make_model(MultiInputActorCriticPolicy, env)
    with pytest.raises(ValueError, match="takes no action_masks"):
        model.predict(env.reset(), action_masks=np.ones((2, 7)))


def test_no_warning_where_all_is_well():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_model("MlpPolicy", "CartPole-v1").learn(32)
        make_model(MaskedAttentionPolicy, make_vec_env(ROWS["Dict"][0], 2)).learn(32)


def test_a_maskable_policy_needs_masks():
    with pytest.raises(
        ValueError, match=r"MaskableActorCriticPolicy needs action masks, but the environment has none; give it"
    ):
        make_model(MaskableActorCriticPolicy, "CartPole-v1")


def test_whole_episodes_are_refused_for_the_right_reason():
    with pytest.raises(ValueError, match="but MaskedAttentionPolicy is for environments that can only be stepped; use 'none'"):
        make_model("MaskedAttentionPolicy", make_vec_env(ROWS["Dict"][0], 2), baseline="shared", n_samples=2)

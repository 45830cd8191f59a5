"""The masked attention policy on foreign environments, in the four algorithms."""

import runpy
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from foreign_envs import ALGORITHMS, KINDS, POLICY, SMALL, PickEnv, make_env, make_model, make_policy, tensors
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uav.policies import RouterPolicy
from sb3_uav.training import EpisodeRolloutBuffer
from sb3_uav.training.episode_buffer import use_episode_buffer

# ------------------------------------------------------------------------------------------------------------ masks


@pytest.mark.parametrize("kind", [*KINDS, "knapsack.KnapsackEnv", "tsp.TSPEnv"])
def test_environments_are_sound(kind):
    """Those of the tests and of the examples. SB3 warns of the shape alone, and asks for a policy such as ours."""
    name, _, env_class = kind.partition(".")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if env_class:
            check_env(runpy.run_path(str(Path(__file__).parents[1] / "examples" / f"{name}.py"))[env_class]())
        else:
            check_env(PickEnv(**KINDS[kind]))
    assert all("custom policy to properly process" in str(warning.message) for warning in caught)


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("kind", KINDS)
def test_no_illegal_action_in_training_and_prediction(kind, algo):
    env = make_env(**KINDS[kind])
    model = make_model(algo, env).learn(64)
    observation = env.reset()
    for _ in range(10):
        observation, *_ = env.step(model.predict(observation)[0])
    assert sum(env.get_attr("n_illegal")) == 0 and model.num_timesteps >= 64


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_no_illegal_action_in_a_hundred_thousand_draws(algo):
    env = make_env(64, n_nodes=12, n_others=1)
    model = make_model(algo, env, n_steps=64, **(dict(batch_size=1024, n_epochs=1) if "ppo" in algo else {}))
    model.learn(100_000)
    assert sum(env.get_attr("n_illegal")) == 0 and model.num_timesteps >= 100_000


def test_random_play_is_illegal_half_of_the_time():
    """The counter of the two tests above counts."""
    env = make_env(n_others=1)
    env.action_space.seed(0)
    env.reset()
    for _ in range(50):
        env.step(np.array([env.action_space.sample() for _ in range(4)]))
    assert sum(env.get_attr("n_illegal")) > 20


def test_action_masks_argument_wins():
    env = make_env()
    model, observation = make_model("ppo_mask", env), env.reset()
    only = np.zeros((4, 6), dtype=bool)
    only[:, 2] = True
    assert (model.predict(observation, action_masks=only)[0] == 2).all()
    assert (model.policy.predict(observation, action_masks=only)[0] == 2).all()


def test_eval_callback(tmp_path):
    env = make_env()
    callback = EvalCallback(make_env(2), n_eval_episodes=4, eval_freq=10, log_path=str(tmp_path), verbose=0)
    make_model("ppo", env).learn(128, callback=callback)
    assert callback.eval_env.get_attr("n_illegal") == [0, 0]
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (3, 4)


def test_a_mask_that_forbids_everything_is_an_error():
    env = make_env()
    observation = env.reset()
    observation["action_mask"][1] = 0
    policy = make_policy(env)
    with pytest.raises(ValueError, match=r'observation\["action_mask"\] allows no action in row 1'):
        policy.predict(observation)
    # As in the last observation of an episode, whose value SB3 may ask for.
    assert policy.predict_values(tensors(observation)).isfinite().all()


def test_a_normalized_mask_is_an_error():
    """A Box would be scaled by VecNormalize, and every entry of it that is not exactly 0 would count as legal."""

    class BoxMask(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            mask = spaces.Box(0, 1, (6,), np.float32)
            kept: Any = env.observation_space
            self.observation_space = spaces.Dict({**kept.spaces, "action_mask": mask})

        def observation(self, observation):
            return {**observation, "action_mask": observation["action_mask"].astype(np.float32)}

    env = VecNormalize(make_vec_env(lambda: BoxMask(PickEnv()), 2), norm_obs_keys=["nodes", "action_mask"])
    with pytest.raises(ValueError, match="but a mask has only 0 and 1; if VecNormalize scales it, leave it out"):
        make_model("ppo", env).learn(16)
    env = VecNormalize(make_vec_env(lambda: BoxMask(PickEnv()), 2), norm_obs_keys=["nodes"])
    make_model("ppo", env).learn(16)


def test_a_padding_mask_the_other_way_round_is_an_error():
    env = make_env(n_real=4, n_others=1)
    observation = env.reset()
    observation["padding_mask"] = 1 - observation["padding_mask"]
    with pytest.raises(ValueError, match=r"takes for padding; its entries are 1 for real nodes"):
        make_policy(env).predict(observation)


def test_a_scalar_context():
    """A Box without axes is as good as one of a single entry."""

    class Scalar(gym.ObservationWrapper):
        shape: tuple[int, ...] = ()

        def __init__(self, env):
            super().__init__(env)
            kept: Any = env.observation_space
            self.observation_space = spaces.Dict({**kept.spaces, "context": spaces.Box(0, 6, self.shape, np.float32)})

        def observation(self, observation):
            return {**observation, "context": np.full(self.shape, observation["context"], np.float32)}

    class Vector(Scalar):
        shape = (1,)

    values = []
    for wrapper in (Scalar, Vector):
        env = make_vec_env(lambda wrapper=wrapper: wrapper(PickEnv()), 2, seed=0)
        model = make_model("ppo", env).learn(64)
        values.append(model.policy.predict_values(tensors(env.reset())))
    assert values[0].shape == (2, 1) and th.equal(*values)


# ------------------------------------------------------------------------------------------------------- invariances


@pytest.mark.parametrize("normalization", ["instance", "batch", "layer", "none"])
@pytest.mark.parametrize("training", [False, True])
def test_padding_changes_no_logit_and_no_value(normalization, training):
    small, large = PickEnv(6, n_real=6, n_others=1), PickEnv(9, n_real=6, n_others=1)
    kwargs = dict(normalization=normalization, context_key="count")
    small.names = large.names = {"context": "count"}
    policies = []
    for env in (small, large):
        spaces_of: Any = env.observation_space
        found = dict(spaces_of.spaces)
        # The context's size must not depend on the padding.
        found["count"] = spaces.Box(0, 1, (1,), np.float32)
        found.pop("context", None)
        env.observation_space = spaces.Dict(found)
        policies.append(make_policy(env, **kwargs))
    policies[1].load_state_dict(policies[0].state_dict())
    for policy in policies:
        policy.set_training_mode(training)
    generator = np.random.default_rng(0)
    batch, nodes = 5, generator.random((5, 6, 2), dtype=np.float32)
    mask = generator.random((batch, 7)) < 0.6
    mask[:, -1] = True
    first = dict(nodes=nodes, count=generator.random((5, 1), dtype=np.float32), action_mask=mask, padding_mask=np.ones((5, 6)))
    garbage = np.full((batch, 3, 2), np.nan, np.float32)
    second = {
        **first,
        "nodes": np.concatenate([nodes, garbage], 1),
        "action_mask": np.concatenate([mask[:, :6], np.zeros((batch, 3), bool), mask[:, 6:]], 1),
        "padding_mask": np.concatenate([np.ones((5, 6)), np.zeros((5, 3))], 1),
    }
    (logits, values), (padded, padded_values) = (
        policy._decode_observation(tensors(observation)) for policy, observation in zip(policies, (first, second), strict=True)
    )
    th.testing.assert_close(padded[:, [*range(6), 9]], logits, atol=2e-5, rtol=0)
    th.testing.assert_close(padded_values, values, atol=2e-5, rtol=0)


@pytest.mark.parametrize("kind", ["nodes", "others", "changing", "padded"])
def test_permuted_nodes_permute_logits(kind):
    env = make_env(5, **KINDS[kind])
    observation, order = env.reset(), np.random.default_rng(0).permutation(6)
    policy = make_policy(env)
    permuted = {**observation, "nodes": observation["nodes"][:, order]}
    permuted["action_mask"] = np.concatenate([observation["action_mask"][:, order], observation["action_mask"][:, 6:]], 1)
    if kind == "padded":
        permuted["padding_mask"] = observation["padding_mask"][:, order]
    logits, values = policy._decode_observation(tensors(observation))
    found, found_values = policy._decode_observation(tensors(permuted))
    real = observation["padding_mask"].astype(bool) if kind == "padded" else np.ones((5, 6), bool)
    th.testing.assert_close(found[:, :6][real[:, order]], logits[:, :6][:, order][real[:, order]], atol=1e-5, rtol=0)
    th.testing.assert_close(found[:, 6:], logits[:, 6:], atol=1e-5, rtol=0)
    th.testing.assert_close(found_values, values, atol=1e-5, rtol=0)
    assert logits[:, :6].std(1).min() > 1e-3


# -------------------------------------------------------------------------------------------------------- encode once


def parameters_after_training(kind: str, use_cache: bool, share: bool = True) -> dict[str, th.Tensor]:
    model = make_model("ppo", make_env(1, **KINDS[kind]), n_steps=16)
    model.policy.features_extractor.use_cache = use_cache
    model.policy.features_extractor.share_encodings = share
    return model.learn(32).policy.state_dict()


@pytest.mark.parametrize("kind", KINDS)
def test_cached_and_uncached_training_are_bit_equal(kind):
    uncached = parameters_after_training(kind, False)
    for name, value in parameters_after_training(kind, True).items():
        assert th.equal(value, uncached[name]), name


@pytest.mark.parametrize("kind", ["padded", "changing"])
def test_shared_encodings_change_nothing(kind):
    apart = parameters_after_training(kind, True, share=False)
    for name, value in parameters_after_training(kind, True).items():
        th.testing.assert_close(value, apart[name], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("kind", "per_step"), [("nodes", False), ("changing", True)])
def test_nodes_are_encoded_again_only_when_they_change(kind, per_step):
    env = make_env(3, **KINDS[kind])
    policy, observation = make_policy(env), env.reset()
    fresh = make_policy(env)
    fresh.features_extractor.use_cache = False
    for _ in range(6 * 4):
        actions, _ = policy.predict(observation, deterministic=True)
        assert (fresh.predict(observation, deterministic=True)[0] == actions).all()
        observation, *_ = env.step(actions)
    assert policy.features_extractor.n_encoded_rows == (3 * 6 * 4 if per_step else 3 * 4)


@pytest.mark.parametrize("kind", KINDS)
def test_first_full_batch_epoch_of_ppo_has_ratio_one(kind):
    model = make_model("ppo", make_env(4, **KINDS[kind]), n_steps=16, batch_size=64, n_epochs=1).learn(64)
    assert abs(model.logger.name_to_value["train/approx_kl"]) < 1e-6
    assert model.logger.name_to_value["train/clip_fraction"] == 0


@pytest.mark.parametrize(("kind", "algo"), [*((kind, "ppo") for kind in KINDS), ("padded", "ppo_mask")])
def test_episode_buffer_encodes_once_and_changes_nothing(kind, algo):
    """One minibatch of everything: the same update as with SB3's buffer."""
    found = []
    for whole_episodes in (False, True):
        model = make_model(algo, make_env(4, **KINDS[kind]), n_steps=16, batch_size=64, n_epochs=1, learning_rate=1e-3)
        if whole_episodes:
            use_episode_buffer(model)
            assert isinstance(model.rollout_buffer, EpisodeRolloutBuffer)
            model.policy.features_extractor.share_encodings = False
        found.append(model.learn(64).policy.state_dict())
        if whole_episodes:
            starts = model.rollout_buffer.episode_starts.astype(bool)
            starts[0] = True
            n_static = sum(len(rows) for rows in model.rollout_buffer._static["nodes"])
            assert n_static == (64 if kind == "changing" else starts.sum())
    for name, value in found[0].items():
        th.testing.assert_close(found[1][name], value, atol=1e-4, rtol=0)


# ------------------------------------------------------------------------------------------------ wrong observations


def space(**changes: Any) -> spaces.Dict:
    found: dict[str, Any] = dict(nodes=spaces.Box(0, 1, (6, 2)), action_mask=spaces.MultiBinary(6))
    return spaces.Dict({key: value for key, value in {**found, **changes}.items() if value is not None})


@pytest.mark.parametrize(
    ("observation_space", "kwargs", "message"),
    [
        (spaces.Box(0, 1, (6,)), {}, r"is Box.*needs a Dict with a node set and an action mask"),
        (
            space(nodes=None, items=spaces.Box(0, 1, (6, 2))),
            {},
            r"no key 'nodes'; its keys are \['action_mask', 'items'\].*policy_kwargs=dict\(node_key=...\)",
        ),
        (space(action_mask=None), {}, r"no key 'action_mask'; its keys are \['nodes'\].*policy_kwargs=dict\(mask_key=...\)"),
        (space(), dict(context_key="room"), r"no key 'room'.*policy_kwargs=dict\(context_key=...\)"),
        (space(), dict(padding_key="pad"), r"no key 'pad'.*policy_kwargs=dict\(padding_key=...\)"),
        (space(nodes=spaces.Box(0, 1, (3, 6, 2))), {}, r"observation\['nodes'\] is Box.*expected a Box of shape"),
        (space(nodes=spaces.Box(0, 1, (13,))), {}, r"observation\['nodes'\] is Box.*or a flat one of 6 nodes"),
        (space(nodes=spaces.Discrete(3)), {}, r"observation\['nodes'\] is Discrete\(3\)"),
        (space(action_mask=spaces.MultiBinary([6, 2])), {}, r"observation\['action_mask'\] is MultiBinary.*expected a mask"),
        (space(action_mask=spaces.MultiDiscrete([2] * 6)), {}, r"observation\['action_mask'\] is MultiDiscrete"),
        (space(padding_mask=spaces.MultiBinary(5)), {}, r"observation\['padding_mask'\] has 5 entries, but .* 6 nodes"),
        (space(action_mask=spaces.MultiBinary(5)), {}, r"has 5 entries, so the action space must be Discrete\(5\)"),
        (space(action_mask=spaces.MultiBinary(5)), dict(node_actions=True), "has 5 entries for 6 nodes"),
    ],
)
def test_wrong_observations_are_refused_when_the_policy_is_made(observation_space, kwargs, message):
    with pytest.raises(ValueError, match=message):
        POLICY(observation_space, spaces.Discrete(6), lambda _: 1e-3, **SMALL, **kwargs)


def test_keys_that_nobody_reads_are_reported():
    with pytest.warns(UserWarning, match=r"does not look at \['wind'\] of the observation; put what it should see into"):
        POLICY(space(wind=spaces.Box(0, 1, (2,))), spaces.Discrete(6), lambda _: 1e-3, **SMALL)


def test_no_error_advises_the_other_level():
    with pytest.raises(ValueError, match=r"lack .*'position'.*for one of your own use MaskedAttentionPolicy") as raised:
        RouterPolicy(space(), spaces.Discrete(6), lambda _: 1e-3)
    assert "other level" not in str(raised.value)


@pytest.mark.parametrize("setting", ["relative", "sweep", "wings"])
def test_settings_of_our_environments_are_refused(setting):
    with pytest.raises(TypeError, match=rf"unexpected keyword arguments \['{setting}'\]"):
        make_policy(make_env(), **{setting: True})


def test_settings_come_from_the_preset():
    policies = {preset: make_policy(make_env(), preset=preset, embed_dim=None, ff_dim=None) for preset in ("default", "paper")}
    assert [policies[name].settings.embed_dim for name in policies] == [64, 128]
    assert [policies[name].settings.normalization for name in policies] == ["layer", "batch"]
    assert not policies["default"].settings.relative


# ---------------------------------------------------------------------------------------------------------- learning


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["ppo", "reinforce"])
def test_learns_to_pick_what_pays_and_to_stop(algo):
    """
    Nodes pay their first feature minus one half: 0.75 for all worthwhile ones, on average, 0 for stopping at once.

    Random play stays below 0.15. Without the entropy coefficient, both algorithms learn to stop at once.
    """
    env = make_env(16, n_others=1)
    kwargs: dict[str, Any] = dict(batch_size=128, n_epochs=4) if algo == "ppo" else dict(baseline="critic")
    model = make_model(algo, env, n_steps=16, learning_rate=3e-3, ent_coef=0.05, **kwargs).learn(10_000)

    def play(choose: Any) -> float:
        total, single = 0.0, PickEnv(n_others=1)
        for seed in range(100):
            observation, done = single.reset(seed=1_000 + seed)[0], False
            while not done:
                observation, reward, done, *_ = single.step(choose(observation))
                total += reward
        return total / 100

    rng = np.random.default_rng(0)
    assert play(lambda observation: rng.choice(np.flatnonzero(observation["action_mask"]))) < 0.15
    assert play(lambda observation: model.predict(observation, deterministic=True)[0]) > 0.55

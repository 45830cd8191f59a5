"""One network, three drivers: the Gymnasium environment, ``BatchedVecEnv`` and the fused decode agree step by step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, seeds
from driver_helpers import VARIANTS, make_env, make_policy, near_unit, play_vectorized, sample
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.utils import obs_as_tensor

from sb3_uav.envs import Instances

# What follows the end of an episode in the actions of the fused decode.
PADDING = {"allocator": -1, "router": 0}
# Logits that differ by less may be ranked differently by batches of different size.
NEAR_TIE = 1e-5
CPU = th.device("cpu")

levels = pytest.mark.parametrize("level", sorted(PADDING))
presets = pytest.mark.parametrize("preset", sorted(VARIANTS))


@levels
@presets
@settings(max_examples=50)
@given(instances=instance_batches(), n_samples=st.integers(1, 3), seed=seeds)
def test_decoded_episodes_can_be_replayed(level: str, preset: str, instances: Instances, n_samples: int, seed: int) -> None:
    """They are legal, end when the environments end, and are worth what the problem says, on instances of any magnitude."""
    actions = sample(make_policy(level, preset, instances.n_tasks, instances.n_uavs), instances, n_samples, seed)
    env = make_env(level, instances)
    expected = env.problem.returns(instances, actions)
    lengths = env.problem.lengths(instances, actions)
    step_rewards = env.problem.step_rewards(instances, actions, expected)
    assert lengths.max() <= actions.shape[-1]

    observed: list[tuple[dict[str, np.ndarray], np.ndarray]] = []
    found = play_vectorized(level, instances, actions, lambda step, seen, running: observed.append((seen, running)))
    assert found[0] == pytest.approx(expected.numpy(), rel=1e-12, abs=0)
    assert found[1] == pytest.approx(expected.numpy(), rel=1e-6, abs=0)
    assert (found[2] == lengths.numpy()).all()

    for i in range(len(instances)):
        for k in range(n_samples):
            episode, n_steps = actions[i, k].tolist(), int(lengths[i, k])
            observation, _ = env.reset(options={"instance": instances[i]})
            terminated, rewards = False, []
            for step, action in enumerate(episode[:n_steps]):
                assert not terminated and env.action_masks()[action]
                seen, running = observed[step]
                assert running[i * n_samples + k]
                for key, value in observation.items():
                    assert value.dtype == seen[key].dtype and (value == seen[key][i * n_samples + k]).all(), key
                observation, reward, terminated, truncated, info = env.step(action)
                assert not truncated and info["illegal_actions"] == 0
                rewards.append(reward)
            assert terminated
            assert rewards == pytest.approx(step_rewards[i, k, :n_steps].numpy(), rel=1e-12, abs=0)
            assert info["objective"] == pytest.approx(expected[i, k].item(), rel=1e-12, abs=0)
            assert set(episode[n_steps:]) <= {PADDING[level]}


@levels
@presets
@settings(max_examples=50)
@given(instances=instance_batches().map(near_unit), n_samples=st.integers(1, 3), seed=seeds, gradients=st.booleans())
def test_fused_evaluation_equals_the_step_loop(
    level: str, preset: str, instances: Instances, n_samples: int, seed: int, gradients: bool
) -> None:
    """Log-probabilities, values and entropies of every step, SB3's loop with and without kept encodings."""
    policy = make_policy(level, preset, instances.n_tasks, instances.n_uavs)
    actions = sample(policy, instances, n_samples, seed)
    evaluation = policy.evaluate_episodes(instances, actions)
    lengths = make_env(level, instances).problem.lengths(instances, actions)

    def compare(step: int, observation: dict[str, np.ndarray], running: np.ndarray) -> None:
        tensor: Any = obs_as_tensor(observation, CPU)
        # A row that is over has another episode by now; its log-probability of any action is ignored.
        chosen = actions[..., step].flatten().clamp(min=0)
        with th.set_grad_enabled(gradients):
            values, log_prob, entropy = policy.evaluate_actions(tensor, chosen)
        assert entropy is not None
        for name, looped in (("log_prob", log_prob), ("values", values[:, 0]), ("entropy", entropy)):
            fused = getattr(evaluation, name)[..., step].flatten()
            assert fused.shape == looped.shape and not fused.isnan().any(), name
            th.testing.assert_close(fused[running], looped[running], atol=1e-5, rtol=0)

    play_vectorized(level, instances, actions, compare)
    over = th.arange(actions.shape[-1]) >= lengths[..., None]
    assert (evaluation.log_prob[over] == 0).all() and (evaluation.entropy[over] == 0).all()


@levels
@presets
@settings(max_examples=50)
@given(instances=instance_batches().map(near_unit))
def test_greedy_decode_equals_predict(level: str, preset: str, instances: Instances) -> None:
    """Step by step in the Gymnasium environment, but where the two best actions are as good as equal."""
    policy = make_policy(level, preset, instances.n_tasks, instances.n_uavs)
    actions = policy.decode_episodes(instances)[:, 0]
    env = make_env(level, instances)
    for i in range(len(instances)):
        observation, _ = env.reset(options={"instance": instances[i]})
        terminated, step = False, 0
        while not terminated:
            decoded = int(actions[i, step])
            predicted, _ = policy.predict(observation, deterministic=True)
            with th.no_grad():
                logits = policy.get_distribution(policy.obs_to_tensor(observation)[0]).distribution.logits[0]  # type: ignore[union-attr]
            best = logits.topk(min(2, len(logits))).values
            if len(best) < 2 or best[0] - best[1] >= NEAR_TIE:
                assert int(predicted) == decoded
            # The fused decode may have broken the tie in another way, but it did break a tie.
            assert logits[decoded] >= best[0] - NEAR_TIE
            observation, _, terminated, _, _ = env.step(decoded)
            step += 1

"""Every way to use a network computes the same, and masked actions are never chosen."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from policy_helpers import LEVELS, draw, make_policy, make_vec, shake_statistics
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_uav.envs import Instances, RoutePlanningEnv
from sb3_uav.policies.masked_policy import sample_actions
from sb3_uav.policies.static_observation import StaticObservation


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_step_loop_and_fused_driver_agree(level, preset):
    """SB3's forward, evaluate_actions and the parallel pass give equal log-probabilities, values and entropies."""
    policy = make_policy(level, preset=preset)
    instances = draw(5, n_uavs=3 if level == "allocator" else 1)
    actions = policy.decode_episodes(instances, 1, False, th.Generator().manual_seed(0))
    evaluation = policy.evaluate_episodes(instances, actions)
    env = make_vec(level, 5)
    env.set_options([{"instance": instances[i]} for i in range(5)])
    observation = env.reset()
    finished = np.zeros(5, dtype=bool)
    for step in range(actions.shape[-1]):
        tensor = obs_as_tensor(observation, th.device("cpu"))
        chosen = actions[:, 0, step].clamp(min=0)
        values, log_prob, entropy = policy.evaluate_actions(tensor, chosen)
        for fused, looped in (
            (evaluation.log_prob, log_prob),
            (evaluation.values, values[:, 0]),
            (evaluation.entropy, entropy),
        ):
            th.testing.assert_close(fused[~finished, 0, step], looped[~finished], atol=1e-5, rtol=0)
        with th.no_grad():
            acted, acted_values, acted_log_prob = policy(tensor, deterministic=True)
            th.testing.assert_close(acted_values, policy.predict_values(tensor))
            th.testing.assert_close(acted_log_prob, policy.get_distribution(tensor).log_prob(acted))
        # Finished rows start another episode; their actions need only be legal.
        legal = env.action_masks().argmax(1)
        observation, _, dones, _ = env.step(np.where(finished, legal, chosen.numpy()))
        finished |= dones
    assert finished.all()


@pytest.mark.parametrize("level", LEVELS)
def test_greedy_fused_episodes_equal_predict(level):
    policy = make_policy(level)
    instances = draw(6, n_uavs=3 if level == "allocator" else 1)
    actions = policy.decode_episodes(instances)[:, 0]
    env = make_vec(level, 1)
    for row in range(6):
        env.set_options([{"instance": instances[row]}])
        observation, done, step = env.reset(), False, 0
        while not done:
            action, _ = policy.predict(observation, deterministic=True)
            assert action[0] == actions[row, step]
            observation, _, dones, _ = env.step(action)
            done, step = dones[0], step + 1


@pytest.mark.parametrize("level", LEVELS)
def test_parallel_pass_equals_single_samples(level):
    """K samples evaluated together equal K samples evaluated one by one."""
    policy = make_policy(level)
    instances = draw(4, n_uavs=3 if level == "allocator" else 1)
    actions = policy.decode_episodes(instances, 5, False, th.Generator().manual_seed(0))
    together = policy.evaluate_episodes(instances, actions)
    for k in range(5):
        alone = policy.evaluate_episodes(instances, actions[:, k : k + 1])
        th.testing.assert_close(together.log_prob[:, k : k + 1], alone.log_prob, atol=1e-5, rtol=0)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("normalization", ["instance", "batch", "layer", "none"])
@pytest.mark.parametrize("training", [False, True])
def test_padding_changes_no_logit(level, normalization, training):
    policy = make_policy(level, normalization=normalization)
    policy.set_training_mode(training)
    instances = draw(4, n_uavs=3 if level == "allocator" else 1)
    actions = policy.decode_episodes(instances, 2, False, th.Generator().manual_seed(0))
    padded = instances.pad(12)
    # Padding stands where the depot is, and must not matter wherever it is.
    padded.tasks[:, 7:] = 0.123
    longer = nn.functional.pad(actions, (0, 5), value=-1) if level == "allocator" else actions
    expected = policy.evaluate_episodes(instances, actions)
    found = policy.evaluate_episodes(padded, longer)
    for name in ("log_prob", "values", "entropy"):
        a, b = getattr(found, name)[..., : actions.shape[-1]], getattr(expected, name)
        th.testing.assert_close(a, b, atol=2e-5, rtol=0)
    th.testing.assert_close(found.log_prob.sum(), expected.log_prob.sum(), atol=1e-3, rtol=0)
    greedy = policy.decode_episodes(instances)
    assert th.equal(policy.decode_episodes(padded)[..., : greedy.shape[-1]], greedy)


@pytest.mark.parametrize("level", LEVELS)
def test_encoder_is_permutation_equivariant(level):
    policy = make_policy(level)
    instances = draw(3)
    order = th.randperm(7, generator=th.Generator().manual_seed(0))
    static = StaticObservation.from_instances(instances)
    shuffled = static._replace(tasks=static.tasks[:, order], values=static.values[:, order])
    nodes, permuted = (policy.features_extractor.encoder(s)[:, 1:] for s in (static, shuffled))
    th.testing.assert_close(nodes[:, order], permuted, atol=1e-5, rtol=0)


def test_router_tours_do_not_depend_on_task_order():
    policy = make_policy("router")
    instances = draw(20, n_uavs=1)
    order = th.randperm(7, generator=th.Generator().manual_seed(0))
    shuffled = Instances(
        instances.depot, instances.tasks[:, order], instances.values, instances.max_distance, 1, instances.task_mask
    )
    tours, other = policy.plan(instances), policy.plan(shuffled)
    renamed = th.where(other > 0, order[(other - 1).clamp(min=0)] + 1, 0)
    assert th.equal(tours, renamed)


def test_plan_gives_each_row_its_own_tour():
    """Sorting by size, trimming and chunks do not mix rows up."""
    policy = make_policy("router")
    parts = [draw(3, n_tasks=n, n_uavs=1, seed=n) for n in (7, 2, 5, 1)]
    together = Instances.concatenate(parts)
    tours = policy.plan(together, max_rows=2)
    for i, part in enumerate(parts):
        alone = policy.plan(part)
        assert th.equal(tours[3 * i : 3 * i + 3, : alone.shape[1]], alone)
        assert (tours[3 * i : 3 * i + 3, alone.shape[1] :] == 0).all()


def test_subset_context_is_the_running_maximum():
    """The incremental, the parallel and the observed context are bit-equal."""
    policy = make_policy("allocator")
    instances = draw(2)
    cache = policy.encode(instances)
    actions = policy.decode_episodes(instances, 1, False, th.Generator().manual_seed(0))
    state, _ = policy._episode_states(instances, cache, actions)
    env = make_vec("allocator", 2)
    env.set_options([{"instance": instances[i]} for i in range(2)])
    observation = env.reset()
    for step in range(7):
        observed = policy.features_extractor.observed_state(
            cache, {key: th.as_tensor(value)[:, None] for key, value in observation.items()}
        )
        assert th.equal(observed.context[:, 0], state.context[:, step])
        observation, *_ = env.step(actions[:, 0, step].numpy())


# ------------------------------------------------------------------------------------------ masks


def test_a_masked_action_is_never_drawn():
    """10^5 draws, with logits that favor the illegal actions by far."""
    logits = th.tensor([5.0, 60.0, -3.0, 80.0, 0.0]).expand(100_000, 5)
    mask = th.tensor([True, False, True, False, True])
    drawn = sample_actions(logits.masked_fill(~mask, -th.inf), False, th.Generator().manual_seed(0))
    assert mask[drawn].all() and set(drawn.tolist()) >= {0, 4}
    frequency = (drawn == 4).double().mean().item()
    assert frequency == pytest.approx(math.exp(0) / (math.exp(5) + math.exp(-3) + 1), abs=1e-3)


def test_step_loop_draws_no_masked_action_from_a_thousand():
    """1,000 actions through SB3's distribution; see sb3-contrib issue 81 for how that used to fail."""
    policy = make_policy("router", n_tasks=1000)
    env = RoutePlanningEnv(1000, max_distance=1.0)
    observation, _ = env.reset(seed=0)
    mask = env.action_masks()
    assert 10 < mask.sum() < 990
    tensor, _ = policy.obs_to_tensor(observation)
    with th.no_grad():
        actions, _, log_prob = policy(tensor)
        assert mask[actions.item()] and th.isfinite(log_prob).all()
        drawn = policy.get_distribution(tensor).distribution.sample((100_000,))
    assert mask[drawn.numpy()].all() and len(drawn.unique()) > 1


@pytest.mark.parametrize("level", LEVELS)
def test_action_masks_argument_overrides_the_observation(level):
    policy = make_policy(level)
    env = make_vec(level, 2)
    tensor = obs_as_tensor(env.reset(), th.device("cpu"))
    mask = np.zeros_like(env.action_masks())
    mask[:, 1] = True
    for actions in (policy(tensor, action_masks=mask)[0], policy._predict(tensor, action_masks=mask)):
        assert (actions == 1).all()


@pytest.mark.parametrize("level", LEVELS)
def test_without_action_masks_the_mask_of_the_observation_counts(level):
    """With action_masks=None, as EvalCallback, evaluate_policy and enjoy call a MaskablePPO's policy."""
    policy, env = make_policy(level), make_vec(level, 2)
    observation = env.reset()
    observation["action_mask"][:] = 0
    observation["action_mask"][:, 2] = 1
    tensor = obs_as_tensor(observation, th.device("cpu"))
    assert (policy.predict(observation, action_masks=None)[0] == 2).all()
    assert (policy(tensor, action_masks=None)[0] == 2).all()
    assert (policy.get_distribution(tensor, None).distribution.probs[:, 2] == 1).all()
    _, log_prob, entropy = policy.evaluate_actions(tensor, th.tensor([2, 2]), None)
    assert log_prob.tolist() == [0.0, 0.0] and entropy.tolist() == pytest.approx([0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("argument", [False, True])
def test_a_row_without_legal_actions_is_an_error(level, argument):
    """Not an arbitrary action: through every entry point, from the observation or from action_masks."""
    policy, env = make_policy(level), make_vec(level, 4)
    observation, masks = env.reset(), env.action_masks()
    (masks if argument else observation["action_mask"])[2:] = 0
    kwargs: dict[str, Any] = dict(action_masks=masks) if argument else {}
    tensor = obs_as_tensor(observation, th.device("cpu"))
    source = "^action_masks" if argument else r'^observation\["action_mask"\]'
    message = rf"{source} allows no action in row 2 \(2 of 4 rows\); set at least one entry of each row to 1"
    calls: list[Callable[[], Any]] = [
        lambda: policy.predict(observation, deterministic=True, **kwargs),
        lambda: policy(tensor, **kwargs),
        lambda: policy.get_distribution(tensor, **kwargs),
        lambda: policy.evaluate_actions(tensor, th.zeros(4), **kwargs),
    ]
    for call in calls:
        for gradients in (False, True):
            with th.set_grad_enabled(gradients), pytest.raises(ValueError, match=message):
                call()
    # The value of an observation needs no action.
    assert policy.predict_values(tensor).isfinite().all()


@pytest.mark.parametrize("level", LEVELS)
def test_decoding_in_training_mode_is_decoding_in_evaluation_mode(level):
    """No batch statistics are learned or used, so what else is in the batch does not matter."""
    policy = make_policy(level, preset="paper")
    shake_statistics(policy)
    n_uavs = 3 if level == "allocator" else 1
    instances, others = draw(6, n_uavs=n_uavs), draw(10, n_uavs=n_uavs, seed=1)
    others.tasks.mul_(5.0).add_(3.0)
    expected = policy.decode_episodes(instances)
    buffers = {name: value.clone() for name, value in policy.named_buffers()}
    assert len(buffers) > 0
    batches = (
        instances,
        Instances.concatenate([instances, others]),
        Instances.concatenate([instances[0], others]),
        instances[0],
    )
    for batch in batches:
        policy.set_training_mode(True)
        found = policy.decode_episodes(batch)
        for name, value in policy.named_buffers():
            assert th.equal(value, buffers[name]), name
        n_rows = 1 if len(batch) in (1, 11) else 6
        n_steps = min(expected.shape[-1], found.shape[-1])
        assert th.equal(found[:n_rows, :, :n_steps], expected[:n_rows, :, :n_steps])
        # Tours are padded to the longest of the batch.
        assert (found[:n_rows, :, n_steps:] == 0).all() and (expected[:n_rows, :, n_steps:] == 0).all()

"""The networks: what the paper prescribes, and that every way to use them computes the same."""

import inspect
import math
import warnings
from functools import partial
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.policies import AllocatorExtractor, AllocatorPolicy, EpisodicPolicy, RouterExtractor, RouterPolicy
from sb3_uav.policies.base import sample_actions
from sb3_uav.policies.encoder import AttentionEncoder, NodeNorm, SelfAttention, StaticObservation

SMALL: dict[str, Any] = dict(embed_dim=16, n_layers=2, n_heads=4, ff_dim=32)
# Leaves the sizes to the preset.
UNSET: dict[str, Any] = dict.fromkeys(SMALL)
LEVELS = ("allocator", "router")


def make_policy(level: str, n_uavs: int = 3, n_tasks: int = 7, seed: int = 0, **kwargs) -> Any:
    th.manual_seed(seed)
    env = TaskAllocationEnv(n_tasks, n_uavs) if level == "allocator" else RoutePlanningEnv(n_tasks)
    cls = AllocatorPolicy if level == "allocator" else RouterPolicy
    policy = cls(env.observation_space, env.action_space, lambda _: 1e-3, **{**SMALL, **kwargs})
    policy.set_training_mode(False)
    return policy


def make_vec(level: str, n_envs: int = 4, n_tasks: int = 7, n_uavs: int = 3) -> Any:
    if level == "allocator":
        return BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks, n_uavs)] * n_envs)
    return BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks)] * n_envs)


def draw(n: int, n_tasks: int = 7, n_uavs: int = 3, seed: int = 0) -> Instances:
    return UniformGenerator(n_tasks, n_uavs)(n, np.random.default_rng(seed))


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


# ------------------------------------------------------------------------------------------ the paper's network


def test_paper_preset_parameter_counts():
    """Counts worked out by hand from the sizes in section IV-A2 of the paper."""
    d, ff = 128, 512
    layer = 4 * d * d + (d * ff + ff) + (ff * d + d) + 2 * 2 * d
    encoder = 2 * (2 * d + d) + 3 * layer
    assert layer == 197_760 and encoder == 594_048
    allocator = make_policy("allocator", n_uavs=4, n_tasks=80, preset="paper", **UNSET)
    assert count(allocator.features_extractor.encoder) == encoder
    decoder = (4 * d * d + d) + (d * ff + ff) + (ff * d + d)
    assert count(allocator.features_extractor) == encoder + decoder
    assert count(allocator.action_net) == 2 * d * 4 + 4
    assert count(allocator) == encoder + decoder + (2 * d * 4 + 4) + (2 * d + 1)

    router = make_policy("router", n_tasks=80, preset="paper", **UNSET)
    pointer = d * d + (d + 1) * d + 3 * d * d + d * d
    assert count(router.features_extractor) == encoder + pointer
    assert count(router.action_net) == 0
    assert count(router) == encoder + pointer + (d + 1)


def test_paper_preset_layers():
    encoder = make_policy("router", preset="paper", **UNSET).features_extractor.encoder
    assert len(encoder.layers) == 3
    assert encoder.embed_depot.weight.shape == encoder.embed_task.weight.shape == (128, 2)
    assert encoder.embed_depot.weight is not encoder.embed_task.weight
    for layer in encoder.layers:
        assert layer.attention.n_heads == 8
        assert isinstance(layer.attention_norm.norm, nn.BatchNorm1d) and isinstance(
            layer.feed_forward_norm.norm, nn.BatchNorm1d
        )
        assert layer.attention.project_in.bias is None and layer.attention.project_out.bias is None
        assert layer.feed_forward[0].out_features == 512 and isinstance(layer.feed_forward[1], nn.ReLU)


def reference_batch_norm(p: dict[str, np.ndarray], layer: int, name: str, x: np.ndarray) -> np.ndarray:
    prefix = f"layers.{layer}.{name}.norm."
    scaled = (x - p[prefix + "running_mean"]) / np.sqrt(p[prefix + "running_var"] + 1e-5)
    return scaled * p[prefix + "weight"] + p[prefix + "bias"]


def reference_encoder(encoder: AttentionEncoder, depot: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """One instance through the encoder in plain numpy: paper, equations (11) to (15), batch norm in evaluation mode."""
    p = {name: value.double().numpy() for name, value in encoder.state_dict().items()}
    nodes = np.vstack(
        [depot @ p["embed_depot.weight"].T + p["embed_depot.bias"], tasks @ p["embed_task.weight"].T + p["embed_task.bias"]]
    )
    d = nodes.shape[1]
    layer: Any
    for i, layer in enumerate(encoder.layers):
        norm = partial(reference_batch_norm, p, i)
        query, key, value = np.split(nodes @ p[f"layers.{i}.attention.project_in.weight"].T, 3, axis=1)
        heads = []
        size = d // layer.attention.n_heads
        for head in range(layer.attention.n_heads):
            part = slice(head * size, (head + 1) * size)
            score = query[:, part] @ key[:, part].T / math.sqrt(size)
            weight = np.exp(score - score.max(1, keepdims=True))
            heads.append(weight / weight.sum(1, keepdims=True) @ value[:, part])
        attended = np.hstack(heads) @ p[f"layers.{i}.attention.project_out.weight"].T
        nodes = norm("attention_norm", nodes + attended)
        hidden = np.maximum(nodes @ p[f"layers.{i}.feed_forward.0.weight"].T + p[f"layers.{i}.feed_forward.0.bias"], 0)
        hidden = hidden @ p[f"layers.{i}.feed_forward.2.weight"].T + p[f"layers.{i}.feed_forward.2.bias"]
        nodes = norm("feed_forward_norm", nodes + hidden)
    return nodes


def shake_statistics(policy: EpisodicPolicy) -> None:
    """Give batch norms statistics and weights that a test can tell from no normalization."""
    generator = th.Generator().manual_seed(1)
    for module in policy.modules():
        if isinstance(module, nn.BatchNorm1d):
            assert module.running_mean is not None and module.running_var is not None
            module.running_mean.copy_(th.randn(module.num_features, generator=generator) * 0.1)
            module.running_var.copy_(th.rand(module.num_features, generator=generator) + 0.5)
            module.weight.data.copy_(th.rand(module.num_features, generator=generator) + 0.5)
            module.bias.data.copy_(th.randn(module.num_features, generator=generator) * 0.1)


def test_paper_allocator_forward_pass_by_hand():
    """Equations (11) to (19) in numpy, in the middle of an episode, agree with the policy's logits."""
    policy = make_policy("allocator", preset="paper", n_uavs=2, n_tasks=4)
    shake_statistics(policy)
    instance = draw(1, 4, 2)
    nodes = reference_encoder(policy.features_extractor.encoder, instance.depot[0].numpy(), instance.tasks[0].numpy())
    p = {name: value.double().numpy() for name, value in policy.state_dict().items()}
    # Tasks 0 and 2 went to UAV 1, task 1 to UAV 0; task 3 is next.
    subset = [np.max(nodes[[0, 2]], axis=0), np.max(nodes[[0, 1, 3]], axis=0)]
    prefix = "features_extractor."
    hidden = np.concatenate(subset) @ p[prefix + "project_context.weight"].T + p[prefix + "project_context.bias"]
    hidden = np.maximum(hidden @ p[prefix + "feed_forward.0.weight"].T + p[prefix + "feed_forward.0.bias"], 0)
    hidden = hidden @ p[prefix + "feed_forward.2.weight"].T + p[prefix + "feed_forward.2.bias"]
    logits = np.concatenate([hidden, nodes[4]]) @ p["action_net.weight"].T + p["action_net.bias"]
    expected = logits - np.log(np.exp(logits).sum())

    env = TaskAllocationEnv(4, 2)
    env.reset(options={"instance": instance})
    for action in (1, 0, 1):
        observation, *_ = env.step(action)
    tensor, _ = policy.obs_to_tensor(observation)
    found = policy.get_distribution(tensor).distribution.logits[0].detach().numpy()
    assert found == pytest.approx(expected, abs=1e-5)


def test_paper_router_forward_pass_by_hand():
    """The attention model's decoder (Kool et al.) in numpy, in the middle of a tour, agrees with the policy's logits."""
    policy = make_policy("router", preset="paper", n_tasks=5)
    shake_statistics(policy)
    instance = draw(1, 5, 1, seed=3)
    nodes = reference_encoder(policy.features_extractor.encoder, instance.depot[0].numpy(), instance.tasks[0].numpy())
    p = {name.removeprefix("features_extractor."): value.double().numpy() for name, value in policy.state_dict().items()}
    env = RoutePlanningEnv(5)
    observation, _ = env.reset(options={"instance": instance})
    first = int(np.flatnonzero(observation["action_mask"])[0])
    observation, *_ = env.step(first)
    mask = observation["action_mask"].astype(bool)

    points = np.vstack([instance.depot[0].numpy(), instance.tasks[0].numpy()])
    remaining = 2.0 - np.linalg.norm(points[first] - points[0])
    step = np.append(nodes[first], remaining)
    query = nodes.mean(0) @ p["project_graph.weight"].T + step @ p["project_step.weight"].T
    glimpse_key, glimpse_value, logit_key = np.split(nodes @ p["project_nodes.weight"].T, 3, axis=1)
    heads = []
    for head in range(4):
        part = slice(head * 4, (head + 1) * 4)
        score = np.where(mask, glimpse_key[:, part] @ query[part] / math.sqrt(4), -np.inf)
        weight = np.exp(score - score.max())
        heads.append(weight / weight.sum() @ glimpse_value[:, part])
    glimpse = np.concatenate(heads) @ p["project_glimpse.weight"].T
    logits = np.where(mask, 10 * np.tanh(logit_key @ glimpse / math.sqrt(16)), -np.inf)
    expected = logits - np.log(np.exp(logits).sum())

    tensor, _ = policy.obs_to_tensor(observation)
    found = policy.get_distribution(tensor).distribution.logits[0].detach().numpy()
    assert found[mask] == pytest.approx(expected[mask], abs=1e-5)
    assert policy.get_distribution(tensor).distribution.probs[0].detach().numpy()[~mask] == pytest.approx(0, abs=0)


# ------------------------------------------------------------------------------------------ two drivers, one network


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
    """10^5 draws, with logits that favour the illegal actions by far."""
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


# ------------------------------------------------------------------------------------------ encode once


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


# ------------------------------------------------------------------------------------------ SB3's contracts


@pytest.mark.parametrize("level", LEVELS)
def test_policy_save_and_load_keep_every_argument(level, tmp_path):
    """None of them at its default, and none forgotten here: the keys are those of the constructor."""
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
        shared_scorer=False,
        sweep=True,
        mixed_precision=True,
        net_arch=dict(pi=[], vf=[8]),
        activation_fn=nn.ReLU,
        ortho_init=True,
        optimizer_class=th.optim.AdamW,
        optimizer_kwargs=dict(eps=1e-6, weight_decay=0.1),
    )
    policy = make_policy(level, **given)
    signature = inspect.signature(type(policy)).parameters
    assert all(given[key] != signature[key].default for key in given)
    policy.save(tmp_path / "policy.pth")
    loaded = type(policy).load(tmp_path / "policy.pth", device="cpu")
    not_compared = {"observation_space", "action_space", "lr_schedule"}
    for each in (policy, loaded):
        parameters = each._get_constructor_parameters()
        # use_sde is refused unless False.
        assert set(parameters) == not_compared | set(given) == set(signature) - {"use_sde"}
        for key, value in given.items():
            assert parameters[key] == value, key
        assert type(each.optimizer) is th.optim.AdamW
        assert each.optimizer.defaults["eps"] == 1e-6 and each.optimizer.defaults["weight_decay"] == 0.1
        encoder = each.features_extractor.encoder
        assert (len(encoder.layers), encoder.layers[0].attention.n_heads, encoder.use_values) == (1, 3, True)
    for name, value in policy.state_dict().items():
        assert th.equal(value, loaded.state_dict()[name])


def test_relative_attention_knows_exact_positions_in_mixed_precision():
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
    # Every node looks at itself alone, so that the five results differ as much as the nodes do.
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
def test_tasks_in_an_unwanted_order_are_pointed_out_once(task_order, sweep, warned):
    policy: Any = AllocatorPolicy
    env: Any = BatchedVecEnv([lambda: TaskAllocationEnv(12, 3, task_order=task_order)] * 4)
    model = PPO(policy, env, n_steps=4, batch_size=8, n_epochs=1, policy_kwargs={**SMALL, "sweep": sweep}, device="cpu")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(32)
        model.predict(env.reset())
    assert sum("wants the tasks in the order of a sweep" in str(warning.message) for warning in caught) == warned


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
        (dict(use_sde=True), "use_sde must be False"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_policy("allocator", **kwargs)


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


def test_batch_norm_learns_from_real_nodes_only():
    norm: Any = NodeNorm("batch", 4)
    nodes = th.randn(3, 5, 4)
    mask = th.tensor([[1, 1, 1, 1, 1], [1, 1, 0, 0, 0], [1, 0, 0, 0, 0]], dtype=th.bool)
    reference = nn.BatchNorm1d(4)
    expected = reference(nodes[mask])
    assert th.equal(norm(nodes, mask)[mask], expected)
    assert reference.running_mean is not None
    assert th.equal(norm.norm.running_mean, reference.running_mean)

"""The networks that the paper prescribes, against hand-counted sizes and plain numpy."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from policy_helpers import UNSET, count, draw, make_policy, shake_statistics
from torch import nn

from sb3_uav.envs import RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies.encoder import AttentionEncoder, _NodeNorm


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
    """One instance through the encoder in plain numpy: paper, equations (10) to (14), batch norm in evaluation mode."""
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


def test_paper_allocator_forward_pass_by_hand():
    """Equations (10) to (18) in numpy, in the middle of an episode, agree with the policy's logits."""
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


def test_batch_norm_learns_from_real_nodes_only():
    norm: Any = _NodeNorm("batch", 4)
    nodes = th.randn(3, 5, 4)
    mask = th.tensor([[1, 1, 1, 1, 1], [1, 1, 0, 0, 0], [1, 0, 0, 0, 0]], dtype=th.bool)
    reference = nn.BatchNorm1d(4)
    expected = reference(nodes[mask])
    assert th.equal(norm(nodes, mask)[mask], expected)
    assert reference.running_mean is not None
    assert th.equal(norm.norm.running_mean, reference.running_mean)

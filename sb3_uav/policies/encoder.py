"""The attention encoder of both levels (paper, section IV-A2), aware of padding."""

from __future__ import annotations

import math

import torch as th
from torch import nn
from torch.nn import functional

from sb3_uav.common import distributed
from sb3_uav.policies.geometry import (
    NodeFeature,
    WholeDepotFeature,
    WholeNodeFeature,
    node_features,
    scaled_coordinates,
    whole_depot_features,
    whole_node_features,
)
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.torch_state import is_recorded
from sb3_uav.policies.world import World

# The strongest preference for near nodes that a head starts with: e^-1 at 1/16 of the maximum flight distance.
_LOCALITY = 256.0
# Keeps the division by the standard deviation finite; the value of torch's own normalizations.
_NORM_EPSILON = 1e-5
# Logarithm of about 55: the number of tasks whose feature is 0, in the middle of the sizes in use.
_TYPICAL_LOG_TASKS = 4.0


class _InstanceNorm(nn.Module):
    """
    Normalization of every feature over the real nodes of an instance, with learned scale and shift.

    No running statistics: acting and training agree, as PPO's ratios need.

    :param embed_dim: Size of the embeddings
    """

    def __init__(self, embed_dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(th.ones(embed_dim))
        self.bias = nn.Parameter(th.zeros(embed_dim))

    def forward(self, nodes: th.Tensor, node_mask: th.Tensor | None) -> th.Tensor:
        """
        :param nodes: ``(batch, n_nodes, embed_dim)``
        :param node_mask: ``(batch, n_nodes)`` bool, or None when all are real
        :return: ``(batch, n_nodes, embed_dim)``
        """
        if node_mask is None:
            # th.var_mean is four times as slow on CPUs.
            centered = nodes - nodes.mean(1, keepdim=True)
            variance = (centered**2).mean(1, keepdim=True)
        else:
            real = node_mask[..., None]
            count = real.sum(1, keepdim=True)
            centered = nodes - nodes.masked_fill(~real, 0.0).sum(1, keepdim=True) / count
            variance = (centered**2).masked_fill(~real, 0.0).sum(1, keepdim=True) / count
        return centered * ((variance + _NORM_EPSILON).rsqrt() * self.weight) + self.bias


class _NodeNorm(nn.Module):
    """
    Normalization of node embeddings that leaves padded nodes out.

    Batch normalization is the paper's. Its statistics differ between acting and training, which breaks PPO's ratios, so it is
    the default of the ``paper`` preset only. Normalization per instance learned somewhat faster than per node (``"layer"``)
    at a learning rate of 1e-3, and still learned at 3e-3, where per node stalled.

    :param kind: ``"instance"``, ``"batch"``, ``"layer"`` or ``"none"``
    :param embed_dim: Size of the embeddings
    """

    def __init__(self, kind: str, embed_dim: int) -> None:
        super().__init__()
        self.norm: nn.Module = nn.Identity()
        if kind == "instance":
            self.norm = _InstanceNorm(embed_dim)
        elif kind == "batch":
            self.norm = nn.BatchNorm1d(embed_dim)
        elif kind == "layer":
            self.norm = nn.LayerNorm(embed_dim)

    def forward(self, nodes: th.Tensor, node_mask: th.Tensor | None) -> th.Tensor:
        """Parameters and result as of :meth:`_InstanceNorm.forward`."""
        if isinstance(self.norm, _InstanceNorm):
            return self.norm(nodes, node_mask)
        if not isinstance(self.norm, nn.BatchNorm1d):
            return self.norm(nodes)
        if self.norm.training and distributed.world_size() > 1:
            rows = nodes.flatten(0, 1) if node_mask is None else nodes[node_mask]
            normalized = _normalized_over_ranks(self.norm, rows.float()).to(nodes.dtype)
            return normalized.view_as(nodes) if node_mask is None else nodes.masked_scatter(node_mask[..., None], normalized)
        if node_mask is None or not self.norm.training:
            # In evaluation mode no node has an influence on another.
            return self.norm(nodes.flatten(0, 1)).view_as(nodes)
        return nodes.masked_scatter(node_mask[..., None], self.norm(nodes[node_mask]))


def _normalized_over_ranks(norm: nn.BatchNorm1d, rows: th.Tensor) -> th.Tensor:
    """
    Batch normalization in training mode with the statistics of all processes.

    Torch's ``SyncBatchNorm`` is for GPUs only.

    :param norm: The module, whose running statistics are updated
    :param rows: ``(n_rows, embed_dim)``, those of this process
    :return: ``(n_rows, embed_dim)``
    """
    count = distributed.total(len(rows))
    mean = distributed.sum_with_gradient(rows.sum(0)) / count
    centered = rows - mean
    variance = distributed.sum_with_gradient((centered**2).sum(0)) / count
    assert norm.running_mean is not None and norm.running_var is not None and norm.num_batches_tracked is not None
    assert norm.momentum is not None
    with th.no_grad():
        norm.num_batches_tracked += 1
        norm.running_mean.lerp_(mean, norm.momentum)
        norm.running_var.lerp_(variance * (count / (count - 1)), norm.momentum)
    return centered * ((variance + norm.eps).rsqrt() * norm.weight) + norm.bias


class SelfAttention(nn.Module):
    """
    Multi-head self-attention without biases (paper, equations (10) to (12)).

    :param embed_dim: Size of the embeddings
    :param n_heads: Number of heads
    :param relative: Whether every head subtracts a learned multiple of the squared distance from its scores
    """

    def __init__(self, embed_dim: int, n_heads: int, relative: bool = False) -> None:
        super().__init__()
        self.n_heads = n_heads
        # From heads that attend to all nodes alike to heads that attend to near ones.
        slopes = _LOCALITY ** th.linspace(0.0, 1.0, n_heads)
        self.log_locality = nn.Parameter(slopes.log()) if relative else None
        self.project_in = nn.Linear(embed_dim, 3 * embed_dim, bias=False)
        self.project_out = nn.Linear(embed_dim, embed_dim, bias=False)

    def forward(self, nodes: th.Tensor, attention_bias: th.Tensor | None, coordinates: th.Tensor | None = None) -> th.Tensor:
        """
        :param nodes: ``(batch, n_nodes, embed_dim)``
        :param attention_bias: ``(batch, 1, 1, n_nodes)``, 0 for real and -inf for padded nodes, or None
        :param coordinates: ``(batch, n_nodes, 2)``, for ``relative`` attention
        :return: ``(batch, n_nodes, embed_dim)``
        """
        query, key, value = self.project_in(nodes).chunk(3, dim=-1)
        if self.log_locality is None or coordinates is None:
            return self.project_out(attend(query, key, value, self.n_heads, attention_bias))
        # -slope * |a - b|^2 is, but for a term in a alone that softmax ignores, the product of (2 a, -1) and (b, |b|^2): four
        # more columns of queries and keys, so that the fused kernel needs no matrix of scores.
        query, key, value = (part.unflatten(-1, (self.n_heads, -1)).transpose(1, 2).float() for part in (query, key, value))
        head_dim = query.shape[-1]
        slope = self.log_locality.exp()[:, None, None]
        places = coordinates[:, None]
        shape = (*query.shape[:3], -1)
        minus_one, zero = -th.ones_like(places[..., :1]), th.zeros_like(places[..., :1])
        query = th.cat([query / math.sqrt(head_dim), slope * th.cat([2 * places, minus_one, zero], dim=-1)], dim=-1)
        squares = (places**2).sum(-1, keepdim=True)
        key = th.cat([key, th.cat([places, squares, zero], dim=-1).expand(shape)], dim=-1)
        value = functional.pad(value, (0, 4))
        mixed = _fused_attention(query, key, value, attention_bias, 1.0)
        return self.project_out(mixed[..., :head_dim].transpose(1, 2).flatten(2))


def _fused_attention(
    query: th.Tensor, key: th.Tensor, value: th.Tensor, attention_bias: th.Tensor | None, scale: float | None = None
) -> th.Tensor:
    """
    Torch's fused kernel, always in float32, autocast or not.

    With such small heads bfloat16 saves nothing on a CPU, its backward pass takes two to eight times as long
    (``benchmarks/attention.py``), and it would round the positions that relative attention compares.

    :param query: ``(batch, n_heads, n_queries, head_dim)``
    :param key: ``(batch, n_heads, n_nodes, head_dim)``
    :param value: ``(batch, n_heads, n_nodes, head_dim)``
    :param attention_bias: Added to the scores, or None
    :param scale: Factor of the scores; one over the root of ``head_dim`` when None
    :return: ``(batch, n_heads, n_queries, head_dim)``
    """
    with th.autocast(query.device.type, enabled=False):
        query, key, value = query.float(), key.float(), value.float()
        return functional.scaled_dot_product_attention(query, key, value, attn_mask=attention_bias, scale=scale)


def attend(query: th.Tensor, key: th.Tensor, value: th.Tensor, n_heads: int, attention_bias: th.Tensor | None) -> th.Tensor:
    """
    Scaled dot-product attention of several heads.

    Torch's fused kernel was 1.6 to 3.7 times as fast as the products written out, forward and backward on a CPU
    (``benchmarks/attention.py``).

    :param query: ``(batch, n_queries, embed_dim)``
    :param key: ``(batch, n_nodes, embed_dim)``
    :param value: ``(batch, n_nodes, embed_dim)``
    :param n_heads: Number of heads
    :param attention_bias: Added to the scores, broadcast against ``(batch, n_heads, n_queries, n_nodes)``, or None
    :return: ``(batch, n_queries, embed_dim)``
    """
    query, key, value = (part.unflatten(-1, (n_heads, -1)).transpose(1, 2) for part in (query, key, value))
    return _fused_attention(query, key, value, attention_bias).transpose(1, 2).flatten(2)


def feed_forward(embed_dim: int, ff_dim: int) -> nn.Sequential:
    """
    :param embed_dim: Size of input and output
    :param ff_dim: Hidden size
    :return: A linear layer, ReLU and a second linear layer (the paper's FF)
    """
    return nn.Sequential(nn.Linear(embed_dim, ff_dim), nn.ReLU(), nn.Linear(ff_dim, embed_dim))


class _AttentionLayer(nn.Module):
    """
    Self-attention and feed-forward sublayers, each with skip connection and normalization (paper, equations (13) and (14)).

    :param settings: Shape of the network
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.attention = SelfAttention(settings.embed_dim, settings.n_heads, settings.relative)
        self.attention_norm = _NodeNorm(settings.normalization, settings.embed_dim)
        self.feed_forward = feed_forward(settings.embed_dim, settings.ff_dim)
        self.feed_forward_norm = _NodeNorm(settings.normalization, settings.embed_dim)

    def forward(
        self,
        nodes: th.Tensor,
        node_mask: th.Tensor | None,
        attention_bias: th.Tensor | None,
        coordinates: th.Tensor | None = None,
    ) -> th.Tensor:
        """
        :param nodes: ``(batch, n_nodes, embed_dim)``
        :param node_mask: ``(batch, n_nodes)`` bool, or None when all are real
        :param attention_bias: The same as 0 and -inf, ``(batch, 1, 1, n_nodes)``, or None
        :param coordinates: ``(batch, n_nodes, 2)``, for ``relative`` attention
        :return: ``(batch, n_nodes, embed_dim)``
        """
        nodes = self.attention_norm(nodes + self.attention(nodes, attention_bias, coordinates), node_mask)
        return self.feed_forward_norm(nodes + self.feed_forward(nodes), node_mask)


class AttentionLayers(nn.ModuleList):
    """
    The attention layers of an encoder, one after the other.

    :param settings: Shape of the network
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__(_AttentionLayer(settings) for _ in range(settings.n_layers))
        self.mixed_precision = settings.mixed_precision

    def forward(self, nodes: th.Tensor, node_mask: th.Tensor | None, coordinates: th.Tensor | None = None) -> th.Tensor:
        """
        :param nodes: ``(batch, n_nodes, embed_dim)``
        :param node_mask: ``(batch, n_nodes)`` bool, at least one in each row; None when all nodes are real
        :param coordinates: ``(batch, n_nodes, 2)``, for ``relative`` attention
        :return: ``(batch, n_nodes, embed_dim)``; those of padded nodes are arbitrary
        """
        attention_bias = None
        if node_mask is not None:
            attention_bias = th.zeros_like(node_mask, dtype=th.float32).masked_fill(~node_mask, -th.inf)[:, None, None]
        # Sums and norms stay in float32.
        with th.autocast(nodes.device.type, th.bfloat16, enabled=self.mixed_precision):
            for layer in self:
                nodes = layer(nodes, node_mask, attention_bias, coordinates)
        return nodes


class AttentionEncoder(nn.Module):
    """
    Embeds depot and tasks.

    :param settings: Shape of the network
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.use_values = settings.use_values
        self.relative = settings.relative
        # Relative to itself the depot has no position; what matters is how many tasks there are.
        self.whole = settings.whole
        n_depot, n_task = (1, len(NodeFeature)) if self.relative else (2, 2)
        if self.whole:
            n_depot, n_task = n_depot + len(WholeDepotFeature), n_task + len(WholeNodeFeature)
        self.embed_depot = nn.Linear(n_depot, settings.embed_dim)
        self.embed_task = nn.Linear(n_task + self.use_values, settings.embed_dim)
        self.layers = AttentionLayers(settings)

    def forward(self, static: StaticObservation) -> th.Tensor:
        """
        :param static: The unchanging part of a batch of observations
        :return: Node embeddings ``(batch, n_tasks + 1, embed_dim)``, the depot first; those of padded tasks are arbitrary
        """
        depot, features, coordinates = static.depot, static.tasks, None
        if self.relative:
            coordinates = scaled_coordinates(static, self.whole)
            depot = static.task_mask.sum(1, keepdim=True).clamp(min=1).to(features.dtype).log() - _TYPICAL_LOG_TASKS
            features = node_features(coordinates, static.task_mask)
            if self.whole:
                world = World.of(static)
                depot = th.cat([depot, whole_depot_features(coordinates, static.task_mask, world)], dim=-1)
                features = th.cat([features, whole_node_features(coordinates, static.task_mask, world)], dim=-1)
        if self.use_values:
            features = th.cat([features, static.values[..., None]], dim=-1)
        nodes = th.cat([self.embed_depot(depot)[:, None], self.embed_task(features)], dim=1)
        node_mask = None
        # A recording must serve padded instances too.
        if is_recorded() or not static.task_mask.all():
            node_mask = th.cat([th.ones_like(static.task_mask[:, :1]), static.task_mask], dim=1)
        return self.layers(nodes, node_mask, coordinates)

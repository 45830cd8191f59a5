"""
Attention over a set of nodes, for any environment with a Dict observation: the general form of this package's policies.

The node set is encoded by the attention layers of the allocator and the router, once for as long as it stays the same. The
decoder is that of an attention model (Kool et al., 2019): a query of the mean node and the context attends to the nodes, and
the actions that choose a node are scored by their compatibility with the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule, TensorDict
from torch import nn

from sb3_uav.policies.encoder import AttentionLayers, attend, feed_forward
from sb3_uav.policies.extractor import Cache, EncodeOnceExtractor
from sb3_uav.policies.grouping import EPISODE_INDEX
from sb3_uav.policies.masked_policy import MaskedPolicy
from sb3_uav.policies.observation_keys import ObservationKeys
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.torch_state import float32_on_cpu, is_recorded

# Compatibilities are clipped to +-10, as the router's.
_LOGIT_CLIP = 10.0
# The settings that do not depend on what a node is.
_SETTINGS = ("embed_dim", "n_layers", "n_heads", "ff_dim", "normalization", "mixed_precision")


class NodeSet(NamedTuple):
    """
    What is encoded.

    :param nodes: ``(batch, n_nodes, n_features)`` float32, 0 where padded
    :param real: ``(batch, n_nodes)`` bool, False where padded; all True in a row without any real node
    """

    nodes: th.Tensor
    real: th.Tensor


@dataclass(frozen=True)
class NodeSetCache(Cache):
    """
    :param nodes: Node embeddings ``(batch, n_nodes, embed_dim)``
    :param graph: ``(batch, 1, embed_dim)``, the mean node's part of every query
    :param glimpse_key: ``(batch, n_nodes, embed_dim)``
    :param glimpse_value: ``(batch, n_nodes, embed_dim)``
    :param logit_key: ``(batch, n_nodes, embed_dim)``
    :param real: ``(batch, n_nodes)`` bool
    """

    graph: th.Tensor
    glimpse_key: th.Tensor
    glimpse_value: th.Tensor
    logit_key: th.Tensor
    real: th.Tensor


class NodeSetState(NamedTuple):
    """
    :param context: ``(batch, n_samples, n_context)``; None without a context
    :param attended: ``(batch, n_samples, n_nodes)`` bool, the nodes that the query attends to
    """

    context: th.Tensor | None
    attended: th.Tensor


class _NodeSetEncoder(nn.Module):
    """
    Embeds the nodes of a set.

    :param n_features: Number of features of a node
    :param settings: Shape of the network
    """

    def __init__(self, n_features: int, settings: NetworkSettings) -> None:
        super().__init__()
        self.embed_node = nn.Linear(n_features, settings.embed_dim)
        self.layers = AttentionLayers(settings)

    def forward(self, static: NodeSet) -> th.Tensor:
        """
        :param static: ``batch`` node sets
        :return: ``(batch, n_nodes, embed_dim)``; the embeddings of padded nodes are arbitrary
        """
        nodes = self.embed_node(static.nodes)
        node_mask = static.real if is_recorded() or not static.real.all() else None
        # Normalization takes away magnitudes, which matter to the critic.
        return nodes + self.layers(nodes, node_mask)


class MaskedAttentionExtractor(EncodeOnceExtractor):
    """
    Features = [scores of the actions, glimpse at the nodes], or the glimpse alone where no action is a node.

    It encodes the node set and the padding mask; context and action mask are inputs of the decoder. See
    :class:`MaskedAttentionPolicy` for the keys.

    :param observation_space: Any Dict observation space with a node set and an action mask
    :param node_key: Key of the node set
    :param mask_key: Key of the action mask
    :param context_key: Key of the context
    :param padding_key: Key of the padding mask
    :param node_actions: Whether the first actions choose a node
    :param settings: ``embed_dim``, ``n_layers``, ``n_heads``, ``ff_dim``, ``normalization`` and ``mixed_precision``, as of
        :class:`~sb3_uav.policies.settings.NetworkSettings`
    :raises TypeError: If there is no such setting
    :raises ValueError: If a setting is not allowed, or the observation space does not fit; the message names the key
    """

    @float32_on_cpu()
    def __init__(
        self,
        observation_space: spaces.Space,
        node_key: str = "nodes",
        mask_key: str = "action_mask",
        context_key: str | None = None,
        padding_key: str | None = None,
        node_actions: bool | None = None,
        **settings: Any,
    ) -> None:
        keys = ObservationKeys.find(observation_space, node_key, mask_key, context_key, padding_key)
        network = general_settings(settings)
        n_node_actions = _n_node_actions(keys, node_actions)
        embed_dim = network.embed_dim
        features_dim = embed_dim if n_node_actions == 0 else keys.n_actions + embed_dim
        super().__init__(observation_space, features_dim, _NodeSetEncoder(keys.n_features, network))
        self.keys = keys
        self.static_keys = keys.static
        self.n_node_actions = n_node_actions
        self.n_heads = network.n_heads
        self.context_dim = None if n_node_actions == 0 else embed_dim
        self.project_graph = nn.Linear(embed_dim, embed_dim, bias=False)
        self.project_context = nn.Linear(keys.n_context, embed_dim) if keys.n_context > 0 else None
        self.project_nodes = nn.Linear(embed_dim, 3 * embed_dim, bias=False)
        self.project_glimpse = nn.Linear(embed_dim, embed_dim, bias=False)
        self.feed_forward = feed_forward(embed_dim, network.ff_dim)
        n_others = keys.n_actions - n_node_actions
        self.score_others = nn.Linear(embed_dim, n_others) if n_node_actions > 0 and n_others > 0 else None

    def static_part(self, observation: TensorDict) -> NodeSet:
        nodes = observation[self.keys.node].reshape(-1, self.keys.n_nodes, self.keys.n_features)
        if self.keys.padding is None:
            return NodeSet(nodes, th.ones_like(nodes[..., 0], dtype=th.bool))
        real = observation[self.keys.padding].bool()
        # Whatever stands there, also NaN, and attention to nothing would be NaN.
        return NodeSet(nodes.masked_fill(~real[..., None], 0.0), real | ~real.any(-1, keepdim=True))

    def precompute(self, nodes: th.Tensor, static: NodeSet) -> NodeSetCache:
        real = static.real[..., None]
        graph = nodes.masked_fill(~real, 0.0).sum(1) / real.sum(1)
        glimpse_key, glimpse_value, logit_key = self.project_nodes(nodes).chunk(3, dim=-1)
        return NodeSetCache(nodes, self.project_graph(graph)[:, None], glimpse_key, glimpse_value, logit_key, static.real)

    def observed_state(self, cache: NodeSetCache, observation: TensorDict) -> NodeSetState:
        mask = observation[self.keys.mask].bool()
        context = None if self.keys.context is None else observation[self.keys.context]
        if context is not None:
            # A scalar has no axis to flatten.
            context = context.reshape(*context.shape[:2], -1)
        real = cache.real[:, None].expand(-1, mask.shape[1], -1)
        if self.n_node_actions == 0:
            return NodeSetState(context, real)
        attended = mask[..., : self.n_node_actions] & real
        # At the end of an episode, or where only other actions are legal, no node is.
        return NodeSetState(context, attended | (real & ~attended.any(-1, keepdim=True)))

    def decode(self, cache: NodeSetCache, state: NodeSetState) -> th.Tensor:
        query = cache.graph.expand(-1, state.attended.shape[1], -1)
        if self.project_context is not None:
            query = query + self.project_context(state.context)
        attention_bias = th.zeros_like(state.attended, dtype=query.dtype).masked_fill(~state.attended, -th.inf)[:, None]
        heads = attend(query, cache.glimpse_key, cache.glimpse_value, self.n_heads, attention_bias)
        glimpse = query + self.project_glimpse(heads)
        glimpse = glimpse + self.feed_forward(glimpse)
        if self.n_node_actions == 0:
            return glimpse
        compatibility = glimpse @ cache.logit_key.transpose(1, 2) / math.sqrt(glimpse.shape[-1])
        scores = [_LOGIT_CLIP * compatibility.tanh()]
        if self.score_others is not None:
            scores.append(self.score_others(glimpse))
        return th.cat([*scores, glimpse], dim=-1)


class MaskedAttentionPolicy(MaskedPolicy):
    """
    A masked attention policy for any environment with a Dict observation of this kind:

    - a node set ``(n_nodes, n_features)``, features of a magnitude of about 1; or flat, ``(n_nodes * n_features,)``;
    - an action mask ``(n_actions,)``, 1 where an action is legal, at least one in every step;
    - if there is one, a context of any shape: everything else that matters and changes from step to step;
    - if sets differ in size, a padding mask ``(n_nodes,)``, 1 for real nodes. Padded nodes have no influence.

    With at least as many actions as nodes, the first ``n_nodes`` actions choose a node, and any others go through a linear
    head. With fewer, all actions go through that head, behind ``net_arch``.

    The nodes are encoded again only when they change, so what is new in every step belongs into the context and the mask where
    possible. ``net_arch`` shapes the critic alone where actions are nodes.
    See :class:`~sb3_uav.policies.masked_policy.MaskedPolicy` for the other arguments.

    :param observation_space: Observation space of the environment
    :param action_space: Its action space, ``Discrete``
    :param lr_schedule: Learning rate schedule (could be constant)
    :param node_key: Key of the node set in the observation
    :param mask_key: Key of the action mask
    :param context_key: Key of the context; ``"context"``, if there is such a key, when None
    :param padding_key: Key of the padding mask; ``"padding_mask"``, if there is such a key, when None
    :param node_actions: Whether the first ``n_nodes`` actions choose a node; by the number of actions when None
    :param others: Arguments of :class:`~sb3_uav.policies.masked_policy.MaskedPolicy`; of the settings ``embed_dim``,
        ``n_layers``, ``n_heads``, ``ff_dim``, ``normalization`` and ``mixed_precision``
    :raises TypeError: If there is no such argument
    :raises ValueError: If the observation or action space does not fit; the message names the key
    """

    extractor_class: ClassVar[type[MaskedAttentionExtractor]] = MaskedAttentionExtractor
    required_extractor_class = MaskedAttentionExtractor
    features_extractor: MaskedAttentionExtractor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        node_key: str = "nodes",
        mask_key: str = "action_mask",
        context_key: str | None = None,
        padding_key: str | None = None,
        node_actions: bool | None = None,
        **others: Any,
    ) -> None:
        self.mask_key = mask_key
        self._keys: dict[str, Any] = dict(
            node_key=node_key,
            mask_key=mask_key,
            context_key=context_key,
            padding_key=padding_key,
            node_actions=node_actions,
        )
        super().__init__(observation_space, action_space, lr_schedule, **others)
        n_actions = self.features_extractor.keys.n_actions
        if not isinstance(action_space, spaces.Discrete) or action_space.n != n_actions or action_space.start != 0:
            raise ValueError(
                f"observation[{mask_key!r}] has {n_actions} entries, so the action space must be "
                f"Discrete({n_actions}), found {action_space}; give the mask one entry for each action."
            )

    def _network_settings(self, settings: dict[str, Any], preset: str) -> NetworkSettings:
        return general_settings(settings, preset)

    def _extractor_settings(self) -> dict[str, Any]:
        return {**{name: getattr(self.settings, name) for name in _SETTINGS}, **self._keys}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._keys}

    def _mask(self, obs: PyTorchObs, logits: th.Tensor, action_masks: np.ndarray | th.Tensor | None) -> th.Tensor:
        """
        :param obs: ``batch`` observations
        :param logits: ``(batch, n_actions)``
        :param action_masks: The mask of each; that of the observation when None
        :return: ``(batch, n_actions)`` bool
        :raises ValueError: If a row has no legal action, holds something else than 0 and 1, or allows a padded node
        """
        mask = super()._mask(obs, logits, action_masks)
        if is_recorded():
            return mask
        assert isinstance(obs, dict)
        keys = self.features_extractor.keys
        given = obs[keys.mask]
        if action_masks is None and given.is_floating_point() and not ((given == 0) | (given == 1)).all():
            found = given[(given != 0) & (given != 1)][0].item()
            raise ValueError(
                f'observation["{keys.mask}"] holds {found:g}, but a mask has only 0 and 1; if VecNormalize scales it, leave '
                "it out: norm_obs_keys."
            )
        # The static part of a minibatch of whole episodes has other rows than the masks.
        if keys.padding is not None and self.features_extractor.n_node_actions > 0 and EPISODE_INDEX not in obs:
            padded = ~obs[keys.padding].bool()
            if (mask[:, : keys.n_nodes] & padded).any():
                raise ValueError(
                    f'The action mask allows a node that observation["{keys.padding}"] takes for padding; its entries are 1 '
                    "for real nodes and 0 for padded ones, and padded ones must not be legal."
                )
        return mask


def general_settings(settings: dict[str, Any], preset: str | None = None) -> NetworkSettings:
    """
    :param settings: Some of the settings that do not depend on what a node is
    :param preset: Name of a preset for the others; normalization is ``"layer"`` unless it is the paper's
    :return: The settings, without those of our environments
    :raises TypeError: If there is no such setting
    :raises ValueError: If there is no such preset, or a value is not allowed
    """
    unknown = sorted(settings.keys() - set(_SETTINGS))
    if unknown:
        raise TypeError(f"unexpected keyword arguments {unknown}; the settings of this network are {list(_SETTINGS)}.")
    if preset != "paper" and settings.get("normalization") is None:
        # Normalization over a set takes away what all its nodes have in common. On a knapsack with 15 items, PPO packed 5.23
        # after 10,000 steps with this one, 3.66 with "instance"; on a tour of 10 cities the two were alike.
        settings = {**settings, "normalization": "layer"}
    network = NetworkSettings.of(settings, preset)
    return NetworkSettings(**{name: getattr(network, name) for name in _SETTINGS})


def _n_node_actions(keys: ObservationKeys, node_actions: bool | None) -> int:
    """
    :param keys: Sizes of the observation
    :param node_actions: Whether the first actions choose a node; by their number when None
    :return: Number of actions that choose a node: all nodes, or none
    :raises ValueError: If there are too few actions
    """
    if node_actions and keys.n_actions < keys.n_nodes:
        raise ValueError(
            f"node_actions is True, but observation[{keys.mask!r}] has {keys.n_actions} entries for {keys.n_nodes} nodes; "
            "give the mask an entry for every node, or leave out node_actions."
        )
    return keys.n_nodes if node_actions or (node_actions is None and keys.n_actions >= keys.n_nodes) else 0

"""The router: plans the tour of one UAV over its tasks (paper, section IV-B, after Kool et al.'s attention model)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn
from torch.nn import functional

from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import DEPOT, RoutingDynamics, RoutingProblem, RoutingState, collected_value, deterministic
from sb3_uav.policies.base import EpisodicPolicy
from sb3_uav.policies.encoder import attend
from sb3_uav.policies.extractor import Cache, EpisodicExtractor
from sb3_uav.policies.masked_policy import sample_actions
from sb3_uav.policies.move_geometry import MoveFeature, MoveGeometry, WholeMoveFeature
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.torch_state import float32_on_cpu

# Compatibilities are clipped to +-10 (C in the paper's equation (22), after Bello et al.).
_LOGIT_CLIP = 10.0
# What the compatibilities get from the geometry of a move before training: twice as far away is 2^4 times less likely. Tours
# then begin as those of a randomized nearest neighbor search.
_INITIAL_SCORE = {MoveFeature.RELATIVE_DISTANCE: -4.0}
# The same with values: what counts is value per length.
_INITIAL_WHOLE_SCORE = {WholeMoveFeature.WORTH: 4.0}
# Number of chunks, by size, into which subsets are split before they are padded.
_SIZE_CLASSES = 2


@dataclass(frozen=True)
class RouterCache(Cache):
    """
    :param nodes: Node embeddings ``(batch, n_tasks + 1, embed_dim)``, the depot first
    :param graph: ``(batch, 1, embed_dim)``, the instance's part of every query
    :param glimpse_key: ``(batch, n_tasks + 1, embed_dim)``
    :param glimpse_value: ``(batch, n_tasks + 1, embed_dim)``
    :param logit_key: ``(batch, n_tasks + 1, embed_dim)``
    :param unit: ``(batch, 1)``, the unit of the remaining distance
    :param bias_nodes: ``(batch, n_tasks + 1, bias_dim)``, the nodes' part of the move bias; None without ``geometry``
    :param geometry: Measures of the instances; None without ``geometry``
    """

    graph: th.Tensor
    glimpse_key: th.Tensor
    glimpse_value: th.Tensor
    logit_key: th.Tensor
    unit: th.Tensor
    bias_nodes: th.Tensor | None
    geometry: MoveGeometry | None


class RouterState(NamedTuple):
    """
    :param position: ``(batch, n_samples)`` int64, the UAV's current node
    :param remaining_distance: ``(batch, n_samples)`` float32, remaining flight distance
    :param action_mask: ``(batch, n_samples, n_tasks + 1)`` bool
    """

    position: th.Tensor
    remaining_distance: th.Tensor
    action_mask: th.Tensor


class _MoveBias(nn.Module):
    """
    The share of a move's scores that depends on its geometry, together with the embeddings.

    The last score is that of the compatibilities. It starts as a preference for near tasks, see :data:`_INITIAL_SCORE`.

    :param embed_dim: Size of the embeddings
    :param bias_dim: Hidden size
    :param n_scores: Number of scores of a move
    :param mixed_precision: Whether the hidden layer computes in bfloat16: a third to a quarter of the time on CPUs with AMX
    :param whole: Whether there are values and service costs among the features
    """

    def __init__(
        self, embed_dim: int, bias_dim: int, n_scores: int, mixed_precision: bool = False, whole: bool = False
    ) -> None:
        super().__init__()
        self.mixed_precision = mixed_precision
        n_features = len(MoveFeature) + whole * len(WholeMoveFeature)
        self.linear = nn.Linear(n_features, n_scores)
        self.project_features = nn.Linear(n_features, bias_dim)
        self.project_node = nn.Linear(embed_dim, bias_dim, bias=False)
        self.project_query = nn.Linear(embed_dim, bias_dim, bias=False)
        self.score = nn.Linear(bias_dim, n_scores)
        for parameter in (*self.linear.parameters(), *self.score.parameters()):
            nn.init.zeros_(parameter)
        with th.no_grad():
            if whole:
                for worth, weight in _INITIAL_WHOLE_SCORE.items():
                    self.linear.weight[-1, len(MoveFeature) + worth] = weight
            else:
                for feature, weight in _INITIAL_SCORE.items():
                    self.linear.weight[-1, feature] = weight

    def forward(self, features: th.Tensor, nodes: th.Tensor, query: th.Tensor) -> th.Tensor:
        """
        :param features: ``(batch, n_samples, n_nodes, len(MoveFeature))``
        :param nodes: ``(batch, n_nodes, bias_dim)``, the projected nodes
        :param query: ``(batch, n_samples, embed_dim)``, from the current node and the remaining distance
        :return: ``(batch, n_samples, n_nodes, n_scores)``
        """
        # The direct part distinguishes near tasks and stays exact.
        direct = self.linear(features)
        with th.autocast(features.device.type, th.bfloat16, enabled=self.mixed_precision):
            features = self.project_features(features)
            mixed = features + nodes[:, None].to(features.dtype) + self.project_query(query)[:, :, None]
            return direct + self.score(mixed.relu())


class RouterExtractor(EpisodicExtractor):
    """
    Features = [clipped compatibilities of the depot and of every task, glimpse] (paper, equations (20) to (22)).

    The compatibilities are the logits of :class:`RouterPolicy`; other policies may use the features in any way.

    :param observation_space: Observation space of a ``RoutePlanning`` environment
    :param settings: As for :class:`~sb3_uav.policies.allocator.AllocatorExtractor`, with the same errors
    """

    environment = "RoutePlanning"
    own_key = "position"

    @float32_on_cpu()
    def __init__(self, observation_space: spaces.Space, **settings: Any) -> None:
        network = NetworkSettings.of(settings)
        embed_dim, n_heads = network.embed_dim, network.n_heads
        super().__init__(observation_space, self.n_actions(observation_space) + embed_dim, network)
        self.embed_dim = self.context_dim = embed_dim
        self.n_heads = n_heads
        self.project_graph = nn.Linear(embed_dim, embed_dim, bias=False)
        self.project_step = nn.Linear(embed_dim + 1, embed_dim, bias=False)
        self.project_nodes = nn.Linear(embed_dim, 3 * embed_dim, bias=False)
        self.project_glimpse = nn.Linear(embed_dim, embed_dim, bias=False)
        self.scaled = network.relative or network.geometry
        # One score for each head of the glimpse and one for the compatibilities.
        self.move_bias = (
            _MoveBias(embed_dim, network.bias_dim, n_heads + 1, network.mixed_precision, network.whole)
            if network.geometry
            else None
        )

    def precompute(self, nodes: th.Tensor, static: StaticObservation) -> RouterCache:
        real = th.cat([th.ones_like(static.task_mask[:, :1]), static.task_mask], dim=1)[..., None]
        graph = nodes.masked_fill(~real, 0.0).sum(1) / real.sum(1)
        glimpse_key, glimpse_value, logit_key = self.project_nodes(nodes).chunk(3, dim=-1)
        return RouterCache(
            nodes=nodes,
            graph=self.project_graph(graph)[:, None],
            glimpse_key=glimpse_key,
            glimpse_value=glimpse_value,
            logit_key=logit_key,
            unit=static.max_distance if self.scaled else th.ones_like(static.max_distance),
            bias_nodes=None if self.move_bias is None else self.move_bias.project_node(nodes),
            geometry=None if self.move_bias is None else MoveGeometry.of(static, self.whole),
        )

    def observed_state(self, cache: RouterCache, observation: TensorDict) -> RouterState:
        return RouterState(
            observation["position"].long().squeeze(-1),
            observation["remaining_distance"].squeeze(-1),
            observation["action_mask"].bool(),
        )

    def decode(self, cache: RouterCache, state: RouterState) -> th.Tensor:
        here = cache.nodes.gather(1, state.position[..., None].expand(-1, -1, self.embed_dim))
        remaining = state.remaining_distance / cache.unit
        glimpse_bias = th.zeros_like(state.action_mask, dtype=here.dtype)[:, None]
        logit_bias = glimpse_bias[:, 0]
        query = cache.graph + self.project_step(th.cat([here, remaining[..., None]], dim=-1))
        if self.move_bias is not None and cache.geometry is not None:
            features = cache.geometry.features(state.position, remaining, state.action_mask)
            bias = self.move_bias(features, cache.bias_nodes, query).movedim(-1, 1)
            glimpse_bias, logit_bias = bias[:, :-1], bias[:, -1]
        attention_bias = glimpse_bias.masked_fill(~state.action_mask[:, None], -th.inf)
        heads = attend(query, cache.glimpse_key, cache.glimpse_value, self.n_heads, attention_bias)
        glimpse = self.project_glimpse(heads)
        compatibility = glimpse @ cache.logit_key.transpose(1, 2) / math.sqrt(self.embed_dim)
        return th.cat([_LOGIT_CLIP * compatibility.tanh() + logit_bias, glimpse], dim=-1)


class RouterPolicy(EpisodicPolicy):
    """
    The lower level's policy. See :class:`~sb3_uav.policies.masked_policy.MaskedPolicy` for the arguments.

    It takes any number of tasks.
    ``net_arch`` shapes the critic only, because the actor's logits are the extractor's compatibilities.
    """

    level = "router"
    extractor_class: ClassVar[type[RouterExtractor]] = RouterExtractor
    required_extractor_class = RouterExtractor
    features_extractor: RouterExtractor

    @classmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        problem = RoutingProblem(UniformGenerator(n_tasks=1, n_uavs=1))
        return problem.observation_space, problem.action_space

    def encode(self, instances: Instances) -> Cache:
        return super().encode(instances.with_fleet(1))

    @staticmethod
    def _decoder_state(dynamics: RoutingDynamics, state: RoutingState) -> RouterState:
        remaining = dynamics.max_distance[:, None] - state.traveled
        return RouterState(state.position, remaining.float(), state.action_mask)

    def _decode_episodes(
        self, instances: Instances, cache: RouterCache, n_samples: int, deterministic: bool, generator: th.Generator | None
    ) -> th.Tensor:
        dynamics = RoutingDynamics(instances)
        state = dynamics.reset(n_samples)
        actions = []
        while not state.done.all():
            logits, _ = self.decode_step(cache, self._decoder_state(dynamics, state))
            action = sample_actions(logits.masked_fill(~state.action_mask, -th.inf), deterministic, generator)
            actions.append(action)
            state, _ = dynamics.step(state, action)
        return th.stack(actions, dim=-1)

    def _episode_states(self, instances: Instances, cache: RouterCache, actions: th.Tensor) -> tuple[RouterState, th.Tensor]:
        dynamics = RoutingDynamics(instances)
        state = dynamics.reset(actions.shape[1])
        states = []
        for step in range(actions.shape[2]):
            states.append(self._decoder_state(dynamics, state))
            state, _ = dynamics.step(state, actions[..., step])
        stacked = RouterState(*(th.stack(field, dim=2).flatten(1, 2) for field in zip(*states, strict=True)))
        return stacked, stacked.action_mask

    # Greedy, unless it is called with more than a router's one argument.
    @deterministic
    @th.no_grad()
    def plan(
        self,
        instances: Instances,
        max_rows: int | None = None,
        n_tours: int = 1,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        """
        Plan tours: the router of allocation environments and solvers.

        Rows are taken in order of size, so that small subsets are not padded to the largest.

        :param instances: ``batch`` single-UAV instances, on any device
        :param max_rows: Number of rows to decode at once; as many as memory allows when None
        :param n_tours: Number of tours to try for each row, the greedy one and samples; the best is kept
        :param generator: Source of randomness for sampling, on the policy's device
        :return: ``(batch, n_steps)`` int64 node indices padded with the depot, on the device of the instances
        """
        self.set_training_mode(False)
        sizes, order = instances.task_mask.sum(1).clamp(min=1).sort()
        sorted_sizes = sizes.tolist()
        chunk = min(max_rows or len(order), math.ceil(len(order) / _SIZE_CLASSES))
        planned = th.full((len(order), instances.n_tasks + 1), DEPOT, device=instances.device)
        start, longest = 0, 1
        while start < len(order):
            largest = sorted_sizes[min(start + chunk, len(order)) - 1]
            rows = order[start : start + min(chunk, max(self.rows_that_fit(largest + 1) // n_tours, 1))]
            subsets = instances[rows].trim(largest).to(self.device)
            tours = self._best_tours(subsets, n_tours, generator).to(instances.device)
            planned[rows, : tours.shape[1]] = tours
            start, longest = start + len(rows), max(longest, tours.shape[1])
        return planned[:, :longest]

    def _best_tours(self, instances: Instances, n_tours: int, generator: th.Generator | None) -> th.Tensor:
        """
        :param instances: ``batch`` instances on the policy's device
        :param n_tours: Number of tours to try for each
        :param generator: Source of randomness
        :return: ``(batch, n_steps)``
        """
        cache = self.encode(instances)
        greedy = self.decode_episodes(instances, cache=cache)
        if n_tours == 1:
            return greedy[:, 0]
        sampled = self.decode_episodes(instances, n_tours - 1, False, generator, cache)
        n_steps = max(greedy.shape[2], sampled.shape[2])
        tours = th.cat([functional.pad(part, (0, n_steps - part.shape[2]), value=DEPOT) for part in (greedy, sampled)], dim=1)
        best = collected_value(instances, tours).argmax(1)
        return tours[th.arange(len(tours), device=tours.device), best]

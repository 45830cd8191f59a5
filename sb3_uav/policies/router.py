"""The router: plans the tour of one UAV over its tasks (paper, section IV-B, after Kool et al.'s attention model)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule, TensorDict
from torch import nn

from sb3_uav.envs.instances import Instances, UniformGenerator
from sb3_uav.envs.routing import DEPOT, RoutingDynamics, RoutingProblem, RoutingState
from sb3_uav.policies.base import Cache, EpisodicExtractor, EpisodicPolicy, sample_actions
from sb3_uav.policies.encoder import StaticObservation, attend

# Logits are clipped to +-10 (paper, equation of u; Bello et al.).
LOGIT_CLIP = 10.0
# Into how many chunks by size subsets are cut before they are padded.
SIZE_CLASSES = 4


class RouterState(NamedTuple):
    """
    :param position: ``(batch, n_samples)`` int64, the node where the UAV is
    :param remaining_distance: ``(batch, n_samples)`` float32, what it can still fly
    :param action_mask: ``(batch, n_samples, n_tasks + 1)`` bool
    """

    position: th.Tensor
    remaining_distance: th.Tensor
    action_mask: th.Tensor


class RouterExtractor(EpisodicExtractor):
    """
    Features = [clipped compatibilities of the depot and of every task, glimpse] (paper, section IV-B).

    The compatibilities are the logits of :class:`RouterPolicy`; other policies may build on the features as they like.

    :param observation_space: Of a ``RoutePlanning`` environment
    :param embed_dim: Size of the embeddings
    :param n_layers: Number of attention layers
    :param n_heads: Number of heads
    :param ff_dim: Hidden size of the feed-forward sublayers
    :param normalization: ``"instance"``, ``"batch"``, ``"layer"`` or ``"none"``
    :param use_values: Whether task values are features of the encoder
    """

    environment = "RoutePlanning"
    own_key = "position"

    def __init__(
        self,
        observation_space: spaces.Space,
        embed_dim: int = 128,
        n_layers: int = 3,
        n_heads: int = 8,
        ff_dim: int = 512,
        normalization: str = "instance",
        use_values: bool = True,
    ) -> None:
        super().__init__(
            observation_space,
            self.n_actions(observation_space) + embed_dim,
            embed_dim=embed_dim,
            n_layers=n_layers,
            n_heads=n_heads,
            ff_dim=ff_dim,
            normalization=normalization,
            use_values=use_values,
        )
        self.embed_dim = embed_dim
        self.n_heads = n_heads
        self.project_graph = nn.Linear(embed_dim, embed_dim, bias=False)
        self.project_step = nn.Linear(embed_dim + 1, embed_dim, bias=False)
        self.project_nodes = nn.Linear(embed_dim, 3 * embed_dim, bias=False)
        self.project_glimpse = nn.Linear(embed_dim, embed_dim, bias=False)

    def precompute(self, nodes: th.Tensor, static: StaticObservation) -> Cache:
        real = th.cat([th.ones_like(static.task_mask[:, :1]), static.task_mask], dim=1)[..., None]
        graph = nodes.masked_fill(~real, 0.0).sum(1) / real.sum(1)
        glimpse_key, glimpse_value, logit_key = self.project_nodes(nodes).chunk(3, dim=-1)
        return Cache(nodes, (self.project_graph(graph)[:, None], glimpse_key, glimpse_value, logit_key))

    def observed_state(self, cache: Cache, observation: TensorDict) -> RouterState:
        return RouterState(
            observation["position"].long().squeeze(-1),
            observation["remaining_distance"].squeeze(-1),
            observation["action_mask"].bool(),
        )

    def decode(self, cache: Cache, state: RouterState) -> th.Tensor:
        graph, glimpse_key, glimpse_value, logit_key = cache.projections
        here = cache.nodes.gather(1, state.position[..., None].expand(-1, -1, self.embed_dim))
        step = th.cat([here, state.remaining_distance[..., None]], dim=-1)
        query = graph + self.project_step(step)
        attention_bias = th.zeros_like(state.action_mask, dtype=query.dtype).masked_fill(~state.action_mask, -th.inf)
        heads = attend(query, glimpse_key, glimpse_value, self.n_heads, attention_bias[:, None])
        glimpse = self.project_glimpse(heads)
        compatibility = glimpse @ logit_key.transpose(1, 2) / math.sqrt(self.embed_dim)
        return th.cat([LOGIT_CLIP * compatibility.tanh(), glimpse], dim=-1)


class RouterPolicy(EpisodicPolicy):
    """
    The lower level's policy. See :class:`~sb3_uav.policies.base.EpisodicPolicy` for the arguments.

    The number of tasks is free.
    ``net_arch`` shapes the critic only, because the actor's logits are the extractor's compatibilities.
    """

    extractor_class = RouterExtractor
    features_extractor: RouterExtractor

    @classmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        problem = RoutingProblem(UniformGenerator(n_tasks=1, n_uavs=1))
        return problem.observation_space, problem.action_space

    def _build_mlp_extractor(self) -> None:
        # The heads see the glimpse alone; the compatibilities are logits already, and their number varies.
        features_dim, self.features_dim = self.features_dim, self.features_extractor.embed_dim
        super()._build_mlp_extractor()
        self.features_dim = features_dim

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        self.mlp_extractor.policy_net = nn.Sequential()
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _heads(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        embed_dim = self.features_extractor.embed_dim
        logits, glimpse = features[..., :-embed_dim], features[..., -embed_dim:]
        return logits, self.value_net(self.mlp_extractor.forward_critic(glimpse)).squeeze(-1)

    @staticmethod
    def _decoder_state(dynamics: RoutingDynamics, state: RoutingState) -> RouterState:
        remaining = dynamics.instances.max_distance[:, None] - state.travelled
        return RouterState(state.position, remaining.float(), state.action_mask)

    def _decode_episodes(
        self, instances: Instances, cache: Cache, n_samples: int, deterministic: bool, generator: th.Generator | None
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

    def _episode_states(self, instances: Instances, cache: Cache, actions: th.Tensor) -> tuple[RouterState, th.Tensor]:
        dynamics = RoutingDynamics(instances)
        state = dynamics.reset(actions.shape[1])
        states = []
        for step in range(actions.shape[2]):
            states.append(self._decoder_state(dynamics, state))
            state, _ = dynamics.step(state, actions[..., step])
        stacked = RouterState(*(th.stack(field, dim=2).flatten(1, 2) for field in zip(*states, strict=True)))
        return stacked, stacked.action_mask

    @th.no_grad()
    def plan(self, instances: Instances, max_rows: int | None = None) -> th.Tensor:
        """
        Plan tours greedily: the router of allocation environments and solvers.

        Rows are taken in order of size, so that small subsets are not padded to the largest.

        :param instances: ``batch`` single-UAV instances, on any device
        :param max_rows: How many rows to decode at once; as many as memory allows when None
        :return: ``(batch, n_steps)`` int64 node indices padded with the depot, on the device of the instances
        """
        self.set_training_mode(False)
        sizes, order = instances.task_mask.sum(1).clamp(min=1).sort()
        sorted_sizes = sizes.tolist()
        chunk = min(max_rows or len(order), math.ceil(len(order) / SIZE_CLASSES))
        planned = th.full((len(order), instances.n_tasks + 1), DEPOT, device=instances.device)
        start, longest = 0, 1
        while start < len(order):
            largest = sorted_sizes[min(start + chunk, len(order)) - 1]
            rows = order[start : start + min(chunk, self.rows_that_fit(largest + 1))]
            subsets = instances[rows].trim(largest).to(self.device)
            tours = self.decode_episodes(subsets)[:, 0].to(instances.device)
            planned[rows, : tours.shape[1]] = tours
            start, longest = start + len(rows), max(longest, tours.shape[1])
        return planned[:, :longest]

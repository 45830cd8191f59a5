"""The allocator: gives every task, in input order, to a UAV (paper, section IV-A2)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_uav.envs.allocation import UNASSIGNED, AllocationProblem
from sb3_uav.envs.instances import Instances, UniformGenerator
from sb3_uav.policies.base import Cache, EpisodicExtractor, EpisodicPolicy, sample_actions
from sb3_uav.policies.encoder import StaticObservation


class AllocatorState(NamedTuple):
    """
    :param context: ``(batch, n_samples, n_uavs, embed_dim)``, element-wise maximum of the embeddings of the depot and of the
        UAV's tasks (paper, equation (16))
    :param task: ``(batch, n_samples)`` int64, the task to allocate
    """

    context: th.Tensor
    task: th.Tensor


class AllocatorExtractor(EpisodicExtractor):
    """
    Features = [task subset embedding, embedding of the current task] (paper, equations (16) to (18)).

    With ``net_arch=[]`` on top, SB3's action layer is the paper's last equation (19).

    :param observation_space: Of a ``TaskAllocation`` environment
    :param embed_dim: Size of the embeddings
    :param n_layers: Number of attention layers
    :param n_heads: Number of heads
    :param ff_dim: Hidden size of the feed-forward layers
    :param normalization: ``"instance"``, ``"batch"``, ``"layer"`` or ``"none"``
    :param use_values: Whether task values are features of the encoder
    """

    environment = "TaskAllocation"
    own_key = "assignment"

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
        n_uavs = self.n_actions(observation_space)
        super().__init__(
            observation_space,
            2 * embed_dim,
            embed_dim=embed_dim,
            n_layers=n_layers,
            n_heads=n_heads,
            ff_dim=ff_dim,
            normalization=normalization,
            use_values=use_values,
        )
        self.n_uavs = n_uavs
        self.project_context = nn.Linear(self.n_uavs * embed_dim, embed_dim)
        self.feed_forward = nn.Sequential(nn.Linear(embed_dim, ff_dim), nn.ReLU(), nn.Linear(ff_dim, embed_dim))

    def precompute(self, nodes: th.Tensor, static: StaticObservation) -> Cache:
        return Cache(nodes)

    def observed_state(self, cache: Cache, observation: TensorDict) -> AllocatorState:
        assignment, current_task = observation["assignment"], observation["current_task"].long().squeeze(-1)
        n_tasks = assignment.shape[-1]
        final = assignment.gather(1, current_task.argmax(1)[:, None, None].expand(-1, 1, n_tasks))
        decided = th.arange(n_tasks, device=assignment.device) < current_task[..., None]
        if assignment.shape[1] > 1 and (assignment == final.where(decided, UNASSIGNED)).all():
            # Steps of one episode: one running maximum serves them all.
            context = self.running_context(cache, final)[:, 0]
            steps = current_task[..., None, None].expand(-1, -1, *context.shape[2:])
            held = context.gather(1, steps)
        else:
            uavs = th.arange(self.n_uavs, device=assignment.device)
            mine = (assignment[:, :, None] == uavs[:, None])[..., None]
            # The depot belongs to every UAV and bounds the maximum from below, so it can stand in for other UAVs' tasks.
            held = th.where(mine, cache.nodes[:, None, None, 1:], cache.nodes[:, None, None, :1]).amax(3)
        return AllocatorState(held, current_task.clamp(max=n_tasks - 1))

    def running_context(self, cache: Cache, assignment: th.Tensor) -> th.Tensor:
        """
        What every UAV holds before and after each step of complete episodes.

        :param cache: Of ``batch`` instances
        :param assignment: ``(batch, n_samples, n_tasks)``, the UAV of each task or -1
        :return: ``(batch, n_samples, n_tasks + 1, n_uavs, embed_dim)``
        """
        uavs = th.arange(self.n_uavs, device=assignment.device)
        mine = (assignment[..., None] == uavs)[..., None]
        depot, tasks = cache.nodes[:, None, :1, None], cache.nodes[:, None, 1:, None]
        first = depot.expand(-1, assignment.shape[1], 1, self.n_uavs, -1)
        return th.cat([first, th.where(mine, tasks, depot)], dim=2).cummax(dim=2).values

    def initial_context(self, cache: Cache, n_samples: int) -> th.Tensor:
        """
        :param cache: Of ``batch`` instances
        :param n_samples: Episodes per instance
        :return: ``(batch, n_samples, n_uavs, embed_dim)``, the depot's embedding everywhere
        """
        depot = cache.nodes[:, 0]
        return depot[:, None, None].repeat(1, n_samples, self.n_uavs, 1)

    def decode(self, cache: Cache, state: AllocatorState) -> th.Tensor:
        subset_embedding = self.feed_forward(self.project_context(state.context.flatten(2)))
        task_embedding = cache.nodes.gather(1, (state.task + 1)[..., None].expand(-1, -1, cache.nodes.shape[-1]))
        return th.cat([subset_embedding, task_embedding], dim=-1)


class AllocatorPolicy(EpisodicPolicy):
    """
    The upper level's policy. See :class:`~sb3_uav.policies.base.EpisodicPolicy` for the arguments.

    The paper's decoder is bound to one number of UAVs; the number of tasks is free.
    """

    extractor_class = AllocatorExtractor
    features_extractor: AllocatorExtractor

    @classmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        problem = AllocationProblem(UniformGenerator(n_tasks=1, n_uavs=n_actions or 1))
        return problem.observation_space, problem.action_space

    @property
    def n_uavs(self) -> int:
        """The fleet size that the network was made for."""
        return self.features_extractor.n_uavs

    def check_fleet(self, instances: Instances) -> None:
        """
        :raises ValueError: If the instances have another number of UAVs than the network
        """
        if instances.n_uavs != self.n_uavs:
            raise ValueError(
                f"The allocator was trained for {self.n_uavs} UAVs, the instances have {instances.n_uavs}; "
                f"use an allocator trained for {instances.n_uavs}."
            )

    def _heads(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        logits = self.action_net(self.mlp_extractor.forward_actor(features))
        return logits, self.value_net(self.mlp_extractor.forward_critic(features)).squeeze(-1)

    def _decode_episodes(
        self, instances: Instances, cache: Cache, n_samples: int, deterministic: bool, generator: th.Generator | None
    ) -> th.Tensor:
        self.check_fleet(instances)
        context = self.features_extractor.initial_context(cache, n_samples)
        batch_size, embed_dim = len(instances), cache.nodes.shape[-1]
        actions = []
        for step in range(instances.n_tasks):
            task = th.full((batch_size, n_samples), step, device=instances.device)
            logits, _ = self.decode_step(cache, AllocatorState(context, task))
            action = sample_actions(logits, deterministic, generator)
            actions.append(action)
            chosen = action[..., None, None].expand(-1, -1, 1, embed_dim)
            grown = th.maximum(context.gather(2, chosen), cache.nodes[:, step + 1][:, None, None])
            context.scatter_(2, chosen, grown)
        return th.stack(actions, dim=-1).masked_fill(~instances.task_mask[:, None], UNASSIGNED)

    def _episode_states(self, instances: Instances, cache: Cache, actions: th.Tensor) -> tuple[AllocatorState, th.Tensor]:
        self.check_fleet(instances)
        batch_size, n_samples, n_tasks = actions.shape
        context = self.features_extractor.running_context(cache, actions)[:, :, :-1]
        task = th.arange(n_tasks, device=actions.device).expand(batch_size, n_samples, n_tasks)
        action_mask = th.ones(1, 1, self.n_uavs, dtype=th.bool, device=actions.device)
        return AllocatorState(context.flatten(1, 2), task.flatten(1)), action_mask

    def evaluate_episodes(self, instances: Instances, actions: th.Tensor, cache: Cache | None = None) -> Any:
        evaluation = super().evaluate_episodes(instances, actions.clamp(min=0), cache)
        real = instances.task_mask[:, None]
        return type(evaluation)(*(field.masked_fill(~real, 0.0) for field in evaluation))

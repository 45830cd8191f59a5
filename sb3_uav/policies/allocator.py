"""The allocator: gives every task, one after the other, to a UAV (paper, section IV-A2)."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.distributions import MaskableDistribution
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict
from torch import nn

from sb3_uav.envs.allocation import UNASSIGNED, AllocationProblem
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.sweep import sweep_order
from sb3_uav.policies.base import PRESETS, Cache, EpisodicExtractor, EpisodicPolicy, sample_actions
from sb3_uav.policies.encoder import StaticObservation
from sb3_uav.policies.geometry import N_FLEET_FEATURES, FleetGeometry, FleetState

# Hidden size of the scorer.
SCORER_DIM = 64
# What the scorer prefers before training (indices of FleetGeometry.features): the UAV that has the task's neighbours, until it
# has about its share.
OVERLOAD, VOTES, RELATIVE_DISTANCE = (1, -60.0), (3, 4.0), (4, -0.5)


class AllocatorState(NamedTuple):
    """
    :param context: ``(batch, n_samples, n_uavs, embed_dim)``, element-wise maximum of the embeddings of the depot and of the
        UAV's tasks (paper, equation (16))
    :param task: ``(batch, n_samples)`` int64, the task to allocate
    :param features: ``(batch, n_samples, n_uavs, N_FLEET_FEATURES)``, how the task fits to each UAV; None without geometry
    """

    context: th.Tensor
    task: th.Tensor
    features: th.Tensor | None


class SharedScorer(nn.Module):
    """
    Judges how well a task fits to a UAV, with the same parameters for every UAV.

    :param embed_dim: Size of the embeddings
    :param geometry: Whether it is told distances and loads
    """

    def __init__(self, embed_dim: int, geometry: bool) -> None:
        super().__init__()
        self.project_task = nn.Linear(embed_dim, SCORER_DIM)
        self.project_uav = nn.Linear(embed_dim, SCORER_DIM, bias=False)
        self.project_fleet = nn.Linear(embed_dim, SCORER_DIM, bias=False)
        self.project_features = nn.Linear(N_FLEET_FEATURES, SCORER_DIM, bias=False) if geometry else None
        self.hidden = nn.Sequential(nn.ReLU(), nn.Linear(SCORER_DIM, SCORER_DIM), nn.ReLU())
        self.score = nn.Linear(SCORER_DIM, 1)
        self.direct = nn.Linear(N_FLEET_FEATURES, 1, bias=False) if geometry else None
        if self.direct is not None:
            for parameter in (*self.direct.parameters(), *self.score.parameters()):
                nn.init.zeros_(parameter)
            with th.no_grad():
                for column, weight in (OVERLOAD, VOTES, RELATIVE_DISTANCE):
                    self.direct.weight[0, column] = weight

    def forward(self, context: th.Tensor, task: th.Tensor, features: th.Tensor | None) -> th.Tensor:
        """
        :param context: ``(batch, n_samples, n_uavs, embed_dim)``
        :param task: ``(batch, n_samples, SCORER_DIM)``, a projected task
        :param features: ``(batch, n_samples, n_uavs, N_FLEET_FEATURES)``
        :return: ``(batch, n_samples, n_uavs)``
        """
        mixed = self.project_uav(context) + (task + self.project_fleet(context.mean(2)))[:, :, None]
        if features is None or self.project_features is None or self.direct is None:
            return self.score(self.hidden(mixed)).squeeze(-1)
        mixed = mixed + self.project_features(features)
        return (self.score(self.hidden(mixed)) + self.direct(features)).squeeze(-1)


class AllocatorExtractor(EpisodicExtractor):
    """
    Features = [task subset embedding, embedding of the current task] (paper, equations (16) to (18)).

    With ``net_arch=[]`` on top, SB3's action layer is the paper's last equation (19).
    With ``shared_scorer`` they are [score of every UAV, embedding of the current task], and the scores are the logits.

    :param observation_space: Of a ``TaskAllocation`` environment
    :param embed_dim: Size of the embeddings
    :param n_layers: Number of attention layers
    :param n_heads: Number of heads
    :param ff_dim: Hidden size of the feed-forward layers
    :param normalization: ``"instance"``, ``"batch"``, ``"layer"`` or ``"none"``
    :param use_values: Whether task values are features of the encoder
    :param relative: Whether the encoder sees scaled coordinates relative to the depot
    :param geometry: Whether the shared scorer is told distances and loads
    :param shared_scorer: Whether one scorer judges all UAVs
    :param mixed_precision: Whether the encoder computes in bfloat16
    """

    environment = "TaskAllocation"
    own_key = "assignment"
    foreign_settings = frozenset({"sweep", "bias_dim"})

    def __init__(
        self,
        observation_space: spaces.Space,
        embed_dim: int = 128,
        n_layers: int = 3,
        n_heads: int = 8,
        ff_dim: int = 512,
        normalization: str = "instance",
        use_values: bool = True,
        relative: bool = False,
        geometry: bool = False,
        shared_scorer: bool = False,
        mixed_precision: bool = False,
    ) -> None:
        n_uavs = self.n_actions(observation_space)
        super().__init__(
            observation_space,
            n_uavs + embed_dim if shared_scorer else 2 * embed_dim,
            embed_dim=embed_dim,
            n_layers=n_layers,
            n_heads=n_heads,
            ff_dim=ff_dim,
            normalization=normalization,
            use_values=use_values,
            relative=relative,
            mixed_precision=mixed_precision,
        )
        self.geometry = geometry and shared_scorer
        self.n_uavs = None if shared_scorer else n_uavs
        if shared_scorer:
            self.context_dim = embed_dim
            self.scorer = SharedScorer(embed_dim, geometry)
        else:
            self.project_context = nn.Linear(n_uavs * embed_dim, embed_dim)
            self.feed_forward = nn.Sequential(nn.Linear(embed_dim, ff_dim), nn.ReLU(), nn.Linear(ff_dim, embed_dim))

    def precompute(self, nodes: th.Tensor, static: StaticObservation) -> Cache:
        if self.n_uavs is not None:
            return Cache(nodes)
        projected = self.scorer.project_task(nodes)
        return Cache(nodes, (projected, *FleetGeometry.of(static)) if self.geometry else (projected,))

    def fleet_geometry(self, cache: Cache) -> FleetGeometry | None:
        """
        :param cache: Of ``batch`` instances
        :return: Their measures; None if the scorer is not told any
        """
        return FleetGeometry(*cache.projections[1:]) if self.geometry else None

    def observed_state(self, cache: Cache, observation: TensorDict) -> AllocatorState:
        assignment, current_task = observation["assignment"], observation["current_task"].long().squeeze(-1)
        n_tasks = assignment.shape[-1]
        task, uavs = (
            current_task.clamp(max=n_tasks - 1),
            th.arange(observation["action_mask"].shape[-1], device=cache.nodes.device),
        )
        geometry, fleet, features = self.fleet_geometry(cache), None, None
        final = assignment.gather(1, current_task.argmax(1)[:, None, None].expand(-1, 1, n_tasks))
        decided = th.arange(n_tasks, device=assignment.device) < current_task[..., None]
        if assignment.shape[1] > 1 and (assignment == final.where(decided, UNASSIGNED)).all():
            # Steps of one episode: one running maximum serves them all.
            mine = final[..., None] == uavs
            context = at_steps(self.running_context(cache, mine), current_task)
            if geometry is not None:
                fleet = FleetState(*(at_steps(field, current_task) for field in geometry.of_prefixes(mine)))
        else:
            mine = assignment[..., None] == uavs
            # The depot belongs to every UAV and bounds the maximum from below, so it can stand in for other UAVs' tasks.
            context = th.where(mine[..., None], cache.nodes[:, None, 1:, None], cache.nodes[:, None, :1, None]).amax(2)
            if geometry is not None:
                fleet = geometry.of_assignment(mine)
        if geometry is not None and fleet is not None:
            features = geometry.features(fleet, task, geometry.owners(task, assignment.long()))
        return AllocatorState(context, task, features)

    def running_context(self, cache: Cache, mine: th.Tensor) -> th.Tensor:
        """
        What every UAV holds before and after each step of complete episodes.

        :param cache: Of ``batch`` instances
        :param mine: ``(batch, n_samples, n_tasks, n_uavs)`` bool, whose task each is
        :return: ``(batch, n_samples, n_tasks + 1, n_uavs, embed_dim)``
        """
        depot, tasks = cache.nodes[:, None, :1, None], cache.nodes[:, None, 1:, None]
        first = depot.expand(-1, mine.shape[1], 1, mine.shape[3], -1)
        return th.cat([first, th.where(mine[..., None], tasks, depot)], dim=2).cummax(dim=2).values

    def initial_context(self, cache: Cache, n_samples: int, n_uavs: int) -> th.Tensor:
        """
        :param cache: Of ``batch`` instances
        :param n_samples: Episodes per instance
        :param n_uavs: Size of the fleet
        :return: ``(batch, n_samples, n_uavs, embed_dim)``, the depot's embedding everywhere
        """
        depot = cache.nodes[:, 0]
        return depot[:, None, None].repeat(1, n_samples, n_uavs, 1)

    def decode(self, cache: Cache, state: AllocatorState) -> th.Tensor:
        node = (state.task + 1)[..., None]
        task_embedding = cache.nodes.gather(1, node.expand(-1, -1, cache.nodes.shape[-1]))
        if self.n_uavs is None:
            projected = cache.projections[0]
            task = projected.gather(1, node.expand(-1, -1, projected.shape[-1]))
            return th.cat([self.scorer(state.context, task, state.features), task_embedding], dim=-1)
        subset_embedding = self.feed_forward(self.project_context(state.context.flatten(2)))
        return th.cat([subset_embedding, task_embedding], dim=-1)


def at_steps(running: th.Tensor, steps: th.Tensor) -> th.Tensor:
    """
    :param running: ``(batch, 1, n_steps, ...)``, something at every step of an episode
    :param steps: ``(batch, n_samples)`` int64
    :return: ``(batch, n_samples, ...)``, the same at these steps
    """
    index = steps.view(*steps.shape, *[1] * (running.dim() - 3)).expand(-1, -1, *running.shape[3:])
    return running[:, 0].gather(1, index)


class AllocatorPolicy(EpisodicPolicy):
    """
    The upper level's policy. See :class:`~sb3_uav.policies.base.EpisodicPolicy` for the arguments.

    The number of tasks is free, and with ``shared_scorer`` that of UAVs too; the paper's decoder is bound to one.
    """

    extractor_class = AllocatorExtractor
    features_extractor: AllocatorExtractor
    _order_is_checked = False

    @classmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        problem = AllocationProblem(UniformGenerator(n_tasks=1, n_uavs=n_actions or 1))
        return problem.observation_space, problem.action_space

    @property
    def n_uavs(self) -> int | None:
        """The fleet size that the network was made for; None if it serves any."""
        return self.features_extractor.n_uavs

    @property
    def sweep(self) -> bool:
        """Whether the tasks should be swept around the depot."""
        given = self._own_parameters["sweep"]
        return PRESETS[self._own_parameters["preset"]]["sweep"] if given is None else given

    @property
    def env_order(self) -> str:
        """The ``task_order`` of the environments that suit it."""
        return "sweep" if self.sweep else "input"

    def _decode_observation(
        self, obs: PyTorchObs, action_masks: np.ndarray | th.Tensor | None
    ) -> tuple[MaskableDistribution, th.Tensor]:
        if self.sweep and not self._order_is_checked:
            self._order_is_checked = True
            assert isinstance(obs, dict)
            self._check_order(StaticObservation.from_observation(obs))
        return super()._decode_observation(obs, action_masks)

    def _check_order(self, static: StaticObservation) -> None:
        """Warn if the tasks of the first observations are not in the order that the allocator wants."""
        depot, tasks, values, max_distance = static.depot, static.tasks, static.values, static.max_distance[:, 0]
        order = sweep_order(Instances(depot, tasks, values, max_distance, 1, static.task_mask))
        # Observations are rounded, which may exchange a few tasks.
        if (order == th.arange(order.shape[1], device=order.device)).float().mean() < 0.5:
            warnings.warn(
                "This AllocatorPolicy wants the tasks in the order of a sweep around the depot, but the environment shows "
                'them in another one, and schedules will be worse: make it with task_order="sweep", or the policy with '
                "sweep=False.",
                stacklevel=4,
            )

    def task_order(self, instances: Instances, variant: int = 0) -> th.Tensor:
        if not self.sweep:
            return super().task_order(instances)
        return sweep_order(instances, gap=variant // 2, clockwise=variant % 2 == 1)

    def check_fleet(self, instances: Instances) -> None:
        """
        :raises ValueError: If the instances have another number of UAVs than the network
        """
        if self.n_uavs not in (None, instances.n_uavs):
            raise ValueError(
                f"The allocator was trained for {self.n_uavs} UAVs, the instances have {instances.n_uavs}; "
                f"use an allocator trained for {instances.n_uavs}."
            )

    def _decode_episodes(
        self, instances: Instances, cache: Cache, n_samples: int, deterministic: bool, generator: th.Generator | None
    ) -> th.Tensor:
        self.check_fleet(instances)
        n_uavs, n_tasks = instances.n_uavs, instances.n_tasks
        context = self.features_extractor.initial_context(cache, n_samples, n_uavs)
        batch_size, embed_dim = len(instances), cache.nodes.shape[-1]
        geometry = self.features_extractor.fleet_geometry(cache)
        fleet = None if geometry is None else geometry.initial(n_samples, n_uavs)
        uavs = th.arange(n_uavs, device=instances.device)
        actions = th.full((batch_size, n_samples, n_tasks), UNASSIGNED, device=instances.device)
        for step in range(n_tasks):
            task = th.full((batch_size, n_samples), step, device=instances.device)
            features = None
            if geometry is not None and fleet is not None:
                features = geometry.features(fleet, task, geometry.owners(task, actions))
            logits, _ = self.decode_step(cache, AllocatorState(context, task, features))
            action = sample_actions(logits, deterministic, generator)
            actions[..., step] = action
            chosen = action[..., None, None].expand(-1, -1, 1, embed_dim)
            grown = th.maximum(context.gather(2, chosen), cache.nodes[:, step + 1][:, None, None])
            context.scatter_(2, chosen, grown)
            if geometry is not None and fleet is not None:
                fleet = geometry.add(fleet, step, action[..., None] == uavs)
        return actions.masked_fill(~instances.task_mask[:, None], UNASSIGNED)

    def _episode_states(self, instances: Instances, cache: Cache, actions: th.Tensor) -> tuple[AllocatorState, th.Tensor]:
        self.check_fleet(instances)
        batch_size, n_samples, n_tasks = actions.shape
        mine = actions[..., None] == th.arange(instances.n_uavs, device=actions.device)
        context = self.features_extractor.running_context(cache, mine)[:, :, :-1].flatten(1, 2)
        task = th.arange(n_tasks, device=actions.device).expand(batch_size, n_samples, n_tasks).flatten(1)
        geometry = self.features_extractor.fleet_geometry(cache)
        features = None
        if geometry is not None:
            fleet = FleetState(*(field[:, :, :-1].flatten(1, 2) for field in geometry.of_prefixes(mine)))
            features = geometry.features(fleet, task, geometry.all_owners(actions))
        action_mask = th.ones(1, 1, instances.n_uavs, dtype=th.bool, device=actions.device)
        return AllocatorState(context, task, features), action_mask

    def evaluate_episodes(self, instances: Instances, actions: th.Tensor, cache: Cache | None = None) -> Any:
        evaluation = super().evaluate_episodes(instances, actions.clamp(min=0), cache)
        real = instances.task_mask[:, None]
        return type(evaluation)(*(field.masked_fill(~real, 0.0) for field in evaluation))

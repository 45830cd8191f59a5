"""The allocator: assigns every task, one after the other, to a UAV (paper, section IV-A2)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict
from torch import nn

from sb3_uav.envs.allocation import UNASSIGNED, AllocationProblem, allowed_uavs
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.sweep import sweep_order
from sb3_uav.policies.base import EpisodicPolicy
from sb3_uav.policies.encoder import feed_forward
from sb3_uav.policies.extractor import Cache, EpisodicExtractor
from sb3_uav.policies.fleet_geometry import FleetFeature, FleetGeometry, FleetState, WholeFleetFeature
from sb3_uav.policies.masked_policy import sample_actions
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.torch_state import float32_on_cpu, is_recorded

# Hidden size of the scorer.
_SCORER_DIM = 64
# Weights of the scorer before training: an untrained allocator assigns a task to the UAV that has its neighbors until that UAV
# has about its share of the tasks. Decoded greedily, this is about as good as a trained allocator.
_INITIAL_SCORE = {
    # Beyond 95 % of its share, every further percent makes a UAV e^0.6 times less likely: with 50 tasks per UAV, one task over
    # the share outweighs all votes.
    FleetFeature.OVERLOAD: -60.0,
    # A UAV that has all the neighbors is e^4 (about 50) times more likely than one that has none of them.
    FleetFeature.VOTES: 4.0,
    # Doubling the distance makes a UAV 2^0.5 times less likely: distance decides between UAVs with equal votes only.
    FleetFeature.RELATIVE_DISTANCE: -0.5,
}
# The same where UAVs differ.
_INITIAL_WHOLE_SCORE = {
    # A UAV for which the task is twice as far is 2^2 times less likely, and one that cannot reach it is out of the question.
    WholeFleetFeature.RELATIVE_SOLO: -2.0,
    WholeFleetFeature.TOO_FAR: -10.0,
}


@dataclass(frozen=True)
class AllocatorCache(Cache):
    """
    :param nodes: Node embeddings ``(batch, n_tasks + 1, embed_dim)``, the depot first
    :param scorer_nodes: ``(batch, n_tasks + 1, SCORER_DIM)``, their projections for the shared scorer; None without it
    :param geometry: Measures of the instances; None without ``geometry``
    """

    scorer_nodes: th.Tensor | None = None
    geometry: FleetGeometry | None = None


class AllocatorState(NamedTuple):
    """
    :param context: ``(batch, n_samples, n_uavs, embed_dim)``, element-wise maximum of the embeddings of the depot and of the
        UAV's tasks (paper, equation (15))
    :param task: ``(batch, n_samples)`` int64, the task to allocate
    :param features: ``(batch, n_samples, n_uavs, len(FleetFeature))``, fit of the task to each UAV; None without geometry
    """

    context: th.Tensor
    task: th.Tensor
    features: th.Tensor | None


class _SharedScorer(nn.Module):
    """
    Scores how well a task fits a UAV, with the same parameters for every UAV.

    :param embed_dim: Size of the embeddings
    :param geometry: Whether distances and loads are inputs
    :param whole: Whether what differs between UAVs and the values are inputs too
    """

    def __init__(self, embed_dim: int, geometry: bool, whole: bool = False) -> None:
        super().__init__()
        self.project_task = nn.Linear(embed_dim, _SCORER_DIM)
        self.project_uav = nn.Linear(embed_dim, _SCORER_DIM, bias=False)
        self.project_fleet = nn.Linear(embed_dim, _SCORER_DIM, bias=False)
        n_features = len(FleetFeature) + whole * len(WholeFleetFeature)
        self.project_features = nn.Linear(n_features, _SCORER_DIM, bias=False) if geometry else None
        self.hidden = nn.Sequential(nn.ReLU(), nn.Linear(_SCORER_DIM, _SCORER_DIM), nn.ReLU())
        self.score = nn.Linear(_SCORER_DIM, 1)
        self.direct = nn.Linear(n_features, 1, bias=False) if geometry else None
        if self.direct is not None:
            for parameter in (*self.direct.parameters(), *self.score.parameters()):
                nn.init.zeros_(parameter)
            with th.no_grad():
                for feature, weight in _INITIAL_SCORE.items():
                    self.direct.weight[0, feature] = weight
                if whole:
                    for difference, weight in _INITIAL_WHOLE_SCORE.items():
                        self.direct.weight[0, len(FleetFeature) + difference] = weight

    def forward(self, context: th.Tensor, task: th.Tensor, features: th.Tensor | None) -> th.Tensor:
        """
        :param context: ``(batch, n_samples, n_uavs, embed_dim)``
        :param task: ``(batch, n_samples, SCORER_DIM)``, a projected task
        :param features: ``(batch, n_samples, n_uavs, len(FleetFeature))``
        :return: ``(batch, n_samples, n_uavs)``
        """
        mixed = self.project_uav(context) + (task + self.project_fleet(context.mean(2)))[:, :, None]
        if features is None or self.project_features is None or self.direct is None:
            return self.score(self.hidden(mixed)).squeeze(-1)
        mixed = mixed + self.project_features(features)
        return (self.score(self.hidden(mixed)) + self.direct(features)).squeeze(-1)


class AllocatorExtractor(EpisodicExtractor):
    """
    Features = [task subset embedding, embedding of the current task] (paper, equations (15) to (17)).

    With ``net_arch=[]`` on top, SB3's action layer and the softmax are the paper's equation (18).
    With ``shared_scorer`` they are [score of every UAV, embedding of the current task], and the scores are the logits.

    :param observation_space: Observation space of a ``TaskAllocation`` environment
    :param settings: Fields of :class:`~sb3_uav.policies.settings.NetworkSettings`
    :raises TypeError: If there is no such setting
    :raises ValueError: If a setting or the observation space is not allowed
    """

    environment = "TaskAllocation"
    own_key = "assignment"

    @float32_on_cpu()
    def __init__(self, observation_space: spaces.Space, **settings: Any) -> None:
        network = NetworkSettings.of(settings)
        n_uavs, embed_dim = self.n_actions(observation_space), network.embed_dim
        super().__init__(observation_space, (n_uavs if network.shared_scorer else embed_dim) + embed_dim, network)
        self.geometry = network.geometry and network.shared_scorer
        self.n_uavs = None if network.shared_scorer else n_uavs
        if network.shared_scorer:
            self.context_dim = embed_dim
            self.scorer = _SharedScorer(embed_dim, network.geometry, network.whole)
        else:
            self.project_context = nn.Linear(n_uavs * embed_dim, embed_dim)
            self.feed_forward = feed_forward(embed_dim, network.ff_dim)

    def precompute(self, nodes: th.Tensor, static: StaticObservation) -> AllocatorCache:
        if self.n_uavs is not None:
            return AllocatorCache(nodes)
        geometry = FleetGeometry.of(static, self.whole) if self.geometry else None
        return AllocatorCache(nodes, self.scorer.project_task(nodes), geometry)

    def observed_state(self, cache: AllocatorCache, observation: TensorDict) -> AllocatorState:
        assignment, current_task = observation["assignment"], observation["current_task"].long().squeeze(-1)
        n_tasks = assignment.shape[-1]
        task, uavs = (
            current_task.clamp(max=n_tasks - 1),
            th.arange(observation["action_mask"].shape[-1], device=cache.nodes.device),
        )
        geometry, fleet, features = cache.geometry, None, None
        final = assignment.gather(1, current_task.argmax(1)[:, None, None].expand(-1, 1, n_tasks))
        decided = th.arange(n_tasks, device=assignment.device) < current_task[..., None]
        if assignment.shape[1] > 1 and (assignment == final.where(decided, UNASSIGNED)).all():
            # Steps of one episode share one running maximum.
            mine = final[..., None] == uavs
            context = _at_steps(self.running_context(cache, mine), current_task)
            if geometry is not None:
                fleet = FleetState(*(_at_steps(field, current_task) for field in geometry.of_prefixes(mine)))
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
        Context of every UAV before and after each step of complete episodes.

        :param cache: Encodings of ``batch`` instances
        :param mine: ``(batch, n_samples, n_tasks, n_uavs)`` bool, True where the task belongs to the UAV
        :return: ``(batch, n_samples, n_tasks + 1, n_uavs, embed_dim)``
        """
        depot, tasks = cache.nodes[:, None, :1, None], cache.nodes[:, None, 1:, None]
        first = depot.expand(-1, mine.shape[1], 1, mine.shape[3], -1)
        return th.cat([first, th.where(mine[..., None], tasks, depot)], dim=2).cummax(dim=2).values

    def initial_context(self, cache: Cache, n_samples: int, n_uavs: int) -> th.Tensor:
        """
        :param cache: Encodings of ``batch`` instances
        :param n_samples: Episodes per instance
        :param n_uavs: Size of the fleet
        :return: ``(batch, n_samples, n_uavs, embed_dim)``, the depot's embedding everywhere
        """
        depot = cache.nodes[:, 0]
        return depot[:, None, None].repeat(1, n_samples, n_uavs, 1)

    def decode(self, cache: AllocatorCache, state: AllocatorState) -> th.Tensor:
        node = (state.task + 1)[..., None]
        task_embedding = cache.nodes.gather(1, node.expand(-1, -1, cache.nodes.shape[-1]))
        if cache.scorer_nodes is not None:
            task = cache.scorer_nodes.gather(1, node.expand(-1, -1, _SCORER_DIM))
            return th.cat([self.scorer(state.context, task, state.features), task_embedding], dim=-1)
        subset_embedding = self.feed_forward(self.project_context(state.context.flatten(2)))
        return th.cat([subset_embedding, task_embedding], dim=-1)


def _at_steps(running: th.Tensor, steps: th.Tensor) -> th.Tensor:
    """
    :param running: ``(batch, 1, n_steps, ...)``, a quantity at every step of an episode
    :param steps: ``(batch, n_samples)`` int64
    :return: ``(batch, n_samples, ...)``, the quantity at these steps
    """
    index = steps.view(*steps.shape, *[1] * (running.dim() - 3)).expand(-1, -1, *running.shape[3:])
    return running[:, 0].gather(1, index)


class AllocatorPolicy(EpisodicPolicy):
    """
    The upper level's policy. See :class:`~sb3_uav.policies.masked_policy.MaskedPolicy` for the arguments.

    It takes any number of tasks and, with ``shared_scorer``, of UAVs; the paper's decoder is bound to one fleet size.
    """

    level = "allocator"
    extractor_class: ClassVar[type[AllocatorExtractor]] = AllocatorExtractor
    required_extractor_class = AllocatorExtractor
    features_extractor: AllocatorExtractor
    _order_is_checked = False

    @classmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        problem = AllocationProblem(UniformGenerator(n_tasks=1, n_uavs=n_actions or 1))
        return problem.observation_space, problem.action_space

    @property
    def n_uavs(self) -> int | None:
        """The fleet size the network was built for; None if it works for any."""
        return self.features_extractor.n_uavs

    @property
    def sweep(self) -> bool:
        """Whether tasks are allocated in the order of a sweep around the depot."""
        return self.settings.sweep

    @property
    def env_order(self) -> str:
        """The ``task_order`` an environment should have for this policy."""
        return "sweep" if self.sweep else "input"

    def _decode_observation(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        if self.sweep and not self._order_is_checked and not is_recorded():
            self._order_is_checked = True
            assert isinstance(obs, dict)
            self._check_order(StaticObservation.from_observation(obs))
        return super()._decode_observation(obs)

    def _check_order(self, static: StaticObservation) -> None:
        """Warn if the tasks of the first observations are not in the order of a sweep."""
        n_uavs = 1 if static.start is None else static.start.shape[1]
        shown = static.depot, static.tasks, static.values, static.max_distance[:, 0], n_uavs, static.task_mask
        order = sweep_order(Instances(*shown, start=static.start, end=static.end))
        # Rounding of the observations may swap a few tasks.
        if (order == th.arange(order.shape[1], device=order.device)).float().mean() < 0.5:
            warnings.warn(
                "This AllocatorPolicy expects the tasks in the order of a sweep around the depot, but the environment shows "
                'them in another order, which makes schedules worse: create the environment with task_order="sweep", or the '
                "policy with sweep=False.",
                stacklevel=4,
            )

    def task_order(self, instances: Instances, variant: int = 0) -> th.Tensor:
        if not self.sweep:
            return super().task_order(instances)
        return sweep_order(instances, gap=variant // 2, clockwise=variant % 2 == 1)

    @th.no_grad()
    def encode_nodes(self, instances: Instances) -> th.Tensor:
        """
        Encode instances that are to be shown in several orders, see :meth:`arranged_cache`, in evaluation mode.

        :param instances: ``batch`` instances on the device of the policy
        :return: Node embeddings ``(batch, n_tasks + 1, embed_dim)``
        :raises ValueError: If they go beyond what the network sees
        """
        self.check_problem(instances)
        self.set_training_mode(False)
        return self.features_extractor.encode_nodes(StaticObservation.from_instances(instances))

    @th.no_grad()
    def arranged_cache(self, nodes: th.Tensor, order: th.Tensor, arranged: Instances) -> Cache:
        """
        The encodings of instances whose tasks were put into another order, without encoding them again: the encoder treats
        all tasks alike. Equal to :meth:`encode` but for rounding.

        :param nodes: ``(batch, n_tasks + 1, embed_dim)``, from :meth:`encode_nodes`
        :param order: ``(batch, n_tasks)`` int64, which task stands in each place
        :param arranged: The instances in this order
        :return: Their encodings
        """
        index = nn.functional.pad(order + 1, (1, 0))[..., None].expand(-1, -1, nodes.shape[-1])
        return self.features_extractor.precompute(nodes.gather(1, index), StaticObservation.from_instances(arranged))

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
        self, instances: Instances, cache: AllocatorCache, n_samples: int, deterministic: bool, generator: th.Generator | None
    ) -> th.Tensor:
        self.check_fleet(instances)
        n_uavs, n_tasks = instances.n_uavs, instances.n_tasks
        context = self.features_extractor.initial_context(cache, n_samples, n_uavs)
        batch_size, embed_dim = len(instances), cache.nodes.shape[-1]
        geometry = cache.geometry
        fleet = None if geometry is None else geometry.initial(n_samples, n_uavs)
        uavs = th.arange(n_uavs, device=instances.device)
        allowed = allowed_uavs(instances)
        actions = th.full((batch_size, n_samples, n_tasks), UNASSIGNED, device=instances.device)
        for step in range(n_tasks):
            task = th.full((batch_size, n_samples), step, device=instances.device)
            features = None
            if geometry is not None and fleet is not None:
                features = geometry.features(fleet, task, geometry.owners(task, actions))
            logits, _ = self.decode_step(cache, AllocatorState(context, task, features))
            if allowed is not None:
                logits = logits.masked_fill(~allowed[:, None, step], -th.inf)
            action = sample_actions(logits, deterministic, generator)
            actions[..., step] = action
            chosen = action[..., None, None].expand(-1, -1, 1, embed_dim)
            grown = th.maximum(context.gather(2, chosen), cache.nodes[:, step + 1][:, None, None])
            context.scatter_(2, chosen, grown)
            if geometry is not None and fleet is not None:
                fleet = geometry.add(fleet, step, action[..., None] == uavs)
        return actions.masked_fill(~instances.task_mask[:, None], UNASSIGNED)

    def _episode_states(
        self, instances: Instances, cache: AllocatorCache, actions: th.Tensor
    ) -> tuple[AllocatorState, th.Tensor]:
        self.check_fleet(instances)
        batch_size, n_samples, n_tasks = actions.shape
        mine = actions[..., None] == th.arange(instances.n_uavs, device=actions.device)
        context = self.features_extractor.running_context(cache, mine)[:, :, :-1].flatten(1, 2)
        task = th.arange(n_tasks, device=actions.device).expand(batch_size, n_samples, n_tasks).flatten(1)
        geometry = cache.geometry
        features = None
        if geometry is not None:
            fleet = FleetState(*(field[:, :, :-1].flatten(1, 2) for field in geometry.of_prefixes(mine)))
            features = geometry.features(fleet, task, geometry.all_owners(actions))
        allowed = allowed_uavs(instances)
        if allowed is None:
            action_mask = th.ones(1, 1, instances.n_uavs, dtype=th.bool, device=actions.device)
        else:
            action_mask = allowed.repeat(1, n_samples, 1)
        return AllocatorState(context, task, features), action_mask

    def evaluate_episodes(self, instances: Instances, actions: th.Tensor, cache: Cache | None = None) -> Any:
        evaluation = super().evaluate_episodes(instances, actions.clamp(min=0), cache)
        real = instances.task_mask[:, None]
        return type(evaluation)(*(field.masked_fill(~real, 0.0) for field in evaluation))

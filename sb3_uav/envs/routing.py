"""Route planning (the paper's lower level): one UAV visits tasks until none fits into its remaining flight distance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional

from sb3_uav.envs.customization import is_drawable, make_reward, make_source, try_reward
from sb3_uav.envs.distances import distance_limit, euclidean
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Dynamics, Problem, Stage
from sb3_uav.envs.rewards import Reward, TourState, at_the_end, score_tours

DEPOT = 0

# Plans one tour per row: Instances -> (batch, n_steps) int64 node indices, task j being node j + 1; DEPOT at the end and as
# padding.
Router = Callable[[Instances], th.Tensor]
RouterT = TypeVar("RouterT", bound=Callable[..., th.Tensor])


def deterministic(router: RouterT) -> RouterT:
    """
    Mark a router that plans equal rows alike, so that of equal subsets only one is planned.

    :param router: The router
    :return: The same
    """
    router.is_deterministic = True  # type: ignore[attr-defined]
    return router


def is_deterministic(router: Router) -> bool:
    """
    :param router: Any router
    :return: Whether it is marked as one that plans equal rows alike
    """
    return bool(getattr(router, "is_deterministic", False))


class RoutingState(NamedTuple):
    """
    :param position: ``(batch, n_samples)`` int64, the node where the UAV is: 0 the depot, j + 1 task j
    :param visited: ``(batch, n_samples, n_tasks)`` bool
    :param traveled: ``(batch, n_samples)`` float64, distance flown so far
    :param done: ``(batch, n_samples)`` bool, True after the return to the depot
    :param action_mask: ``(batch, n_samples, n_tasks + 1)`` bool
    """

    position: th.Tensor
    visited: th.Tensor
    traveled: th.Tensor
    done: th.Tensor
    action_mask: th.Tensor


class RoutingDynamics(Dynamics):
    """
    Transitions of route planning (paper, section IV-B).

    A task is legal if it is unvisited and the UAV can fly to it, serve it and fly on to its end: traveled + d(here, task) +
    service + d(task, end) <= D. The depot (node 0: the start, and as an action the flight to the end) is legal only when no
    task is, because an early return never helps. An illegal action sends the UAV to its end and ends the episode.

    :param instances: The instances; each row is the tasks of one UAV, the first of its fleet
    """

    def __init__(self, instances: Instances) -> None:
        super().__init__(instances)
        start, end = instances.uav_start[:, :1], instances.uav_end[:, :1]
        self.nodes = th.cat([start, instances.tasks], dim=1)
        self.home = euclidean(self.nodes, end)
        self.max_distance = instances.uav_distance[:, 0]
        self.limit = distance_limit(self.max_distance)
        self.service = None if instances.service is None else functional.pad(instances.service, (1, 0))
        # From each node: what is left to do once the UAV is there.
        self.homeward = self.home if self.service is None else self.home + self.service
        self._rows = th.arange(len(instances), device=instances.device)[:, None]

    def points(self, nodes: th.Tensor) -> th.Tensor:
        """
        :param nodes: ``(batch, n_samples)`` int64, nodes of each instance
        :return: ``(batch, n_samples, 2)`` float64, their coordinates
        """
        return self.nodes[self._rows, nodes]

    def reset(self, n_samples: int = 1) -> RoutingState:
        shape = (len(self.instances), n_samples)
        device = self.instances.device
        position = th.zeros(shape, dtype=th.int64, device=device)
        visited = ~self.instances.task_mask[:, None].expand(-1, n_samples, -1)
        traveled = th.zeros(shape, dtype=th.float64, device=device)
        done = th.zeros(shape, dtype=th.bool, device=device)
        return RoutingState(position, visited, traveled, done, self._action_mask(position, visited, traveled, done))

    def _action_mask(self, position: th.Tensor, visited: th.Tensor, traveled: th.Tensor, done: th.Tensor) -> th.Tensor:
        here = self.points(position)
        detour = euclidean(self.nodes[:, None, 1:], here[:, :, None]) + self.homeward[:, None, 1:]
        feasible = ~visited & (traveled[..., None] + detour <= self.limit[:, None, None]) & ~done[..., None]
        return th.cat([~feasible.any(-1, keepdim=True), feasible], dim=-1)

    def step(self, state: RoutingState, actions: th.Tensor) -> tuple[RoutingState, th.Tensor]:
        legal = state.action_mask.gather(-1, actions[..., None]).squeeze(-1)
        node = th.where(legal, actions, DEPOT)
        goes_home = (node == DEPOT) & ~state.done
        leg = euclidean(self.points(node), self.points(state.position))
        leg = th.where(node == DEPOT, self.home.gather(1, state.position), leg)
        if self.service is not None:
            leg = leg + self.service.gather(1, node)
        # A finished UAV stays where it is.
        traveled = state.traveled + leg.masked_fill(state.done, 0.0)
        # The extra first column absorbs visits to the depot.
        visited = th.cat([th.zeros_like(state.visited[..., :1]), state.visited], dim=-1)
        visited = visited.scatter(-1, node[..., None], True)[..., 1:]
        done = state.done | goes_home
        rewards = functional.pad(self.instances.prizes, (1, 0)).gather(1, node)
        return RoutingState(node, visited, traveled, done, self._action_mask(node, visited, traveled, done)), rewards


class _ScoredDynamics(RoutingDynamics):
    """
    The same transitions with a reward of the user, given at the end of the episode.

    :param instances: The instances
    :param reward: The user's reward
    """

    def __init__(self, instances: Instances, reward: Reward) -> None:
        super().__init__(instances)
        self.reward = reward

    def reset(self, n_samples: int = 1) -> Any:
        shape = (len(self.instances), n_samples, self.instances.n_tasks + 1)
        tour = th.full(shape, DEPOT - 1, dtype=th.int64, device=self.instances.device)
        return TourState(*super().reset(n_samples), tour)

    def step(self, state: Any, actions: th.Tensor) -> tuple[Any, th.Tensor]:
        after, _ = super().step(RoutingState(*state[:-1]), actions)
        # The depot is written too, as padding.
        slot = (state.tour >= 0).sum(-1, keepdim=True)
        tour = state.tour.scatter(-1, slot, after.position[..., None] - 1)
        finished = after.done & ~state.done
        rewards = th.zeros(finished.shape, dtype=th.float64, device=finished.device)
        rows = finished.any(1)
        if rows.any():
            value = score_tours(self.reward, self.instances[rows], tour[rows][:, :, None])
            rewards[rows] = value.where(finished[rows], 0.0)
        return TourState(*after, tour), rewards


@deterministic
def nearest_feasible(instances: Instances) -> th.Tensor:
    """
    Always fly to the nearest task that is still feasible; the default router of allocation environments.

    :param instances: ``batch`` instances, one tour each
    :return: ``(batch, n_steps)`` int64 node indices, padded with the depot
    """
    dynamics = RoutingDynamics(instances)
    state = dynamics.reset()
    tours = []
    while not state.done.all():
        here = dynamics.points(state.position)
        distance = euclidean(dynamics.nodes[:, None], here[:, :, None])
        action = distance.masked_fill(~state.action_mask, th.inf).argmin(-1)
        tours.append(action)
        state, _ = dynamics.step(state, action)
    return th.cat(tours, dim=1) if tours else state.position


def collected_value(instances: Instances, tours: th.Tensor) -> th.Tensor:
    """
    Total value of the tasks of each tour, see :attr:`~sb3_uav.envs.instances.Instances.prizes`.

    :param instances: ``batch`` instances
    :param tours: ``(batch, ..., n_steps)`` int64 node indices without repeated tasks, padded with the depot
    :return: ``(batch, ...)`` float64
    """
    prizes = functional.pad(instances.prizes, (1, 0))
    return prizes.gather(1, tours.flatten(1)).view(tours.shape).sum(-1)


class RoutingProblem(Problem):
    """
    Route planning: one task (or the depot) is chosen per step; the reward is the value of the task visited.

    :param generator: Draws the instances
    :param reward: Values complete tours in place of that, at the end of the episode
    """

    running_stage = Stage.FLYING
    uses_fleet = False

    def _action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.generator.n_tasks + 1)

    def _dynamic_spaces(self) -> dict[str, spaces.Space]:
        n_tasks = self.generator.n_tasks
        return {
            "position": spaces.Box(0, n_tasks, (1,), np.float32),
            "remaining_distance": spaces.Box(-np.inf, np.inf, (1,), np.float32),
            "visited": spaces.MultiBinary(n_tasks),
            "action_mask": spaces.MultiBinary(n_tasks + 1),
        }

    def dynamics(self, instances: Instances) -> RoutingDynamics:
        return RoutingDynamics(instances) if self.reward is None else _ScoredDynamics(instances, self.reward)

    def observe(self, dynamics: RoutingDynamics, state: RoutingState) -> dict[str, th.Tensor]:
        remaining = dynamics.max_distance[:, None] - state.traveled
        return {
            "position": state.position,
            "remaining_distance": remaining,
            "visited": state.visited[:, 0] & dynamics.instances.task_mask,
            "action_mask": state.action_mask[:, 0],
        }

    def returns(self, instances: Instances, actions: th.Tensor) -> th.Tensor:
        if self.reward is not None:
            return score_tours(self.reward, instances, actions[:, :, None] - 1)
        return collected_value(instances, actions)

    def step_rewards(self, instances: Instances, actions: th.Tensor, returns: th.Tensor) -> th.Tensor:
        if self.reward is not None:
            return at_the_end(returns, self.lengths(instances, actions), actions.shape[-1])
        return collected_value(instances, actions[..., None])

    def lengths(self, instances: Instances, actions: th.Tensor) -> th.Tensor:
        return (actions != DEPOT).sum(-1) + 1

    def routes(self, instance: Instances, actions: list[int]) -> list[list[int]]:
        return [[node - 1 for node in actions if node != DEPOT]]


class RoutePlanningEnv(ProblemEnv):
    """
    Route planning of one UAV as a Gymnasium environment (``RoutePlanning-N{N}-v0``, ``RoutePlanning-v0``).

    What is given by a dotted path, as in a YAML, is described in :mod:`sb3_uav.envs.customization`, and tried out here.

    :param n_tasks: Number of tasks
    :param max_distance: Maximum flight distance
    :param distribution: ``"uniform"``, ``"clustered"``, ``"mixture"``, ``"world"``, or a function of the user
    :param instances: Path of an ``.npz`` file, or ``Instances``, to draw from instead
    :param generator: Any other source of instances, or what makes it
    :param render_mode: ``"human"``, ``"rgb_array"`` or None
    :param reward: Values complete tours, in place of the value of the tasks on them
    :raises ValueError: If an argument cannot be used; the message names it, its value and what to do
    """

    def __init__(
        self,
        n_tasks: int = 20,
        max_distance: float = 2.0,
        distribution: Any = "uniform",
        instances: Any = None,
        generator: Any = None,
        render_mode: str | None = None,
        reward: Any = None,
    ) -> None:
        source = make_source(n_tasks, 1, max_distance, distribution, instances, generator)
        problem = RoutingProblem(source, make_reward(reward))
        if problem.reward is not None and is_drawable(generator, source):
            try_reward(reward, lambda drawn: problem.returns(drawn, nearest_feasible(drawn)[:, None]), source)
        super().__init__(problem, render_mode)

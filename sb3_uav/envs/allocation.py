"""Task allocation (the paper's upper level): each step assigns one task to a UAV."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_uav.common.equal_rows import equal_rows
from sb3_uav.envs.customization import is_drawable, make_reward, make_router, make_source, try_reward, try_router
from sb3_uav.envs.generators import InstanceGenerator
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Dynamics, Problem, Stage
from sb3_uav.envs.rewards import Reward, at_the_end, score_tours
from sb3_uav.envs.routing import DEPOT, Router, collected_value, is_deterministic, nearest_feasible
from sb3_uav.envs.schedule import Schedule
from sb3_uav.envs.sweep import sweep_order

UNASSIGNED = -1
_TASK_ORDERS = ("input", "sweep")


class AllocationState(NamedTuple):
    """
    :param assignment: ``(batch, n_samples, n_tasks)`` int64, the UAV of each task; ``UNASSIGNED`` if it has none yet
    :param task: ``(batch, n_samples)`` int64, index of the task to allocate next
    :param done: ``(batch, n_samples)`` bool, True when every real task has a UAV
    :param action_mask: ``(batch, n_samples, n_uavs)`` bool, see :func:`allowed_uavs`
    """

    assignment: th.Tensor
    task: th.Tensor
    done: th.Tensor
    action_mask: th.Tensor


def allowed_uavs(instances: Instances) -> th.Tensor | None:
    """
    :param instances: ``batch`` instances
    :return: Which UAVs may take each task: where UAVs differ, those that could serve it alone, or all if none could;
        ``(batch, n_tasks, n_uavs)`` bool. None where any UAV may take any task
    """
    if instances.has_equal_uavs:
        return None
    reach = instances.reachable_by_uav().transpose(1, 2)
    return reach | ~reach.any(-1, keepdim=True)


class AllocationDynamics(Dynamics):
    """
    Transitions of task allocation (paper, section IV-A1).

    The only reward, at the end, is the total value of the tasks on the router's tours.

    :param instances: The instances
    :param router: Plans the tours of the reward
    :param reward: Values the tours instead
    """

    def __init__(self, instances: Instances, router: Router, reward: Reward | None = None) -> None:
        super().__init__(instances)
        self.router = router
        self.reward = reward
        self._n_real = instances.task_mask.sum(1)[:, None]
        self._allowed = allowed_uavs(instances)

    def reset(self, n_samples: int = 1) -> AllocationState:
        batch_size, n_tasks = self.instances.task_mask.shape
        device = self.instances.device
        task = th.zeros(batch_size, n_samples, dtype=th.int64, device=device)
        return AllocationState(
            assignment=th.full((batch_size, n_samples, n_tasks), UNASSIGNED, dtype=th.int64, device=device),
            task=task,
            done=task >= self._n_real,
            action_mask=self._action_mask(task),
        )

    def _action_mask(self, task: th.Tensor) -> th.Tensor:
        """
        :param task: ``(batch, n_samples)`` int64, the task to allocate
        :return: ``(batch, n_samples, n_uavs)`` bool
        """
        shape = (*task.shape, self.instances.n_uavs)
        if self._allowed is None:
            # Expanded, as the fleet may be absurdly large.
            return th.ones(1, dtype=th.bool, device=task.device).expand(shape)
        slot = task.clamp(max=self.instances.n_tasks - 1)[..., None]
        return self._allowed.gather(1, slot.expand(shape))

    def step(self, state: AllocationState, actions: th.Tensor) -> tuple[AllocationState, th.Tensor]:
        active = ~state.done
        slot = state.task.clamp(max=self.instances.n_tasks - 1)[..., None]
        chosen = th.where(active, actions, state.assignment.gather(-1, slot).squeeze(-1))
        assignment = state.assignment.scatter(-1, slot, chosen[..., None])
        task = state.task + active
        done = task >= self._n_real
        finished = done & active
        rewards = th.zeros(finished.shape, dtype=th.float64, device=finished.device)
        rows = finished.any(1)
        if rows.any():
            value = _planned_value(self.instances[rows], assignment[rows], self.router, self.reward)
            rewards[rows] = value.where(finished[rows], 0.0)
        action_mask = state.action_mask if self._allowed is None else self._action_mask(task)
        return AllocationState(assignment, task, done, action_mask), rewards


class Subsets(NamedTuple):
    """
    :param instances: ``batch * n_samples * n_uavs`` single-UAV instances, one per UAV of each allocation
    :param task_index: ``(batch * n_samples * n_uavs, n_slots)`` int64, the task of the original instance in each slot
    """

    instances: Instances
    task_index: th.Tensor


def split_tasks(instances: Instances, assignment: th.Tensor) -> Subsets:
    """
    Split instances into one compact single-UAV instance per UAV, keeping the order of the tasks.

    Their values are the :attr:`~sb3_uav.envs.instances.Instances.prizes` of the whole, so that they can be added up.

    :param instances: ``batch`` instances
    :param assignment: ``(batch, n_samples, n_tasks)`` int64; tasks with ``UNASSIGNED`` and padded tasks are left out
    :return: The subsets, ordered by (instance, sample, UAV), padded to the largest
    """
    batch_size, n_samples, n_tasks = assignment.shape
    n_uavs = instances.n_uavs
    left_out = (assignment == UNASSIGNED) | ~instances.task_mask[:, None]
    key = assignment.masked_fill(left_out, n_uavs)
    order = key.argsort(dim=-1, stable=True)
    counts = th.zeros(batch_size, n_samples, n_uavs + 1, dtype=th.int64, device=key.device)
    counts = counts.scatter_add(-1, key, th.ones_like(key))[..., :n_uavs]
    n_slots = max(int(counts.max()), 1) if len(instances) > 0 else 1
    slots = th.arange(n_slots, device=key.device)
    start = counts.cumsum(-1) - counts
    position = (start[..., None] + slots).clamp(max=n_tasks - 1)
    task_index = order.gather(-1, position.flatten(2)).flatten(1)
    task_mask = (slots < counts[..., None]).view(-1, n_slots)

    def per_uav(field: th.Tensor) -> th.Tensor:
        return field[:, None].expand(-1, n_samples, *field.shape[1:]).flatten(0, 2)

    def per_task(field: th.Tensor) -> th.Tensor:
        return field.gather(1, task_index).view(-1, n_slots)

    subsets = Instances(
        depot=instances.depot.repeat_interleave(n_samples * n_uavs, dim=0),
        tasks=instances.tasks.gather(1, task_index[..., None].expand(-1, -1, 2)).view(-1, n_slots, 2),
        values=per_task(instances.prizes),
        max_distance=per_uav(instances.uav_distance),
        n_uavs=1,
        task_mask=task_mask,
        start=None if instances.start is None else per_uav(instances.start)[:, None],
        end=None if instances.end is None else per_uav(instances.end)[:, None],
        service=None if instances.service is None else per_task(instances.service),
    )
    return Subsets(subsets, task_index.view(-1, n_slots))


class PlannedTours(NamedTuple):
    """
    :param tours: ``(batch, n_samples, n_uavs, n_steps)`` int64, tasks of the original instance, -1 as padding
    :param value: ``(batch, n_samples)`` float64, total value of the visited tasks
    """

    tours: th.Tensor
    value: th.Tensor


def plan_tours(instances: Instances, assignment: th.Tensor, router: Router, copy_of: th.Tensor | None = None) -> PlannedTours:
    """
    Plan every UAV's tour over its assigned tasks with a router.

    Where several samples give a UAV the same tasks, a router that is marked as
    :func:`~sb3_uav.envs.routing.deterministic` plans one tour for all of them.

    :param instances: ``batch`` instances
    :param assignment: ``(batch, n_samples, n_tasks)`` int64
    :param router: Plans one tour per row
    :param copy_of: ``(batch,)`` int64, equal for rows that hold the same instance; they are all different when None
    :return: The tours and the value that they collect
    """
    shape = (*assignment.shape[:2], instances.n_uavs)
    subsets = split_tasks(instances, assignment)
    kind = None
    if is_deterministic(router):
        if copy_of is None:
            copy_of = th.arange(len(instances), device=assignment.device)
        rows, kind = equal_rows(_contents(instances, subsets, copy_of, shape[1]))
        if len(rows) < len(kind):
            subsets = Subsets(subsets.instances[rows], subsets.task_index[rows])
        else:
            kind = None
    nodes = router(subsets.instances).to(assignment.device)
    value = collected_value(subsets.instances, nodes)
    tours = subsets.task_index.gather(1, (nodes - 1).clamp(min=0)).masked_fill(nodes == DEPOT, -1)
    if kind is not None:
        value, tours = value[kind], tours[kind]
    return PlannedTours(tours.view(*shape, nodes.shape[1]), value.view(shape).sum(-1))


def _contents(instances: Instances, subsets: Subsets, copy_of: th.Tensor, n_samples: int) -> th.Tensor:
    """
    :param instances: ``batch`` instances
    :param subsets: Their subsets
    :param copy_of: ``(batch,)`` int64, which instance each row holds
    :param n_samples: Allocations per instance
    :return: ``(batch * n_samples * n_uavs, n_columns)`` int64, equal for subsets that a router cannot tell apart
    """
    tasks = subsets.task_index.masked_fill(~subsets.instances.task_mask, -1)
    n_uavs = instances.n_uavs
    uav = th.arange(n_uavs, device=tasks.device) * (not instances.has_equal_uavs)
    owner = th.stack([copy_of.repeat_interleave(n_samples * n_uavs), uav.repeat(len(instances) * n_samples)], dim=1)
    return th.cat([owner, tasks], dim=1)


def _useful_allocation(instances: Instances, assignment: th.Tensor) -> tuple[Instances, th.Tensor]:
    """
    Remove UAVs that cannot have a task, so that an absurdly large fleet takes no memory.

    :param instances: ``batch`` instances
    :param assignment: ``(batch, n_samples, n_tasks)`` int64
    :return: Both unchanged if there are at most as many UAVs as tasks. Otherwise the instances with one UAV per task, and the
        assignment with the UAVs that have tasks renumbered from 0 in the same order
    """
    if instances.n_uavs == instances.useful_fleet:
        return instances, assignment
    left_out = (assignment == UNASSIGNED) | ~instances.task_mask[:, None]
    sorted_uavs, order = assignment.masked_fill(left_out, instances.n_uavs).sort(dim=-1)
    number = th.zeros_like(assignment)
    number[..., 1:] = (sorted_uavs[..., 1:] != sorted_uavs[..., :-1]).cumsum(-1)
    numbered = number.scatter(-1, order, number).masked_fill(left_out, UNASSIGNED)
    return instances.with_fleet(instances.useful_fleet), numbered


def _planned_value(instances: Instances, assignment: th.Tensor, router: Router, reward: Reward | None = None) -> th.Tensor:
    """
    :param instances: ``batch`` instances
    :param assignment: ``(batch, n_samples, n_tasks)`` int64
    :param router: Plans one tour per row
    :param reward: Values the tours; the total value of the tasks on them when None
    :return: ``(batch, n_samples)`` float64
    """
    if reward is not None:
        # It may depend on which UAV flies a tour, and on how many there are.
        return score_tours(reward, instances, plan_tours(instances, assignment, router).tours)
    return plan_tours(*_useful_allocation(instances, assignment), router).value


def _alternating(instances: Instances) -> th.Tensor:
    """
    :param instances: ``batch`` instances
    :return: ``(batch, 1, n_tasks)`` int64, an allocation to try things out: all tasks to the first UAV in even rows, to all in
        turn in odd ones
    """
    in_turn = th.arange(instances.n_tasks, device=instances.device) % instances.useful_fleet
    odd = th.arange(len(instances), device=instances.device)[:, None, None] % 2
    return (in_turn * odd).contiguous()


def _subsets_to_try(instances: Instances) -> Instances:
    """:return: The single-UAV instances of that allocation, some of them without tasks"""
    return split_tasks(*_useful_allocation(instances, _alternating(instances))).instances


def schedules(tours: th.Tensor) -> list[Schedule]:
    """
    :param tours: ``(batch, n_uavs, n_steps)`` int64, tasks from 0, -1 as padding
    :return: One schedule per row
    """
    return [Schedule([[task for task in tour if task >= 0] for tour in row]) for row in tours.tolist()]


class _CurrentRouter:
    """
    The router of a problem, looked up at every call, so that one set during an episode takes effect.

    :param problem: The problem
    """

    def __init__(self, problem: AllocationProblem) -> None:
        self.problem = problem

    @property
    def is_deterministic(self) -> bool:
        return is_deterministic(self.problem.router)

    def __call__(self, subsets: Instances) -> th.Tensor:
        return self.problem.router(subsets)


class AllocationProblem(Problem):
    """
    Task allocation: each step assigns one task to a UAV; the reward comes at the end.

    :param generator: Draws the instances
    :param router: Plans the tours of the reward; nearest feasible task when None
    :param task_order: ``"input"``, or ``"sweep"`` to present the tasks in the order of a sweep around the depot
    :param reward: Values complete schedules, in place of the total value of the tasks on their tours
    :raises ValueError: If the order is unknown
    """

    running_stage = Stage.ASSIGNING

    def __init__(
        self,
        generator: InstanceGenerator,
        router: Router | None = None,
        task_order: str = "input",
        reward: Reward | None = None,
    ) -> None:
        super().__init__(generator, reward)
        self.router: Router = router or nearest_feasible
        self.task_order = task_order

    @property
    def task_order(self) -> str:
        """The order in which the tasks are presented."""
        return self._task_order

    @task_order.setter
    def task_order(self, task_order: str) -> None:
        if task_order not in _TASK_ORDERS:
            raise ValueError(f"task_order is {task_order!r}; choose one of {_TASK_ORDERS}.")
        self._task_order = task_order

    def arrange(self, instances: Instances) -> Instances:
        return instances.reorder(sweep_order(instances)) if self.task_order == "sweep" else instances

    def _action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.generator.n_uavs)

    def _dynamic_spaces(self) -> dict[str, spaces.Space]:
        n_tasks, n_uavs = self.generator.n_tasks, self.generator.n_uavs
        return {
            "assignment": spaces.Box(UNASSIGNED, n_uavs - 1, (n_tasks,), np.float32),
            "current_task": spaces.Box(0, n_tasks, (1,), np.float32),
            "action_mask": spaces.MultiBinary(n_uavs),
        }

    def dynamics(self, instances: Instances) -> AllocationDynamics:
        return AllocationDynamics(instances, _CurrentRouter(self), self.reward)

    def observe(self, dynamics: AllocationDynamics, state: AllocationState) -> dict[str, th.Tensor]:
        return {
            "assignment": state.assignment[:, 0],
            "current_task": state.task,
            "action_mask": state.action_mask[:, 0],
        }

    def returns(self, instances: Instances, actions: th.Tensor) -> th.Tensor:
        return _planned_value(instances, actions, self.router, self.reward)

    def step_rewards(self, instances: Instances, actions: th.Tensor, returns: th.Tensor) -> th.Tensor:
        return at_the_end(returns, self.lengths(instances, actions), actions.shape[-1])

    def lengths(self, instances: Instances, actions: th.Tensor) -> th.Tensor:
        # An instance without tasks ends only after a first step that does nothing.
        return instances.task_mask.sum(1).clamp(min=1)[:, None].expand(actions.shape[:2])

    def routes(self, instance: Instances, actions: list[int]) -> list[list[int]]:
        assignment = np.full((1, 1, instance.n_tasks), UNASSIGNED)
        assignment[0, 0, : len(actions)] = actions
        instance, allocation = _useful_allocation(instance, th.from_numpy(assignment))
        # There are no tours before the end: these are the tasks of each UAV, in the order of their assignment.
        if len(actions) < int(instance.task_mask.sum()):
            uavs = allocation[0, 0].tolist()
            return [[task for task, uav in enumerate(uavs) if uav == v] for v in range(instance.n_uavs)]
        planned = plan_tours(instance, allocation, self.router)
        return [list(route) for route in schedules(planned.tours[:, 0])[0].routes]


class TaskAllocationEnv(ProblemEnv):
    """
    Task allocation as a Gymnasium environment (``TaskAllocation-U{V}-N{N}-v0``, ``TaskAllocation-v0``).

    What is given by a dotted path, as in a YAML, is described in :mod:`sb3_uav.envs.customization`, and tried out here.

    :param n_tasks: Number of tasks
    :param n_uavs: Number of UAVs
    :param max_distance: Maximum flight distance
    :param distribution: ``"uniform"``, ``"clustered"``, ``"mixture"``, ``"world"``, or a function of the user
    :param instances: Path of an ``.npz`` file, or ``Instances``, to draw from instead
    :param generator: Any other source of instances, or what makes it
    :param router: Plans the tours of the reward: a function, a zip, or the name of a trained pair; nearest feasible task when
        None. Callbacks that train or load a router replace it
    :param task_order: ``"input"``, or ``"sweep"`` to present the tasks in the order of a sweep around the depot, which
        allocators with ``sweep`` expect
    :param render_mode: ``"human"``, ``"rgb_array"`` or None
    :param reward: Values complete schedules, in place of the total value of the tasks on their tours
    :raises ValueError: If an argument cannot be used; the message names it, its value and what to do
    """

    problem: AllocationProblem

    def __init__(
        self,
        n_tasks: int = 20,
        n_uavs: int = 4,
        max_distance: float = 2.0,
        distribution: Any = "uniform",
        instances: Any = None,
        generator: Any = None,
        router: Any = None,
        task_order: str = "input",
        render_mode: str | None = None,
        reward: Any = None,
    ) -> None:
        source = make_source(n_tasks, n_uavs, max_distance, distribution, instances, generator)
        planner = make_router(router)
        problem = AllocationProblem(source, planner, task_order, make_reward(reward))
        can_try = is_drawable(generator, source)
        if planner is not None and can_try:
            try_router(router, planner, _subsets_to_try, source)
        if problem.reward is not None and can_try:
            try_reward(reward, lambda drawn: problem.returns(drawn, _alternating(drawn)), source)
        super().__init__(problem, render_mode)

    def set_router(self, router: Router) -> None:
        """Use another router, starting with the next reward."""
        self.problem.router = router

    def set_task_order(self, task_order: str) -> None:
        """Present the tasks of the next episodes in another order."""
        self.problem.task_order = task_order

"""The zip of any SB3 algorithm as a solver: it plays the step loop of the environment that it was trained on."""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import BasePolicy

from sb3_uav.common.files import file_hash
from sb3_uav.envs.allocation import AllocationProblem, plan_tours, schedules
from sb3_uav.envs.episodes import Episodes
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.envs.routing import Router, RoutingProblem, nearest_feasible
from sb3_uav.envs.schedule import Schedule
from sb3_uav.envs.sweep import sweep_order
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import NotOurPolicyError, StoredPolicy, load_policy, read_policy
from sb3_uav.policies.memory import rows_that_fit
from sb3_uav.pretrained import router_file
from sb3_uav.reinforce.algorithms import resolve_algorithm
from sb3_uav.reinforce.any_size import problem_of_spaces
from sb3_uav.solvers.kmeans_am import kmeans_assignment
from sb3_uav.solvers.network_solver import BatchedSolver, parameters_hash

_NEAREST = "nearest task"
# What SB3's load raises for the zip of another algorithm.
_WRONG_ALGORITHM = (
    *(ValueError, TypeError, AttributeError, LookupError, AssertionError),
    *(RuntimeError, ImportError, EOFError),
)
# Starts of K-means, as in the other solvers that begin with it.
_RESTARTS = 10


class SB3Solver(BatchedSolver):
    """
    A policy of either level, greedy, step by step in the environment that it knows.

    An allocator's UAVs fly to the nearest task that still fits unless there is a router. For a router's policy, K-means gives
    every UAV a cluster of the tasks, with the same clusters as ``kmeans-am``. Masks are part of the observation; a maskable
    policy of sb3-contrib gets them as ``action_masks`` too. An illegal action has the effect that the environment gives it
    (the UAV flies home), and a warning counts them.

    A stock policy knows one size: smaller instances are padded, as in the environments, others are refused. Our own policies
    serve any size. As for every solver, tasks that cannot count are left out before.

    :param policy: The policy
    :param problem: The problem that its environment played
    :param router: Plans the tours of an allocator's UAVs; the nearest feasible task when None
    :param task_order: ``"input"`` or ``"sweep"``, the order in which an allocator saw its tasks; that of the policy when None,
        and ``"input"`` for a stock policy
    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :param identity: What tells this policy from others, for resuming evaluations
    :param stored: What one of our policies is rebuilt from, to serve any size; None for a policy of one size
    :raises ValueError: If an argument is not allowed
    """

    name = "sb3"

    def __init__(
        self,
        policy: BasePolicy,
        problem: Problem,
        router: RouterPolicy | None = None,
        task_order: str | None = None,
        batch_size: int | None = None,
        identity: str = "",
        stored: StoredPolicy | None = None,
    ) -> None:
        super().__init__(batch_size)
        self.policy = policy
        self.stored = stored
        self.is_router = isinstance(problem, RoutingProblem)
        if self.is_router and (router is not None or task_order is not None):
            given = "router" if router is not None else "task_order"
            raise ValueError(f"option {given!r} is for the zip of an allocator, but this one was trained on RoutePlanning.")
        self.n_tasks, self.n_uavs = problem.generator.n_tasks, problem.generator.n_uavs
        self.router = router
        own_order: str = getattr(policy, "env_order", "input")
        self.task_order = own_order if task_order is None else task_order
        # Refuses an unknown order.
        self._problem(1, 1, self.task_order)
        self.identity = identity
        self.serves_any_fleet = self.is_router or (stored is not None and stored.n_uavs is None)

    def settings(self) -> dict[str, Any]:
        if self.is_router:
            return {"policy": self.identity, "clusters": _RESTARTS}
        router = _NEAREST if self.router is None else parameters_hash(self.router)
        return {"policy": self.identity, "router": router, "task_order": self.task_order}

    def check(self, instances: Instances) -> None:
        super().check(instances)
        if self.stored is not None:
            if isinstance(self.policy, AllocatorPolicy):
                self.policy.check_fleet(instances)
            return
        trained = f"{self.n_tasks} tasks" + ("" if self.is_router else f" and {self.n_uavs} UAVs")
        wrong_fleet = not self.is_router and instances.n_uavs != self.n_uavs
        if wrong_fleet or instances.n_tasks > self.n_tasks:
            given = f"{instances.n_tasks} tasks" + ("" if self.is_router else f" and {instances.n_uavs} UAVs")
            raise ValueError(
                f"{self.name}: its policy was trained on {trained}, the instances have {given}; such a policy serves "
                "the size of its training, and fewer tasks by padding."
            )

    def rows_that_fit(self, instances: Instances) -> int:
        return rows_that_fit(self.policy.device, instances.n_tasks + 1, instances.n_uavs)

    def solve_batch(
        self, instances: Instances, rows: Sequence[int], seed: int, time_limit: float | None = None
    ) -> list[Schedule]:
        if self.is_router:
            assignment = kmeans_assignment(instances, rows, seed, _RESTARTS)
            plan: Router = self._fly
        else:
            assignment = self._allocate(instances)
            plan = nearest_feasible if self.router is None else self.router.plan
        return schedules(plan_tours(instances, assignment, plan).tours[:, 0])

    def _problem(self, n_tasks: int, n_uavs: int, task_order: str = "input") -> Problem:
        if self.is_router:
            return RoutingProblem(UniformGenerator(n_tasks))
        return AllocationProblem(UniformGenerator(n_tasks, n_uavs), task_order=task_order)

    def _allocate(self, instances: Instances) -> th.Tensor:
        """
        :param instances: ``batch`` instances
        :return: ``(batch, 1, n_tasks)`` int64, the UAV of each task
        """
        order = th.arange(instances.n_tasks).expand(len(instances), -1)
        if self.task_order == "sweep":
            order = sweep_order(instances)
        episodes, _ = self._play(instances.reorder(order))
        assignment = episodes.state.assignment[:, 0, : instances.n_tasks]
        return th.empty_like(assignment).scatter_(1, order, assignment)[:, None]

    def _fly(self, instances: Instances) -> th.Tensor:
        """
        :param instances: ``batch`` single-UAV instances
        :return: ``(batch, n_steps)`` int64 node indices
        """
        return th.stack(self._play(instances)[1], dim=1)

    def _play(self, instances: Instances) -> tuple[Episodes, list[th.Tensor]]:
        """
        :param instances: ``batch`` instances
        :return: The finished episodes, and for a router where each UAV was after each step, ``(batch,)`` int64
        """
        policy, masked = self.policy, isinstance(self.policy, MaskableActorCriticPolicy)
        problem = self._problem(self.n_tasks, self.n_uavs)
        if self.stored is not None:
            problem = self._problem(instances.n_tasks, instances.n_uavs)
            policy = self.stored.build(problem.observation_space, problem.action_space, policy.device)
        episodes = Episodes(problem, len(instances))
        episodes.reset(given={row: instances[row] for row in range(len(instances))})
        done, positions, n_illegal, n_actions = np.zeros(len(instances), dtype=bool), [], 0, 0
        while not done.all():
            masks: dict[str, Any] = {"action_masks": episodes.action_masks()} if masked else {}
            actions, _ = policy.predict(episodes.observation(), deterministic=True, **masks)
            result = episodes.step(actions)
            n_illegal += int(result.illegal[~done].sum())
            n_actions += int((~done).sum())
            done = result.dones
            if self.is_router:
                positions.append(episodes.state.position[:, 0].clone())
        if n_illegal > 0:
            warnings.warn(
                f"{self.name}: {n_illegal} of {n_actions} actions were illegal; each sent its UAV home. Train with a policy "
                "that masks its actions, such as those of sb3_uav or MaskablePPO's.",
                stacklevel=2,
            )
        return episodes, positions


def load_sb3(
    zip: str,
    algo: str | None = None,
    trust: bool = False,
    router: str | None = None,
    task_order: str | None = None,
    device: str = "auto",
    batch_size: int | None = None,
) -> SB3Solver:
    """
    :param zip: Zip of any SB3 algorithm that was trained on a ``TaskAllocation`` or ``RoutePlanning`` environment
    :param algo: What saved it: ``reinforce``, ``ppo``, ``ppo_mask``, ``a2c`` or the dotted path of an on-policy algorithm; not
        needed for our own policies
    :param trust: Whether the file may be unpickled, which executes whatever its author put into it. Zips of our own policies
        are read without
    :param router: SB3 zip of the router for the zip of an allocator, or the name of a pair that comes with the package; the
        nearest feasible task when None
    :param task_order: ``input`` or ``sweep``, the order in which an allocator saw its tasks
    :param device: Device of the networks
    :param batch_size: How many instances to solve at once; as many as memory allows when None
    :return: The solver
    :raises FileNotFoundError: If a zip is missing
    :raises ValueError: If a zip is damaged, was trained on another environment, or must be trusted to be read, or an argument
        is not allowed
    """
    path = Path(zip)
    router_zip = None if router is None else router_file(router)
    planner = None if router_zip is None else load_policy(router_zip, device, RouterPolicy)
    policy: BasePolicy
    stored: StoredPolicy | None = None
    try:
        policy = own = load_policy(path, device)
        stored, identity = read_policy(path), parameters_hash(own)
    except NotOurPolicyError as error:
        if not trust:
            raise ValueError(
                f"{error} Here it can be used with the option trust=1, which unpickles the file as SB3's load does: that "
                "executes whatever code its author put into it, so give it only for files that you trust."
            ) from error
        policy, identity = _load_trusted(path, algo, device), file_hash(_with_suffix(path))
    problem = problem_of_spaces(policy.observation_space, policy.action_space)
    if problem is None:
        raise ValueError(
            f"{path}: was trained on the spaces {policy.observation_space!s:.200} and {policy.action_space}, which are not "
            "those of a TaskAllocation or RoutePlanning environment of this package; give a zip that was."
        )
    solver = SB3Solver(policy, problem, planner, task_order, batch_size, identity, stored)
    solver.files = {"zip": _with_suffix(path)} | ({} if router_zip is None else {"router": router_zip})
    return solver


def _load_trusted(path: Path, algo: str | None, device: str) -> BasePolicy:
    """
    :param path: The zip
    :param algo: What saved it
    :param device: Device of the policy
    :return: Its policy, after unpickling the file
    :raises ValueError: If that algorithm cannot load it
    """
    if algo is None:
        raise ValueError(f"{path}: the option 'algo' is missing; name the algorithm that saved it, such as algo=ppo.")
    algorithm = resolve_algorithm(algo, "algo")
    try:
        return algorithm.load(path, device=device).policy
    except _WRONG_ALGORITHM as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: algo {algo!r} cannot load it ({reason:.300}); name the algorithm that saved it.") from error
    except pickle.UnpicklingError as error:
        raise ValueError(f"{path}: holds a damaged pickle ({error}); save or copy it again.") from error


def _with_suffix(path: str | os.PathLike[str]) -> Path:
    """The existing file, which SB3 also finds without its suffix."""
    given = Path(path)
    return given if given.is_file() else given.with_name(given.name + ".zip")

"""Episodes of a problem, run in lock step: the stateful part of the environments."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding

from sb3_uav.envs.instance_checks import require_finite_instances
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Dynamics, Problem, Stage


class StepResult(NamedTuple):
    """Arrays with leading dimension ``n_envs``."""

    observation: dict[str, np.ndarray]
    rewards: np.ndarray
    dones: np.ndarray
    illegal: np.ndarray


class Episodes:
    """
    ``n_envs`` episodes of a problem, stepped together. The Gymnasium and the vectorized environment are both built on it.

    Row ``i`` draws its instances from its own random generator, so that a batch of rows seeded ``s, s + 1, ...`` plays the
    same episodes as single environments with these seeds.

    :param problem: The problem
    :param n_envs: Number of rows
    """

    def __init__(self, problem: Problem, n_envs: int) -> None:
        self.problem = problem
        self.n_envs = n_envs
        self.rngs: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(n_envs)]
        self.instances: Instances
        self.dynamics: Dynamics
        self.state: Any = None
        self._static_observation: dict[str, np.ndarray] = {}
        self._actions: list[list[int]] = [[] for _ in range(n_envs)]

    def seed(self, row: int, seed: int) -> None:
        """Restart the random generator of one row."""
        self.rngs[row] = seeding.np_random(seed)[0]

    def reset(self, rows: np.ndarray | None = None, given: dict[int, Instances] | None = None) -> None:
        """
        Start new episodes.

        :param rows: Indices of the rows to reset; all when None
        :param given: Instances (batches of one) to use for some rows instead of drawing them
        :raises ValueError: If a number in them is NaN or infinite
        """
        given = given or {}
        indices = np.arange(self.n_envs) if rows is None else np.asarray(rows)
        drawn = [self._fit(given.get(int(i)) or self.problem.generator(1, self.rngs[i])) for i in indices]
        fresh = Instances.concatenate(drawn)
        require_finite_instances(fresh, self.problem.generator)
        if self.state is None or len(indices) == self.n_envs:
            self.instances = fresh
        else:
            index = th.from_numpy(indices)
            self.instances = self.instances.replace_rows(index, fresh)
        self.dynamics = self.problem.dynamics(self.instances)
        initial = self.dynamics.reset()
        if self.state is None or len(indices) == self.n_envs:
            self.state = initial
        else:
            self.state = type(initial)(
                *(old.index_copy(0, index, new[index]) for old, new in zip(self.state, initial, strict=True))
            )
        for i in indices:
            self._actions[i] = []
        static = self.problem.observe_static(self.instances)
        self._static_observation = {key: value.numpy() for key, value in static.items()}

    def _fit(self, instances: Instances) -> Instances:
        """Pad to the size of the observation space; raise ValueError if the instance does not fit."""
        n_tasks, n_uavs = self.problem.generator.n_tasks, self.problem.generator.n_uavs
        if self.problem.uses_fleet and instances.n_uavs != n_uavs:
            raise ValueError(
                f"The instance has {instances.n_uavs} UAVs, but the environment was made for {n_uavs}; "
                f"make the environment with n_uavs={instances.n_uavs}."
            )
        beyond = instances.beyond_the_paper
        if beyond and not self.problem.is_whole:
            raise ValueError(
                f"The instance has {', '.join(beyond)}, which the observations of this environment do not show; make it with "
                "a generator of such instances, whose attribute beyond_the_paper is true."
            )
        if instances.n_tasks > n_tasks:
            raise ValueError(
                f"The instance has {instances.n_tasks} tasks, but the observation space holds {n_tasks}; "
                "make the environment with a larger n_tasks."
            )
        if self.problem.is_whole and not self.problem.uses_fleet:
            n_uavs = 1
        return self.problem.arrange(instances).pad(n_tasks).with_fleet(n_uavs)

    def step(self, actions: np.ndarray) -> StepResult:
        """
        :param actions: ``(n_envs,)`` integers
        :return: Observations, rewards, ends of episodes and illegal actions; finished rows are not reset
        """
        if self.state is None:
            raise ResetNeeded("There is no episode to step yet; call reset() first.")
        given = np.asarray(actions)
        n_actions = self.state.action_mask.shape[-1]
        # Not np.isin with all actions, as there may be a million.
        is_number = given.dtype.kind in "biuf" and given.size == self.n_envs
        if not is_number or not ((given >= 0) & (given < n_actions) & (given == np.floor(given))).all():
            raise ValueError(
                f"Give {self.n_envs} whole numbers between 0 and {n_actions - 1} as actions; found {given.tolist()!r:.80}."
            )
        chosen = th.from_numpy(given.astype(np.int64)).reshape(self.n_envs, 1)
        illegal = ~self.state.action_mask.gather(-1, chosen[..., None]).reshape(self.n_envs)
        effective = ~illegal & ~self.state.done.reshape(self.n_envs)
        for row, (action, has_effect) in enumerate(zip(chosen[:, 0].tolist(), effective.tolist(), strict=True)):
            if has_effect:
                self._actions[row].append(action)
        self.state, rewards = self.dynamics.step(self.state, chosen)
        return StepResult(
            self.observation(),
            rewards.reshape(self.n_envs).numpy(),
            self.state.done.reshape(self.n_envs).numpy(),
            illegal.numpy(),
        )

    def observation(self) -> dict[str, np.ndarray]:
        """The observation of every row, ``(n_envs, ...)``, in the dtype of the observation space."""
        dynamic = self.problem.observe(self.dynamics, self.state)
        observation = {key: value.copy() for key, value in self._static_observation.items()}
        for key, value in dynamic.items():
            observation[key] = value.numpy().astype(self.problem.observation_space[key].dtype)
        return {key: observation[key] for key in self.problem.observation_space.spaces}

    def routes(self, row: int) -> list[list[int]]:
        """The routes of one row's episode so far, task indices from 0 per UAV."""
        return self.problem.routes(self.instances[row], self._actions[row])

    def stage(self, row: int) -> Stage:
        """The stage of one row's episode."""
        return Stage.FINISHED if bool(self.state.done[row].all()) else self.problem.running_stage

    def action_masks(self) -> np.ndarray:
        """``(n_envs, n_actions)`` bool, True where an action is legal."""
        return self.state.action_mask[:, 0].numpy().copy()


def given_instance(options: dict[str, Any] | None) -> Instances | None:
    """
    The instance requested by the ``options`` of a reset.

    :param options: ``{"instance": Instances}`` with a batch of one, or nothing
    :return: The validated instance, or None
    :raises ValueError: If there are other keys or types, so that a misspelled option is not ignored
    """
    if not options:
        return None
    unknown = set(options) - {"instance"}
    if unknown:
        raise ValueError(f"Unknown reset options {sorted(unknown)}; the one option is 'instance'.")
    instance = options["instance"]
    if not isinstance(instance, Instances) or len(instance) != 1:
        raise ValueError(f"Option 'instance' must be Instances with batch size 1, found {instance!r:.80}.")
    instance.validate()
    return instance

"""What the two levels have in common: batched dynamics, and episodes of them that run in lock step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding

from sb3_uav.envs.instances import InstanceGenerator, Instances

StateT = TypeVar("StateT", bound="State")

# What an observation keeps throughout an episode.
STATIC_KEYS = ("depot", "tasks", "task_values", "task_mask", "max_distance")


class State(Protocol):
    """What every state holds: tensors with leading dimensions (batch, n_samples)."""

    @property
    def done(self) -> th.Tensor:
        """``(batch, n_samples)`` bool."""
        ...

    @property
    def action_mask(self) -> th.Tensor:
        """``(batch, n_samples, n_actions)`` bool, True where an action is legal; at least one is, always."""
        ...


class Dynamics(ABC):
    """
    Pure, batched state transitions on tensors, on the device of the instances.

    Each of the ``batch`` instances runs ``n_samples`` independent episodes.

    :param instances: The instances
    """

    def __init__(self, instances: Instances) -> None:
        self.instances = instances

    @abstractmethod
    def reset(self, n_samples: int = 1) -> Any:
        """
        :param n_samples: Episodes per instance
        :return: The initial state
        """

    @abstractmethod
    def step(self, state: Any, actions: th.Tensor) -> tuple[Any, th.Tensor]:
        """
        Finished episodes stay as they are, whatever their action.

        :param state: The state, not modified
        :param actions: ``(batch, n_samples)`` int64
        :return: The next state, and the rewards ``(batch, n_samples)`` float64
        """


class Problem(ABC):
    """
    One level of the decomposition: where its instances come from, its spaces, its dynamics.

    :param generator: Draws the instances
    """

    observation_space: spaces.Dict
    action_space: spaces.Discrete
    # Whether the number of UAVs of an instance matters.
    uses_fleet: ClassVar[bool] = True

    def __init__(self, generator: InstanceGenerator) -> None:
        self.generator = generator
        self.action_space = self._action_space()
        self.observation_space = spaces.Dict({**self._static_spaces(), **self._dynamic_spaces()})

    @abstractmethod
    def _action_space(self) -> spaces.Discrete: ...

    @abstractmethod
    def _dynamic_spaces(self) -> dict[str, spaces.Space]: ...

    def _static_spaces(self) -> dict[str, spaces.Space]:
        n_tasks = self.generator.n_tasks
        return {
            "depot": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            # Flat, x and y in turn, because SB3's env checker advises against 2D observations.
            "tasks": spaces.Box(-np.inf, np.inf, (2 * n_tasks,), np.float32),
            # Not "values": SB3's CombinedExtractor keeps keys in an nn.ModuleDict, which has a method of that name.
            "task_values": spaces.Box(0.0, np.inf, (n_tasks,), np.float32),
            "task_mask": spaces.MultiBinary(n_tasks),
            "max_distance": spaces.Box(0.0, np.inf, (1,), np.float32),
        }

    @abstractmethod
    def dynamics(self, instances: Instances) -> Dynamics:
        """
        :param instances: The instances
        :return: Their transitions
        """

    @abstractmethod
    def observe(self, dynamics: Any, state: Any) -> dict[str, th.Tensor]:
        """
        The part of the observation that changes from step to step.

        :param dynamics: Transitions of ``batch`` instances
        :param state: A state with ``n_samples`` = 1
        :return: Tensors with leading dimension ``batch``
        """

    @abstractmethod
    def returns(self, instances: Instances, actions: th.Tensor) -> th.Tensor:
        """
        Undiscounted returns of complete episodes, without stepping through them one observation at a time.

        :param instances: ``batch`` instances
        :param actions: ``(batch, n_samples, n_steps)`` int64
        :return: ``(batch, n_samples)`` float64
        """

    @abstractmethod
    def step_rewards(self, instances: Instances, actions: th.Tensor, returns: th.Tensor) -> th.Tensor:
        """
        The rewards of complete episodes, step by step.

        :param instances: ``batch`` instances
        :param actions: ``(batch, n_samples, n_steps)`` int64
        :param returns: What :meth:`returns` says of them, ``(batch, n_samples)``
        :return: ``(batch, n_samples, n_steps)`` float64
        """

    @abstractmethod
    def lengths(self, instances: Instances, actions: th.Tensor) -> th.Tensor:
        """
        Number of steps of complete episodes.

        :param instances: ``batch`` instances
        :param actions: ``(batch, n_samples, n_steps)`` int64
        :return: ``(batch, n_samples)`` int64
        """

    @abstractmethod
    def routes(self, instance: Instances, actions: list[int]) -> list[list[int]]:
        """
        The routes to draw for an episode that may still be running.

        :param instance: A batch of one
        :param actions: The legal actions so far
        :return: Task indices from 0, per UAV
        """

    def arrange(self, instances: Instances) -> Instances:
        """
        :param instances: Any instances
        :return: They as episodes show them; tasks may stand in another order
        """
        return instances

    @staticmethod
    def observe_static(instances: Instances) -> dict[str, th.Tensor]:
        """The part of the observation that an episode keeps, float32 with leading dimension ``batch``."""
        return {
            "depot": instances.depot.float(),
            "tasks": instances.tasks.float().flatten(1),
            "task_values": instances.values.float(),
            "task_mask": instances.task_mask.to(th.int8),
            "max_distance": instances.max_distance.float()[:, None],
        }


class StepResult(NamedTuple):
    """Arrays with leading dimension ``n_envs``."""

    observation: dict[str, np.ndarray]
    rewards: np.ndarray
    dones: np.ndarray
    illegal: np.ndarray


class Episodes:
    """
    ``n_envs`` episodes of a problem, stepped together; the one stateful piece under the Gymnasium and the vectorized env.

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
        :param given: Instances (batches of one) to use for some rows instead of drawn ones
        """
        given = given or {}
        indices = np.arange(self.n_envs) if rows is None else np.asarray(rows)
        drawn = [self._fit(given.get(int(i)) or self.problem.generator(1, self.rngs[i])) for i in indices]
        fresh = Instances.concatenate(drawn)
        if self.state is None or len(indices) == self.n_envs:
            self.instances = fresh
        else:
            kept = self.instances
            index = th.from_numpy(indices)
            self.instances = Instances(
                **{
                    name: getattr(kept, name).index_copy(0, index, getattr(fresh, name))
                    for name in ("depot", "tasks", "values", "max_distance", "task_mask")
                },
                n_uavs=kept.n_uavs,
            )
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
        """Pad to the size of the observation space, and refuse what does not fit."""
        n_tasks, n_uavs = self.problem.generator.n_tasks, self.problem.generator.n_uavs
        if self.problem.uses_fleet and instances.n_uavs != n_uavs:
            raise ValueError(
                f"The instance has {instances.n_uavs} UAVs, but the environment was made for {n_uavs}; "
                f"make the environment with n_uavs={instances.n_uavs}."
            )
        if instances.n_tasks > n_tasks:
            raise ValueError(
                f"The instance has {instances.n_tasks} tasks, but the observation space holds {n_tasks}; "
                "make the environment with a larger n_tasks."
            )
        return replace(self.problem.arrange(instances).pad(n_tasks), n_uavs=n_uavs)

    def step(self, actions: np.ndarray) -> StepResult:
        """
        :param actions: ``(n_envs,)`` integers
        :return: What follows; finished rows are not reset here
        """
        if self.state is None:
            raise ResetNeeded("There is no episode to step yet; call reset() first.")
        given = np.asarray(actions)
        n_actions = self.state.action_mask.shape[-1]
        if given.size != self.n_envs or not np.isin(given, np.arange(n_actions)).all():
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

    def action_masks(self) -> np.ndarray:
        """``(n_envs, n_actions)`` bool, True where an action is legal."""
        return self.state.action_mask[:, 0].numpy().copy()


def given_instance(options: dict[str, Any] | None) -> Instances | None:
    """
    The instance that the ``options`` of a reset ask for.

    :param options: ``{"instance": Instances}`` with a batch of one, or nothing
    :raises ValueError: On other keys or types, so that a misspelled option is not ignored
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

"""The interface of a problem: instances, spaces, batched dynamics, and returns of complete episodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_uav.envs.generators import InstanceGenerator, goes_beyond_the_paper
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.rewards import Reward

# Relative error of a sum of values in float64.
_ROUNDING = 1e-9

StateT = TypeVar("StateT", bound="_State")

# The keys of an observation that do not change during an episode.
STATIC_KEYS = ("depot", "tasks", "task_values", "task_mask", "max_distance")
# Those that come with them where instances go beyond the paper's problem.
WHOLE_KEYS = ("uav_start", "uav_end", "uav_distance", "service")


def static_keys_of(observation_space: spaces.Space) -> tuple[str, ...]:
    """
    :param observation_space: Observation space of one of our environments, or any other
    :return: Keys of the observation that do not change during an episode
    """
    is_whole = isinstance(observation_space, spaces.Dict) and set(WHOLE_KEYS) <= set(observation_space.spaces)
    return STATIC_KEYS + WHOLE_KEYS if is_whole else STATIC_KEYS


class Stage(Enum):
    """How far an episode is, for drawings."""

    ASSIGNING = "tasks are being assigned to UAVs; no UAV has taken off"
    FLYING = "a UAV is under way"
    FINISHED = "all UAVs are back at the depot"


class _State(Protocol):
    """The fields that every state has: tensors with leading dimensions (batch, n_samples)."""

    @property
    def done(self) -> th.Tensor:
        """``(batch, n_samples)`` bool."""
        ...

    @property
    def action_mask(self) -> th.Tensor:
        """``(batch, n_samples, n_actions)`` bool, True where an action is legal; at least one always is."""
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
        Advance all episodes. Finished episodes do not change, whatever the action.

        :param state: The state, not modified
        :param actions: ``(batch, n_samples)`` int64
        :return: The next state, and the rewards ``(batch, n_samples)`` float64
        """


class Problem(ABC):
    """
    One level of the decomposition: its instances, spaces and dynamics.

    :param generator: Draws the instances
    :param reward: Values complete schedules, in place of the total value of the visited tasks
    """

    observation_space: spaces.Dict
    action_space: spaces.Discrete
    # The stage of an episode before it ends.
    running_stage: ClassVar[Stage]
    # Whether the number of UAVs of an instance matters.
    uses_fleet: ClassVar[bool] = True

    def __init__(self, generator: InstanceGenerator, reward: Reward | None = None) -> None:
        self.generator = generator
        # Once and for all, as the observation space: later generators may be of the paper's problem.
        self.is_whole = goes_beyond_the_paper(generator)
        self.reward = reward
        self.action_space = self._action_space()
        self.observation_space = spaces.Dict({**self._static_spaces(), **self._dynamic_spaces()})

    def set_generator(self, generator: InstanceGenerator) -> None:
        """
        Draw the instances from another source of the same size.

        :param generator: The new source
        :raises ValueError: If its instances do not fit the observation space
        """
        old, new = self.generator, generator
        if goes_beyond_the_paper(new) and not self.is_whole:
            raise ValueError(
                "The new generator goes beyond the paper's problem (starts, ends, distances or service costs), which the "
                "observations of this environment do not show; make a new environment."
            )
        if (new.n_tasks, new.n_uavs) != (old.n_tasks, old.n_uavs):
            raise ValueError(
                f"The new generator draws {new.n_tasks} tasks and {new.n_uavs} UAVs, the environment was made for "
                f"{old.n_tasks} and {old.n_uavs}; make a new environment."
            )
        self.generator = generator

    @abstractmethod
    def _action_space(self) -> spaces.Discrete: ...

    @abstractmethod
    def _dynamic_spaces(self) -> dict[str, spaces.Space]: ...

    def _static_spaces(self) -> dict[str, spaces.Space]:
        n_tasks = self.generator.n_tasks
        plain: dict[str, spaces.Space] = {
            "depot": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            # Flat, x and y in turn, because SB3's env checker advises against 2D observations.
            "tasks": spaces.Box(-np.inf, np.inf, (2 * n_tasks,), np.float32),
            # Not "values": SB3's CombinedExtractor keeps keys in an nn.ModuleDict, which has a method of that name.
            "task_values": spaces.Box(0.0, np.inf, (n_tasks,), np.float32),
            "task_mask": spaces.MultiBinary(n_tasks),
            "max_distance": spaces.Box(0.0, np.inf, (1,), np.float32),
        }
        if not self.is_whole:
            return plain
        n_uavs = self.generator.n_uavs if self.uses_fleet else 1
        return {
            **plain,
            "uav_start": spaces.Box(-np.inf, np.inf, (2 * n_uavs,), np.float32),
            "uav_end": spaces.Box(-np.inf, np.inf, (2 * n_uavs,), np.float32),
            "uav_distance": spaces.Box(0.0, np.inf, (n_uavs,), np.float32),
            "service": spaces.Box(0.0, np.inf, (n_tasks,), np.float32),
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
        :param returns: ``(batch, n_samples)``, the result of :meth:`returns`
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

    def successes(self, instances: Instances, returns: th.Tensor) -> th.Tensor | None:
        """
        Whether complete episodes are a success (``info["is_success"]``): every task that can count is visited.

        A task can count if its value is above 0 and a UAV can fly from the depot to it and back within the maximum flight
        distance. Most instances have more such tasks than a fleet can visit, so that a success rate of 0 is common; an
        instance without any is always a success.

        :param instances: ``batch`` instances
        :param returns: ``(batch, n_samples)`` float64, undiscounted returns of complete episodes
        :return: ``(batch, n_samples)`` bool; None with a reward of the user, which need not be about the values of tasks
        """
        if self.reward is not None:
            return None
        possible = (instances.prizes * instances.reachable()).sum(1)
        # Returns may have been added up in another order.
        return returns >= (1 - _ROUNDING) * possible[:, None]

    def arrange(self, instances: Instances) -> Instances:
        """
        :param instances: Any instances
        :return: The instances as episodes present them, possibly with the tasks in another order
        """
        return instances

    def observe_static(self, instances: Instances) -> dict[str, th.Tensor]:
        """
        The part of the observation that does not change during an episode.

        :param instances: ``batch`` instances
        :return: Tensors with leading dimension ``batch``, float32; coordinates are those of :meth:`Instances.near_origin`
        """
        instances = instances.near_origin()
        plain = {
            "depot": instances.depot.float(),
            "tasks": instances.tasks.float().flatten(1),
            "task_values": instances.prizes.float(),
            "task_mask": instances.task_mask.to(th.int8),
            "max_distance": instances.unit.float()[:, None],
        }
        if not self.is_whole:
            return plain
        return {
            **plain,
            "uav_start": instances.uav_start.float().flatten(1),
            "uav_end": instances.uav_end.float().flatten(1),
            "uav_distance": instances.uav_distance.float(),
            "service": instances.service_cost.float(),
        }

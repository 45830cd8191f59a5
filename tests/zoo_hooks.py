"""What a user names by dotted path in env_kwargs: right ones and wrong ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_uav.envs import Instances, UniformGenerator, collected_value, nearest_feasible


class Corner(UniformGenerator):
    """Depots in the origin."""

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        drawn = super().__call__(batch_size, rng)
        return drawn.replace_rows(th.arange(batch_size), Instances(**{**vars(drawn), "depot": th.zeros_like(drawn.depot)}))


@dataclass(frozen=True)
class Scaled:
    """Its own size, and an argument of its own."""

    n_tasks: int = 7
    n_uavs: int = 3
    scale: float = 1.0

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        drawn = UniformGenerator(self.n_tasks, self.n_uavs, 2.0)(batch_size, rng)
        return Instances(**{**vars(drawn), "tasks": drawn.tasks * self.scale})


class TooFew(UniformGenerator):
    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return super().__call__(1, rng)


class OtherSize(UniformGenerator):
    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return UniformGenerator(self.n_tasks + 1, self.n_uavs)(batch_size, rng)


class Arrays(UniformGenerator):
    def __call__(self, batch_size: int, rng: np.random.Generator) -> Any:
        return rng.random((batch_size, self.n_tasks, 2))


class Global(UniformGenerator):
    """Draws from a generator of its own, so that nothing can be repeated."""

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return super().__call__(batch_size, np.random.default_rng())


class Negative(UniformGenerator):
    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        drawn = super().__call__(batch_size, rng)
        return Instances(**{**vars(drawn), "values": -drawn.values})


class NoSize:
    def __call__(self, batch_size: int, rng: np.random.Generator) -> None:
        return None


class PlainCorner:
    """A generator without an equality of its own."""

    def __init__(self, n_tasks: int, n_uavs: int, side: float = 1.0) -> None:
        self.n_tasks, self.n_uavs, self.side = n_tasks, n_uavs, side

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return Scaled(self.n_tasks, self.n_uavs, self.side)(batch_size, rng)


class PowerOfVisits:
    """A reward without an equality of its own."""

    def __init__(self, power: float = 0.5) -> None:
        self.power = power

    def __call__(self, instances: Instances, tours: th.Tensor) -> th.Tensor:
        return root_of_visits(instances, tours, self.power)


class NearestRouter:
    def __call__(self, instances: Instances) -> th.Tensor:
        return nearest_feasible(instances)


def stripe(n_instances: int, n_tasks: int, rng: np.random.Generator, width: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A distribution: all points in a vertical stripe."""
    points = rng.random((n_instances, n_tasks + 1, 2)) * [width, 1.0]
    return points[:, 0], points[:, 1:]


def valued(n_instances: int, n_tasks: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return *stripe(n_instances, n_tasks, rng), rng.integers(1, 5, (n_instances, n_tasks))


def depots_only(n_instances: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    return rng.random((n_instances, 2))


def too_many(n_instances: int, n_tasks: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return rng.random((n_instances, 2)), rng.random((n_instances, n_tasks + 1, 2))


def one_task(instances: Instances, worst: bool = False) -> th.Tensor:
    """A router: the first task of the nearest-task tour, and home."""
    tours = nearest_feasible(instances)
    tours = tours[:, :1] if tours.shape[1] else tours
    return th.zeros_like(tours) if worst else tours


def flat(instances: Instances) -> th.Tensor:
    return nearest_feasible(instances).flatten()


def everything(instances: Instances) -> th.Tensor:
    """Every slot, padded ones and those out of reach too."""
    return th.arange(1, instances.n_tasks + 1).expand(len(instances), -1).clone()


def far(instances: Instances) -> th.Tensor:
    """Every real task, however far."""
    return everything(instances) * instances.task_mask


def twice(instances: Instances) -> th.Tensor:
    tours = one_task(instances)
    return th.cat([tours, tours], dim=1)


def floats(instances: Instances) -> th.Tensor:
    return nearest_feasible(instances).double()


def root_of_visits(instances: Instances, tours: th.Tensor, power: float = 0.5) -> th.Tensor:
    """A reward: long tours count for less."""
    return ((tours >= 0).sum(-1).double() ** power).sum(-1)


def plain_value(instances: Instances, tours: th.Tensor) -> th.Tensor:
    """A reward that equals the usual one."""
    return collected_value(instances, tours.flatten(1) + 1)


def order_of_visits(instances: Instances, tours: th.Tensor) -> th.Tensor:
    """A reward that needs the order: the index of the last task of the first tour."""
    last = (tours[:, 0] >= 0).sum(-1, keepdim=True) - 1
    return tours[:, 0].gather(1, last.clamp(min=0))[:, 0].double()


def per_tour(instances: Instances, tours: th.Tensor) -> th.Tensor:
    return (tours >= 0).sum(-1)


def infinite(instances: Instances, tours: th.Tensor) -> th.Tensor:
    return th.full((len(instances),), float("inf"))


def broken(*args: Any) -> None:
    raise KeyError("battery")

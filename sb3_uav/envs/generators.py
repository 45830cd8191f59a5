"""Generators of instances: distributions, mixtures of sizes, and rows of given instances."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch as th

from sb3_uav.envs.instance_checks import require_finite_instances
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.sizes import check_size, n_instances_of
from sb3_uav.envs.world import WorldGenerator


class InstanceGenerator(Protocol):
    """Draws instances of one size. Stateless: the same ``rng`` state gives the same instances."""

    @property
    def n_tasks(self) -> int: ...

    @property
    def n_uavs(self) -> int: ...

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """
        :param batch_size: Number of instances
        :param rng: Random generator
        :return: ``batch_size`` instances of ``n_tasks`` task slots, float64 on the CPU
        """
        ...


def goes_beyond_the_paper(generator: InstanceGenerator) -> bool:
    """
    :param generator: Any generator; one of more than the paper's problem has an attribute ``beyond_the_paper`` that is true
    :return: Whether its instances may have starts, ends and distances of each UAV, or service costs
    """
    return bool(getattr(generator, "beyond_the_paper", False))


def _with_unit_values(depot: np.ndarray, tasks: np.ndarray, max_distance: float, n_uavs: int) -> Instances:
    batch_size, n_tasks = tasks.shape[:2]
    return Instances(
        depot=th.from_numpy(depot),
        tasks=th.from_numpy(tasks),
        values=th.ones(batch_size, n_tasks, dtype=th.float64, device="cpu"),
        max_distance=th.full((batch_size,), max_distance, dtype=th.float64, device="cpu"),
        n_uavs=n_uavs,
        task_mask=th.ones(batch_size, n_tasks, dtype=th.bool, device="cpu"),
    )


@dataclass(frozen=True)
class UniformGenerator:
    """
    Depot and tasks uniform in the unit square, all values 1: the paper's distribution (section V-A).

    :param n_tasks: Number of tasks (the paper's N)
    :param n_uavs: Number of UAVs (the paper's V)
    :param max_distance: Maximum flight distance (the paper's D = 2.0)
    :raises ValueError: If a size is not allowed
    """

    n_tasks: int
    n_uavs: int = 4
    max_distance: float = 2.0

    def __post_init__(self) -> None:
        check_size(self.n_tasks, self.n_uavs, self.max_distance)

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        points = rng.random((batch_size, self.n_tasks + 1, 2))
        return _with_unit_values(points[:, 0].copy(), points[:, 1:].copy(), self.max_distance, self.n_uavs)


@dataclass(frozen=True)
class ClusteredGenerator:
    """
    Tasks normally distributed around uniform centers, clipped to the unit square; the depot is uniform.

    :param n_tasks: Number of tasks
    :param n_uavs: Number of UAVs
    :param max_distance: Maximum flight distance
    :param n_clusters: Number of centers
    :param spread: Standard deviation around a center
    :raises ValueError: If a size is not allowed
    """

    n_tasks: int
    n_uavs: int = 4
    max_distance: float = 2.0
    n_clusters: int = 5
    spread: float = 0.07

    def __post_init__(self) -> None:
        check_size(self.n_tasks, self.n_uavs, self.max_distance)
        if self.n_clusters < 1 or not self.spread >= 0:
            raise ValueError(f"n_clusters must be >= 1 and spread >= 0, found {self.n_clusters} and {self.spread}.")

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        depot = rng.random((batch_size, 2))
        centers = rng.random((batch_size, self.n_clusters, 2))
        cluster = rng.integers(self.n_clusters, size=(batch_size, self.n_tasks))
        noise = rng.normal(0.0, self.spread, (batch_size, self.n_tasks, 2))
        tasks = np.clip(np.take_along_axis(centers, cluster[..., None], axis=1) + noise, 0.0, 1.0)
        return _with_unit_values(depot, tasks, self.max_distance, self.n_uavs)


# With fewer tasks per UAV, almost every allocation visits all tasks, and there is little to learn.
_TASKS_PER_UAV = 12
# Exponent that favors small instances, which are almost as instructive as large ones and cheaper; 1 is log-uniform.
_SMALL_SIZES = 1.5


@dataclass(frozen=True)
class MixtureGenerator:
    """
    Training batches of random sizes, so that one network learns them all: each batch has its own number of tasks, fleet of at
    least 2 UAVs, and maximum flight distance. Depot and tasks are uniform in the unit square.

    Calling the generator directly returns instances of the largest size.

    :param n_tasks: Largest number of tasks
    :param n_uavs: Largest fleet
    :param max_distance: Maximum flight distance of half of the batches; the others have 0.6 to 1.6 times as much
    :param min_tasks: Smallest number of tasks
    :raises ValueError: If a size is not allowed
    """

    n_tasks: int
    n_uavs: int = 8
    max_distance: float = 2.0
    min_tasks: int = 40

    def __post_init__(self) -> None:
        check_size(self.n_tasks, self.n_uavs, self.max_distance)
        if self.min_tasks < 1:
            raise ValueError(f"min_tasks is {self.min_tasks}; give at least 1.")

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return UniformGenerator(self.n_tasks, self.n_uavs, self.max_distance)(batch_size, rng)

    def training_batch(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """
        :param batch_size: Number of instances of the smallest size; batches of larger sizes have fewer
        :param rng: Random generator
        :return: Instances of a random size
        """
        n_uavs = int(rng.integers(min(2, self.n_uavs), self.n_uavs, endpoint=True))
        least = min(self.min_tasks, self.n_tasks)
        fewest = min(max(least, _TASKS_PER_UAV * n_uavs), self.n_tasks)
        n_tasks = round(fewest * (self.n_tasks / fewest) ** (rng.random() ** _SMALL_SIZES))
        factor = 1.0 if rng.random() < 0.5 else rng.uniform(0.6, 1.6)
        n_instances = n_instances_of(batch_size, least, n_tasks)
        return UniformGenerator(n_tasks, n_uavs, self.max_distance * factor)(n_instances, rng)


def training_batch(generator: InstanceGenerator, batch_size: int, rng: np.random.Generator) -> Instances:
    """
    Draw the instances of one update, with the generator's own ``training_batch`` if it has one.

    :param generator: Any generator
    :param batch_size: Number of instances; a generator of mixed sizes may return fewer
    :param rng: Random generator
    :return: The instances
    :raises ValueError: If a number in them is NaN or infinite
    """
    instances = getattr(generator, "training_batch", generator)(batch_size, rng)
    require_finite_instances(instances, generator)
    return instances


@dataclass(frozen=True, eq=False)
class FixedGenerator:
    """
    Rows of given instances, drawn at random with replacement.

    Two of them are equal if their instances are, so that environments that read the same file play the same problem.

    :param instances: The instances to draw from
    :raises ValueError: If there are none
    """

    instances: Instances

    def __post_init__(self) -> None:
        if len(self.instances) == 0:
            raise ValueError("There are no instances to draw from; give at least one.")

    # Taken once: it is compared at every update, and the instances are not meant to change.
    @cached_property
    def _digest(self) -> str:
        return self.instances.digest()

    def __eq__(self, other: object) -> bool:
        # A subclass may draw them differently.
        if not isinstance(other, FixedGenerator) or type(other) is not type(self):
            return NotImplemented
        return self.instances is other.instances or self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    @property
    def n_tasks(self) -> int:
        return self.instances.n_tasks

    @property
    def n_uavs(self) -> int:
        return self.instances.n_uavs

    @property
    def beyond_the_paper(self) -> bool:
        """Whether the instances have starts, ends and distances of each UAV, or service costs."""
        return bool(self.instances.beyond_the_paper)

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return self.instances[rng.integers(len(self.instances), size=batch_size)]


_GENERATORS = {
    "uniform": UniformGenerator,
    "clustered": ClusteredGenerator,
    "mixture": MixtureGenerator,
    "world": WorldGenerator,
}


def make_generator(
    n_tasks: int,
    n_uavs: int,
    max_distance: float = 2.0,
    distribution: str = "uniform",
    instances: str | os.PathLike[str] | Instances | None = None,
) -> InstanceGenerator:
    """
    Make a generator from the plain-data arguments of an environment.

    :param n_tasks: Number of tasks; ignored when ``instances`` is given
    :param n_uavs: Number of UAVs; ignored when ``instances`` is given
    :param max_distance: Maximum flight distance; ignored when ``instances`` is given
    :param distribution: ``"uniform"``, ``"clustered"``, ``"mixture"`` or ``"world"``
    :param instances: Instances, or the path of an ``.npz`` file, to draw from instead of a distribution
    :raises ValueError: If an argument is not allowed
    """
    if instances is not None:
        return FixedGenerator(instances if isinstance(instances, Instances) else Instances.load(instances))
    if distribution not in _GENERATORS:
        raise ValueError(f"distribution is {distribution!r}; choose one of {sorted(_GENERATORS)}.")
    return _GENERATORS[distribution](n_tasks=n_tasks, n_uavs=n_uavs, max_distance=max_distance)

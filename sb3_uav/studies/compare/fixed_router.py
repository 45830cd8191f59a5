"""Training a router alone, as the fixed basis for comparing algorithms on the allocator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_uav.envs.allocation import split_tasks
from sb3_uav.envs.generators import InstanceGenerator, goes_beyond_the_paper
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.reinforce import REINFORCE

# What a YAML entry of ITSCallback's router overrides.
_RECIPE: dict[str, Any] = dict(
    policy="RouterPolicy",
    n_envs=64,
    n_samples=8,
    baseline="shared",
    normalize_advantage=True,
    learning_rate=1e-3,
    max_grad_norm=1.0,
)


@dataclass(frozen=True)
class _DividedSubsets:
    """
    Single-UAV subsets of instances that are divided without an allocator: half of them at random, as an untrained one does,
    half into sectors around the depot, much as a trained one does.

    :param generator: Draws the instances of the fleet
    """

    generator: InstanceGenerator
    n_uavs: ClassVar[int] = 1

    @property
    def n_tasks(self) -> int:
        return self.generator.n_tasks

    @property
    def beyond_the_paper(self) -> bool:
        return goes_beyond_the_paper(self.generator)

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """
        :param batch_size: Number of subsets
        :param rng: The source of randomness
        :return: Shuffled subsets
        """
        n_uavs = self.generator.n_uavs
        instances = self.generator(-(-batch_size // n_uavs), rng)
        shape = tuple(instances.task_mask.shape)
        offset = instances.tasks - instances.depot[:, None]
        start = th.from_numpy(rng.uniform(0.0, 2 * math.pi, (shape[0], 1)))
        angle = (th.atan2(offset[..., 1], offset[..., 0]) + start) % (2 * math.pi)
        sector = angle.argsort(1).argsort(1) * n_uavs // shape[1]
        at_random = th.from_numpy(rng.random((shape[0], 1)) < 0.5)
        assignment = th.where(at_random, th.from_numpy(rng.integers(n_uavs, size=shape)), sector)
        subsets = split_tasks(instances, assignment[:, None]).instances
        return subsets[rng.permutation(len(subsets))[:batch_size]]


def pretrain_router(
    generator: InstanceGenerator, settings: dict[str, Any], n_subsets: int, path: Path, seed: int = 0, device: str = "cpu"
) -> str:
    """
    Train a router with REINFORCE and save it.

    :param generator: Draws the instances of the fleet
    :param settings: Overrides of :data:`_RECIPE`
    :param n_subsets: Number of training subsets
    :param path: The zip to write
    :param seed: Seed of the training
    :param device: Device of the training
    :return: Description of the training, for the report
    :raises ValueError: If the settings do not fit REINFORCE
    """
    kwargs = {**_RECIPE, **settings}
    if kwargs.pop("algo", "reinforce") != "reinforce":
        raise ValueError(f"The router of {settings} is not trained by reinforce; train a router and pass it as --router.")
    n_envs = kwargs.pop("n_envs")
    env = BatchedVecEnv([lambda: RoutePlanningEnv(generator=_DividedSubsets(generator))] * n_envs)
    try:
        model = REINFORCE(env=env, seed=seed, device=device, **kwargs)
    except TypeError as error:
        raise ValueError(f"router: these arguments do not fit REINFORCE: {error}") from error
    model.learn_instances(n_subsets)
    model.save(path)
    return (
        f"REINFORCE (baseline {model.baseline}, {model.n_samples} sample(s) per subset) on {model.n_instances:,} subsets of "
        f"instances of the environment, half of them divided at random and half into sectors, seed {seed}"
    )

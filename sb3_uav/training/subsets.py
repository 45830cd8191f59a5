"""The router's training instances: what the current allocator gives to the UAVs (``data_gen`` of the paper's Algorithm 1)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th

from sb3_uav.common import distributed
from sb3_uav.common.random_streams import TRAINING_STREAM, PartGenerator, random_stream, torch_generator
from sb3_uav.envs.allocation import split_tasks
from sb3_uav.envs.generators import InstanceGenerator, MixtureGenerator, goes_beyond_the_paper, training_batch
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.world import WorldGenerator
from sb3_uav.policies import AllocatorPolicy

# Number of test instances allocated at once: the smaller of the paper's batch sizes.
_HELD_OUT_ROWS = 256


def sample_subsets(allocator: AllocatorPolicy, instances: Instances, rng: np.random.Generator) -> Instances:
    """
    Allocate tasks by sampling; each process does so for its part of the instances, and all get the subsets of all.

    :param allocator: The allocator, which is put into evaluation mode
    :param instances: ``batch`` instances, tasks in the allocator's order
    :param rng: Random generator
    :return: ``batch * n_uavs`` single-UAV instances on the CPU
    """
    device = allocator.device
    generator = torch_generator(rng, device)
    allocator.set_training_mode(False)
    rows, part = distributed.shard(len(instances)), instances
    if distributed.world_size() > 1:
        part, generator = instances[rows], PartGenerator.of(generator, rows, len(instances))
    actions = allocator.decode_episodes(part.to(device), deterministic=False, generator=generator)
    return split_tasks(instances, distributed.gather(actions.cpu(), len(instances))).instances


class SingleUavGenerator:
    """
    Base of the generators of the router's instances: one UAV, and as many tasks as the fleet's instances.

    :param generator: Draws the instances of the fleet
    """

    n_uavs = 1

    def __init__(self, generator: InstanceGenerator) -> None:
        self.generator = generator
        self.n_tasks = generator.n_tasks
        self.beyond_the_paper = goes_beyond_the_paper(generator)


class WholeInstances(SingleUavGenerator):
    """
    Instances with all their tasks for one UAV: what the router is pre-trained on.

    :param generator: Draws the instances of the fleet
    """

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return self.generator(batch_size, rng).with_fleet(1)

    def training_batch(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """The same for the generator's training batches."""
        return training_batch(self.generator, batch_size, rng).with_fleet(1)


class AllocatedSubsets(SingleUavGenerator):
    """
    Shuffled single-UAV subsets of the instances of one allocator epoch, allocated by sampling from the current allocator.

    Instances are taken ``shuffle_batches`` batches at a time and the subsets of these are shuffled, which breaks the
    correlation between the subsets of an instance without holding a whole epoch in memory. After the last batch it starts
    again with the first one and new samples. Unlike other generators it continues where it stopped, whatever ``rng`` is: the
    subsets only depend on the allocator and the numbers of the batches.

    :param allocator: The allocator
    :param generator: Draws the instances of the fleet, for :meth:`held_out`
    :param draw_batch: Training instances by number of the batch
    :param batches: The numbers of the epoch's batches
    :param fraction: Fraction of the subsets to use, chosen at random
    :param stream: Random generator by number of the chunk
    :param shuffle_batches: Batches per chunk
    :ivar seconds: How long it has taken so far to draw and allocate instances
    """

    def __init__(
        self,
        allocator: AllocatorPolicy,
        generator: InstanceGenerator,
        draw_batch: Callable[[int], Instances],
        batches: Sequence[int],
        fraction: float,
        stream: Callable[[int], np.random.Generator],
        shuffle_batches: int = 8,
    ) -> None:
        super().__init__(generator)
        self.allocator = allocator
        self.draw_batch = draw_batch
        self.batches = batches
        self.fraction = fraction
        self.stream = stream
        self.shuffle_batches = shuffle_batches
        self.seconds = 0.0
        self._next_batch = 0
        self._n_chunks = 0
        self._ready: Instances | None = None

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """The next ``batch_size`` subsets; ``rng`` is not used."""
        start = time.perf_counter()
        while self._ready is None or len(self._ready) < batch_size:
            chunk = self._next_chunk()
            self._ready = chunk if self._ready is None else Instances.concatenate([self._ready, chunk])
        drawn, self._ready = self._ready[:batch_size], self._ready[batch_size:]
        drawn = drawn.trim(max(int(drawn.task_mask.sum(1).max()), 1))
        self.seconds += time.perf_counter() - start
        return drawn

    def training_batch(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """
        Where the generator mixes sizes, subsets of one batch chosen at random, so that small subsets are not padded to large
        ones; fewer of them when they are large. Otherwise the next ``batch_size`` subsets. As every update draws a new
        batch, :attr:`fraction` does not apply to them.
        """
        if not isinstance(self.generator, MixtureGenerator | WorldGenerator):
            return self(batch_size, rng)
        start = time.perf_counter()
        own_rng = self.stream(self._n_chunks)
        self._n_chunks += 1
        subsets = self._allocate(self.draw_batch(self.batches[int(own_rng.integers(len(self.batches)))]), own_rng)
        n_rows = max(round(batch_size * self.generator.min_tasks / subsets.n_tasks), 2)
        drawn = subsets[own_rng.permutation(len(subsets))[:n_rows]]
        drawn = drawn.trim(max(int(drawn.task_mask.sum(1).max()), 1))
        self.seconds += time.perf_counter() - start
        return drawn

    def _next_chunk(self) -> Instances:
        rng = self.stream(self._n_chunks)
        self._n_chunks += 1
        parts = []
        for _ in range(min(self.shuffle_batches, len(self.batches))):
            parts.append(self._allocate(self.draw_batch(self.batches[self._next_batch]), rng))
            self._next_batch = (self._next_batch + 1) % len(self.batches)
        subsets = Instances.concatenate(parts)
        kept = rng.permutation(len(subsets))[: max(round(self.fraction * len(subsets)), 1)]
        return subsets[kept]

    def _allocate(self, instances: Instances, rng: np.random.Generator) -> Instances:
        return sample_subsets(self.allocator, instances, rng)

    def held_out(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """
        Subsets of fresh instances, for the baseline's test.

        :param batch_size: Number of subsets
        :param rng: Random generator
        """
        instances = self.allocator.arrange(self.generator(-(-batch_size // self.generator.n_uavs), rng))
        rows = th.arange(len(instances), device="cpu").split(_HELD_OUT_ROWS)
        subsets = Instances.concatenate([self._allocate(instances[part], rng) for part in rows])
        return subsets[rng.permutation(len(subsets))[:batch_size]]


def new_batch(allocator: Any, generator: InstanceGenerator, n_envs: int, seed: int, epoch: int, index: int) -> Instances:
    """
    Instances that no training has seen, for algorithms that cannot replay their own.

    :param allocator: The policy of the allocator
    :param generator: Draws the instances
    :param n_envs: Number of instances of a batch
    :param seed: Seed of the random streams
    :param epoch: Epoch of the allocator
    :param index: Number of the batch in this epoch
    :return: The instances, the same at every call
    """
    return allocator.arrange(training_batch(generator, n_envs, random_stream(seed, TRAINING_STREAM, epoch, index)))

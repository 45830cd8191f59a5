"""The trained pair as a solver: the allocator splits the tasks, the router plans every UAV's tour (paper, section IV)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th

from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.envs.sweep import N_SYMMETRIES, reflect
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy
from sb3_uav.policies.base import Cache
from sb3_uav.policies.loading import load_policy
from sb3_uav.solvers.batched import BatchedSolver, parameters_hash

PolicyT = TypeVar("PolicyT", bound=EpisodicPolicy)

DECODINGS = ("greedy", "sampling", "augment")
# Allocations are drawn in blocks of this many per instance, each from random numbers of its own. So memory does not grow with
# the number of samples, and more samples only add to those that fewer would have drawn.
SAMPLE_BLOCK = 64
# Augmentation looks at an instance in so many views, all symmetries swept in both directions, and tries so many tours for each
# subset of tasks; allocations times tours are the samples.
N_VIEWS = 2 * N_SYMMETRIES
N_TOURS = 8


def freshly_initialised(policy: PolicyT, seed: int) -> PolicyT:
    """
    :param policy: Any policy of ours
    :param seed: Of the new parameters; the global random state is left as it was
    :return: A policy of the same architecture that has learned nothing, on the same device
    """
    with th.random.fork_rng(devices=[]):
        th.default_generator.manual_seed(seed)
        fresh = type(policy)(**policy._get_constructor_parameters())
    fresh.set_training_mode(False)
    return fresh.to(policy.device)


class DLDRL(BatchedSolver):
    """
    DL-DRL: an allocator and a router, both trained.

    What it finds for an instance depends on the seed and the row of the instance, not on ``batch_size`` (but for rounding
    errors of the networks). The router is greedy, except with ``"augment"``.

    :param allocator: The upper level's policy
    :param router: The lower level's policy
    :param decode: ``"greedy"``, ``"sampling"`` to keep the best of several sampled allocations, or ``"augment"`` to spend
        the samples on views of the instance (its symmetries, the sweep in both directions) and on several tours per UAV
    :param samples: Number of tours that are planned for every UAV of an instance
    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :param name: How tables and files call it; says how it decodes when None
    :raises ValueError: If an argument is not allowed
    """

    def __init__(
        self,
        allocator: AllocatorPolicy,
        router: RouterPolicy,
        decode: str = "greedy",
        samples: int = 128,
        batch_size: int | None = None,
        name: str | None = None,
    ) -> None:
        if decode not in DECODINGS:
            raise ValueError(f"decode is {decode!r}; choose one of {DECODINGS}.")
        if samples < 1:
            raise ValueError(f"samples is {samples}; give at least 1.")
        super().__init__(batch_size)
        self.allocator = allocator
        self.router = router
        self.decode = decode
        self.samples = samples
        self.name = f"DL-DRL ({self._decoding})" if name is None else name

    @property
    def _decoding(self) -> str:
        return "greedy" if self.decode == "greedy" else f"{self.decode} {self.samples}"

    def untrained(self, seed: int = 0) -> DLDRL:
        """
        :param seed: Of the parameters
        :return: The same solver with networks of the same architecture that have learned nothing
        """
        allocator, router = freshly_initialised(self.allocator, seed), freshly_initialised(self.router, seed + 1)
        name = f"DL-DRL untrained ({self._decoding})"
        return DLDRL(allocator, router, self.decode, self.samples, self.batch_size, name)

    def check(self, instances: Instances) -> None:
        self.allocator.check_fleet(instances)

    def settings(self) -> dict[str, Any]:
        networks = {"allocator": parameters_hash(self.allocator), "router": parameters_hash(self.router)}
        return {**networks, "decoding": self._decoding}

    def rows_that_fit(self, instances: Instances) -> int:
        n_samples = SAMPLE_BLOCK if self.decode == "sampling" else 1
        return self.allocator.rows_that_fit(instances.n_tasks + 1, n_samples * instances.n_uavs)

    def solve_batch(self, instances: Instances, rows: Sequence[int], seed: int) -> list[Schedule]:
        self.allocator.set_training_mode(False)
        instances = instances.to(self.allocator.device)
        if self.decode == "augment":
            return [self._augment(instances[i], random_generator(instances, seed, row)) for i, row in enumerate(rows)]
        order = self.allocator.task_order(instances)
        instances = instances.reorder(order)
        with th.no_grad():
            cache = self.allocator.encode(instances)
        if self.decode == "greedy":
            planned = plan_tours(instances, self.allocator.decode_episodes(instances, cache=cache), self.router.plan)
            return schedules(in_input_order(planned.tours[:, 0], order))
        best_value = th.full((len(instances),), -th.inf, dtype=th.float64, device=instances.device)
        best = [Schedule([])] * len(instances)
        for first in range(0, self.samples, SAMPLE_BLOCK):
            n_samples = min(SAMPLE_BLOCK, self.samples - first)
            assignment = self._sample_block(instances, cache, rows, seed, first)[:, :n_samples]
            planned = plan_tours(instances, assignment, self.router.plan)
            value, sample = planned.value.max(1)
            tours = in_input_order(planned.tours[th.arange(len(instances), device=sample.device), sample], order)
            for row, (schedule, better) in enumerate(zip(schedules(tours), (value > best_value).tolist(), strict=True)):
                if better:
                    best[row] = schedule
            best_value = th.maximum(best_value, value)
        return best

    def _augment(self, instance: Instances, generator: th.Generator) -> Schedule:
        """
        :param instance: A batch of one
        :param generator: The source of randomness
        :return: The best schedule of all views, of which each begins with a greedy allocation
        """
        n_tours = min(N_TOURS, self.samples)
        n_allocations = self.samples // n_tours
        n_views = min(N_VIEWS, n_allocations)
        shown = [reflect(instance, view // 2) for view in range(n_views)]
        orders = th.cat([self.allocator.task_order(view, number % 2) for number, view in enumerate(shown)])
        views = Instances.concatenate(shown).reorder(orders)
        with th.no_grad():
            cache = self.allocator.encode(views)
        assignment = self.allocator.decode_episodes(views, cache=cache)
        if n_allocations > n_views:
            sampled = self.allocator.decode_episodes(views, n_allocations // n_views - 1, False, generator, cache)
            assignment = th.cat([assignment, sampled], dim=1)
        planned = plan_tours(views, assignment, lambda subsets: self.router.plan(subsets, None, n_tours, generator))
        view, sample = divmod(int(planned.value.argmax()), assignment.shape[1])
        return schedules(in_input_order(planned.tours[view : view + 1, sample], orders[view : view + 1]))[0]

    def _sample_block(self, instances: Instances, cache: Cache, rows: Sequence[int], seed: int, first: int) -> th.Tensor:
        """
        Sample one block of allocations, instance by instance, each from random numbers of its own.

        Measured on CPU this is as fast as sampling for all instances at once, because a block fills the cores already.

        :param instances: ``batch`` instances on the allocator's device
        :param cache: Their encodings
        :param rows: Their indices in what is being solved
        :param seed: Of the samples
        :param first: Index of the first sample of the block
        :return: ``(batch, SAMPLE_BLOCK, n_tasks)`` int64
        """
        blocks = []
        for i, row in enumerate(rows):
            generator = random_generator(instances, seed, row, first)
            own = Cache(cache.nodes[i : i + 1], tuple(projection[i : i + 1] for projection in cache.projections))
            blocks.append(self.allocator.decode_episodes(instances[i], SAMPLE_BLOCK, False, generator, own))
        return th.cat(blocks)


def random_generator(instances: Instances, *seed: int) -> th.Generator:
    """
    :param instances: On the device where random numbers are needed
    :param seed: What the random numbers depend on
    """
    state = np.random.SeedSequence(seed).generate_state(1, np.uint64)
    return th.Generator(instances.device).manual_seed(int(state[0] >> np.uint64(1)))


def in_input_order(tours: th.Tensor, order: th.Tensor) -> th.Tensor:
    """
    :param tours: ``(batch, n_uavs, n_steps)`` int64, places of tasks in the order, -1 as padding
    :param order: ``(batch, n_tasks)`` int64, which task stands in each place
    :return: The tours with the tasks themselves
    """
    tasks = order.gather(1, tours.clamp(min=0).flatten(1)).view_as(tours)
    return tasks.masked_fill(tours < 0, -1)


def load_dl_drl(
    allocator: str,
    router: str,
    decode: str = "greedy",
    samples: int = 128,
    device: str = "auto",
    batch_size: int | None = None,
) -> DLDRL:
    """
    :param allocator: SB3 zip of the allocator
    :param router: SB3 zip of the router
    :param decode: ``"greedy"``, ``"sampling"`` or ``"augment"``
    :param samples: Number of sampled allocations per instance
    :param device: Device of the networks
    :param batch_size: How many instances to solve at once; as many as memory allows when None
    :return: The solver
    :raises FileNotFoundError: If a zip is missing
    :raises ValueError: If a zip is damaged or holds another policy, or an argument is not allowed
    """
    networks = load_policy(allocator, device, AllocatorPolicy), load_policy(router, device, RouterPolicy)
    solver = DLDRL(*networks, decode, samples, batch_size)
    solver.files = {"allocator": Path(allocator), "router": Path(router)}
    return solver

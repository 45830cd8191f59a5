"""The trained pair as a solver: the allocator splits the tasks, the router plans every UAV's tour (paper, section IV)."""

from __future__ import annotations

import time
from typing import TypeVar

import numpy as np
import torch as th

from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy
from sb3_uav.policies.base import Cache
from sb3_uav.solvers.base import Solver, SolverResult

PolicyT = TypeVar("PolicyT", bound=EpisodicPolicy)

DECODINGS = ("greedy", "sampling")
# Allocations are drawn in blocks of this many per instance, each from random numbers of its own. So memory does not grow with
# the number of samples, and more samples only add to those that fewer would have drawn.
SAMPLE_BLOCK = 64


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


class DLDRL(Solver):
    """
    DL-DRL: an allocator and a router, both trained.

    What it finds for an instance depends on the seed and the row of the instance, not on ``batch_size`` (but for rounding
    errors of the networks). The router is always greedy.

    :param allocator: The upper level's policy
    :param router: The lower level's policy
    :param decode: ``"greedy"``, or ``"sampling"`` to keep the best of several sampled allocations
    :param samples: Number of sampled allocations per instance
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
        if batch_size is not None and batch_size < 1:
            raise ValueError(f"batch_size is {batch_size}; give at least 1.")
        self.allocator = allocator
        self.router = router
        self.decode = decode
        self.samples = samples
        self.batch_size = batch_size
        self.name = f"DL-DRL ({self._decoding})" if name is None else name

    @property
    def _decoding(self) -> str:
        return f"sampling {self.samples}" if self.decode == "sampling" else "greedy"

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

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        self.check(instances)
        self.allocator.set_training_mode(False)
        n_samples = SAMPLE_BLOCK if self.decode == "sampling" else 1
        fitting = self.allocator.rows_that_fit(instances.n_tasks + 1, n_samples * instances.n_uavs)
        batch_size = min(self.batch_size or fitting, fitting)
        results = []
        for rows in th.arange(len(instances)).split(batch_size):
            start = time.perf_counter()
            found = self._solve_batch(instances[rows], rows.tolist(), seed)
            seconds = (time.perf_counter() - start) / len(rows)
            results += [SolverResult(schedule, seconds, len(rows)) for schedule in found]
        return results

    def _solve_batch(self, instances: Instances, rows: list[int], seed: int) -> list[Schedule]:
        """
        :param instances: ``batch`` instances
        :param rows: Their indices in what is being solved
        :param seed: Of the samples
        :return: The best schedule found for each
        """
        n_tasks = max(int(instances.task_mask.sum(1).max()), 1)
        instances = instances.trim(n_tasks).to(self.allocator.device)
        with th.no_grad():
            cache = self.allocator.encode(instances)
        if self.decode == "greedy":
            planned = plan_tours(instances, self.allocator.decode_episodes(instances, cache=cache), self.router.plan)
            return schedules(planned.tours[:, 0])
        best_value = th.full((len(instances),), -th.inf, dtype=th.float64, device=instances.device)
        best = [Schedule([])] * len(instances)
        for first in range(0, self.samples, SAMPLE_BLOCK):
            n_samples = min(SAMPLE_BLOCK, self.samples - first)
            assignment = self._sample_block(instances, cache, rows, seed, first)[:, :n_samples]
            planned = plan_tours(instances, assignment, self.router.plan)
            value, sample = planned.value.max(1)
            tours = planned.tours[th.arange(len(instances), device=sample.device), sample]
            for row, (schedule, better) in enumerate(zip(schedules(tours), (value > best_value).tolist(), strict=True)):
                if better:
                    best[row] = schedule
            best_value = th.maximum(best_value, value)
        return best

    def _sample_block(self, instances: Instances, cache: Cache, rows: list[int], seed: int, first: int) -> th.Tensor:
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
            state = np.random.SeedSequence([seed, row, first]).generate_state(1, np.uint64)
            generator = th.Generator(instances.device).manual_seed(int(state[0] >> np.uint64(1)))
            own = Cache(cache.nodes[i : i + 1], tuple(projection[i : i + 1] for projection in cache.projections))
            blocks.append(self.allocator.decode_episodes(instances[i], SAMPLE_BLOCK, False, generator, own))
        return th.cat(blocks)

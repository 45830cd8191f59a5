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
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy
from sb3_uav.policies.base import Cache
from sb3_uav.policies.loading import load_policy
from sb3_uav.solvers.batched import BatchedSolver, parameters_hash

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


class DLDRL(BatchedSolver):
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
        super().__init__(batch_size)
        self.allocator = allocator
        self.router = router
        self.decode = decode
        self.samples = samples
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
        name = f"DL-DRL untrained{f' {seed}' if seed else ''} ({self._decoding})"
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
            state = np.random.SeedSequence([seed, row, first]).generate_state(1, np.uint64)
            generator = th.Generator(instances.device).manual_seed(int(state[0] >> np.uint64(1)))
            own = Cache(cache.nodes[i : i + 1], tuple(projection[i : i + 1] for projection in cache.projections))
            blocks.append(self.allocator.decode_episodes(instances[i], SAMPLE_BLOCK, False, generator, own))
        return th.cat(blocks)


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
    :param decode: ``"greedy"`` or ``"sampling"``
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

"""The trained pair as a solver: the allocator splits the tasks, the router plans every UAV's tour (paper, section IV)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import pair_files
from sb3_uav.solvers.decoding import DECODINGS, SAMPLE_BLOCK, Decoder
from sb3_uav.solvers.limits import deadline_after
from sb3_uav.solvers.network_solver import BatchedSolver, parameters_hash
from sb3_uav.solvers.postprocess import Refinement
from sb3_uav.solvers.shortlists import Shortlists


class DLDRL(BatchedSolver):
    """
    DL-DRL: a trained allocator and a trained router, with optional repair and polishing of their schedules.

    The schedule of an instance depends on the seed and on the row of the instance, but not on ``batch_size``, apart from
    rounding errors of the networks and from time limits. The router is greedy, except with ``"augment"``.

    :param allocator: The upper level's policy
    :param router: The lower level's policy
    :param decode: ``"greedy"``, ``"sampling"`` to keep the best of several sampled allocations, or ``"augment"`` to spend the
        samples on views of the instance (its symmetries) and on more tours for the UAVs of the best allocations. An allocator
        with ``sweep`` gets the tasks in both directions and from several starts, except with ``"greedy"``. With enough
        samples for all views, mirror images and quarter turns of an instance get the same schedules
    :param samples: Number of tours that are planned for every UAV of an instance
    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :param name: Label in tables and files; describes the decoding when None
    :param repair: Whether to repair the best of the schedules, see :func:`~sb3_uav.local_search.search.repair`; the result is
        never worse than repaired cheapest insertion
    :param polish: Seconds per instance for improving the best schedule, see :func:`~sb3_uav.solvers.postprocess.polish`
    :param time_limit: Seconds per instance in all, averaged over a batch, when :meth:`solve` is given none: a part of them
        limits the number of samples, the rest is for repair and polish
    :raises ImportError: If numba is needed and not installed
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
        repair: bool = False,
        polish: float = 0.0,
        time_limit: float | None = None,
    ) -> None:
        if decode not in DECODINGS:
            raise ValueError(f"decode is {decode!r}; choose one of {DECODINGS}.")
        if samples < 1:
            raise ValueError(f"samples is {samples}; give at least 1.")
        super().__init__(batch_size)
        self.allocator = allocator
        self.router = router
        self.serves_any_fleet = allocator.n_uavs is None
        self.remedy = "give networks with preset=whole, such as those of the pair 'world' (dl-drl:allocator=world)"
        self.solves_whole_problem = allocator.settings.whole and router.settings.whole
        self.decode = decode
        self.samples = samples
        self.refinement = Refinement(repair, polish)
        self.time_limit = time_limit
        # Decoding alone always ends.
        self.uses_time_limit = self.refinement.is_wanted or time_limit is not None
        self.name = f"DL-DRL ({self._decoding})" if name is None else name
        if time_limit is not None:
            deadline_after(time_limit, self.name)

    @property
    def _decoding(self) -> str:
        decoding = "greedy" if self.decode == "greedy" else f"{self.decode} {self.samples}"
        return decoding + self.refinement.label

    def untrained(self, seed: int = 0) -> DLDRL:
        """
        :param seed: Seed for the initial parameters
        :return: The same solver with networks of the same architecture that have learned nothing
        """
        allocator, router = self.allocator.untrained_copy(seed), self.router.untrained_copy(seed + 1)
        name = f"DL-DRL untrained{f' {seed}' if seed else ''} ({self._decoding})"
        refinement = (self.refinement.repair, self.refinement.polish, self.time_limit)
        return DLDRL(allocator, router, self.decode, self.samples, self.batch_size, name, *refinement)

    def check(self, instances: Instances) -> None:
        super().check(instances)
        self.allocator.check_fleet(instances)

    def settings(self) -> dict[str, Any]:
        networks = {"allocator": parameters_hash(self.allocator), "router": parameters_hash(self.router)}
        limit = {} if self.time_limit is None else {"time_limit": self.time_limit}
        return {**networks, "decoding": self._decoding, **limit}

    def rows_that_fit(self, instances: Instances) -> int:
        n_samples = 1 if self.decode == "greedy" else SAMPLE_BLOCK
        return self.allocator.rows_that_fit(instances.n_tasks + 1, n_samples * instances.n_uavs)

    def solve_batch(
        self, instances: Instances, rows: Sequence[int], seed: int, time_limit: float | None = None
    ) -> list[Schedule]:
        if time_limit is None or not self.uses_time_limit:
            time_limit = self.time_limit
        start, seconds = time.perf_counter(), math.inf
        if time_limit is not None:
            deadline_after(time_limit, self.name)
            seconds = time_limit * len(instances)
        share = 1.0 - self.refinement.share
        on_cpu, instances = instances, instances.to(self.allocator.device)
        first = self.refinement.first_candidates(on_cpu, start + seconds)
        for place, schedules in enumerate(first):
            for schedule in schedules:
                self._report(place, schedule)
        self.allocator.set_training_mode(False)
        decoder = Decoder(self.allocator, self.router, self.decode, self.samples)
        found = Shortlists(len(instances), self.refinement.n_candidates)
        # How long the first block takes is unknown; afterwards, no block is started that would probably end too late.
        before = time.perf_counter()
        for block in decoder.blocks(instances, rows, seed, hurry=time_limit is not None):
            found.add(block)
            if self.on_incumbent is not None:
                for place, schedules in enumerate(found.schedules()):
                    self._report(place, schedules[0])
            now = time.perf_counter()
            if now + (now - before) > start + share * seconds:
                break
            before = now
        candidates = [[*early, *late] for early, late in zip(first, found.schedules(), strict=True)]
        return self.refinement(on_cpu, candidates, start + seconds, seed, self._report)


def load_dl_drl(
    allocator: str | None = None,
    router: str | None = None,
    decode: str = "greedy",
    samples: int = 128,
    device: str = "auto",
    batch_size: int | None = None,
    repair: bool = False,
    polish: float = 0.0,
    time_limit: float | None = None,
) -> DLDRL:
    """
    :param allocator: SB3 zip of the allocator, or the name of a pair that comes with the package; the default pair when None
    :param router: SB3 zip of the router; that of the same pair when None
    :param decode: ``"greedy"``, ``"sampling"`` or ``"augment"``
    :param samples: Number of tours that are planned for every UAV of an instance
    :param device: Device of the networks
    :param batch_size: How many instances to solve at once; as many as memory allows when None
    :param repair: Whether to repair the best of the schedules
    :param polish: Seconds per instance for improving the best schedule
    :param time_limit: Seconds per instance in all
    :return: The solver
    :raises FileNotFoundError: If a zip is missing
    :raises ValueError: If a zip is damaged or holds another policy, or an argument is not allowed
    """
    files = pair_files(allocator, router)
    networks = load_policy(files[0], device, AllocatorPolicy), load_policy(files[1], device, RouterPolicy)
    solver = DLDRL(*networks, decode, samples, batch_size, None, repair, polish, time_limit)
    solver.files = dict(zip(("allocator", "router"), files, strict=True))
    return solver


def load_dl_drl_i(
    allocator: str,
    router: str,
    decode: str = "greedy",
    samples: int = 128,
    device: str = "auto",
    batch_size: int | None = None,
) -> DLDRL:
    """
    DL-DRL-I, whose router was not trained with the allocator: no such pair comes with the package.

    The parameters are those of :func:`load_dl_drl`.
    """
    return load_dl_drl(allocator, router, decode, samples, device, batch_size)

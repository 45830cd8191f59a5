"""The trained pair as a solver: the allocator splits the tasks, the router plans every UAV's tour (paper, section IV)."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from torch.nn import functional

from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import Router
from sb3_uav.envs.schedule import Schedule
from sb3_uav.envs.symmetries import N_SYMMETRIES, reflect
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import pair_files
from sb3_uav.solvers.limits import deadline_after
from sb3_uav.solvers.network_solver import BatchedSolver, parameters_hash
from sb3_uav.solvers.postprocess import Refinement

PolicyT = TypeVar("PolicyT", bound=EpisodicPolicy)

DECODINGS = ("greedy", "sampling", "augment")
# Allocations are drawn in blocks of this many per instance, each from random numbers of its own. So memory does not grow with
# the number of samples, and more samples only add to those that fewer would have drawn.
SAMPLE_BLOCK = 64
# An allocator that sweeps starts at several gaps between the tasks, in both directions: so the best of 128 samples found 0.6
# to 1.4 % more tasks than when all began at the widest one. The number of sweeps divides the sizes of blocks.
N_SWEEPS = 8
# Augmentation looks at an instance in so many views, all symmetries swept in both directions, then at samples in the same with
# sweeps from other gaps.
N_DIRECTIONS = 2
N_VIEWS = N_DIRECTIONS * N_SYMMETRIES
# It keeps a part of its samples back, to try more tours for the subsets of the best few allocations. Of 128 samples, 96
# allocations and 8 more tours for each of the best 4 found 0.6 to 1.7 % more tasks than 8 tours for each of 16 allocations.
N_REVISITED, REVISITED_PART = 4, 0.25
# Under a time limit less is done between two looks at the clock. Twice as many views overran one second at 1,000 tasks.
HURRIED_BLOCK, HURRIED_VIEWS = 16, 2


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
    DL-DRL: an allocator and a router, both trained; and what makes schedules better afterwards, if it is asked for.

    What it finds for an instance depends on the seed and the row of the instance, not on ``batch_size`` (but for rounding
    errors of the networks, and but for time limits). The router is greedy, except with ``"augment"``.

    :param allocator: The upper level's policy
    :param router: The lower level's policy
    :param decode: ``"greedy"``, ``"sampling"`` to keep the best of several sampled allocations, or ``"augment"`` to spend the
        samples on views of the instance (its symmetries) and on more tours for the UAVs of the best allocations. An allocator
        that wants the tasks swept gets them in both directions and from several starts, except with ``"greedy"``
    :param samples: Number of tours that are planned for every UAV of an instance
    :param batch_size: How many instances to solve at once; as many as memory allows when None, and never more
    :param name: How tables and files call it; says what it does when None
    :param repair: Whether to repair the best of the schedules, see :func:`~sb3_uav.local_search.search.repair`
    :param polish: For how many seconds per instance to go on from the best, see :func:`~sb3_uav.solvers.postprocess.polish`
    :param time_limit: Seconds per instance in all, on average over a batch, when :meth:`solve` is given none: a part of them
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
        self.decode = decode
        self.samples = samples
        self.refinement = Refinement(repair, polish)
        self.time_limit = time_limit
        # Plain networks come to an end by themselves.
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
        :param seed: Of the parameters
        :return: The same solver with networks of the same architecture that have learned nothing
        """
        allocator, router = freshly_initialised(self.allocator, seed), freshly_initialised(self.router, seed + 1)
        name = f"DL-DRL untrained{f' {seed}' if seed else ''} ({self._decoding})"
        refinement = (self.refinement.repair, self.refinement.polish, self.time_limit)
        return DLDRL(allocator, router, self.decode, self.samples, self.batch_size, name, *refinement)

    def check(self, instances: Instances) -> None:
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
        self.allocator.set_training_mode(False)
        found = Shortlists(len(instances), self.refinement.n_candidates)
        # Of a first block nothing is known; afterwards none is begun that would probably end too late.
        before = start
        for block in self._blocks(instances, rows, seed, hurry=time_limit is not None):
            found.add(block)
            now = time.perf_counter()
            if now + (now - before) > start + share * seconds:
                break
            before = now
        return self.refinement(on_cpu, found.schedules(), start + seconds, seed)

    def _blocks(self, instances: Instances, rows: Sequence[int], seed: int, hurry: bool) -> Iterator[Block]:
        """
        :param instances: ``batch`` instances on the allocator's device
        :param rows: Their indices in what is being solved
        :param seed: Of the samples
        :param hurry: Whether to begin with the greedy decoding and to draw fewer samples at once
        :return: Schedules for all instances, block by block
        """
        if self.decode == "greedy" or hurry:
            order = self.allocator.task_order(instances)
            arranged = instances.reorder(order)
            planned = plan_tours(arranged, self.allocator.decode_episodes(arranged), self.router.plan)
            yield Block(planned.value, tours_of_tasks(planned.tours, order))
        if self.decode == "sampling":
            size = HURRIED_BLOCK if hurry else SAMPLE_BLOCK
            views = [View(0, sweep) for sweep in range(N_SWEEPS if self.allocator.sweep else 1)]
            for first in range(0, self.samples, size):
                looks = [
                    self._look(instances[i], views, random_generator(instances, seed, row, first), size // len(views))
                    for i, row in enumerate(rows)
                ]
                yield self._plan([look.first(self.samples - first) for look in looks])
        elif self.decode == "augment":
            yield from self._views(instances, rows, seed, hurry)

    def _views(self, instances: Instances, rows: Sequence[int], seed: int, hurry: bool) -> Iterator[Block]:
        """
        :param instances: ``batch`` instances on the allocator's device
        :param rows: Their indices in what is being solved
        :param seed: Of the samples
        :param hurry: Whether to look at few views at once
        :return: Schedules of all views, the first of which have greedy allocations; at last more tours for the best of them
        """
        n_tours = int(REVISITED_PART * self.samples) // N_REVISITED
        # One more tour would be the greedy one again.
        n_allocations = self.samples - (N_REVISITED * n_tours if n_tours > 1 else 0)
        size = HURRIED_VIEWS if hurry else N_VIEWS
        values, assignments = [], []
        for first in range(0, n_allocations, size):
            views = [view_of(number) for number in range(first, min(first + size, n_allocations))]
            looks = [
                self._look(instances[i], views, random_generator(instances, seed, row, first), int(first >= N_VIEWS))
                for i, row in enumerate(rows)
            ]
            block = self._plan(looks)
            values.append(block.value)
            assignments.append(th.stack([look.in_input_order() for look in looks]))
            yield block
        if n_tours > 1:
            best = th.cat(values, dim=1).sort(dim=1, descending=True, stable=True).indices[:, :N_REVISITED]
            assignment = th.cat(assignments, dim=1)
            blocks = []
            for i, row in enumerate(rows):
                generator = random_generator(instances, seed, row, self.samples)
                again = plan_tours(instances[i], assignment[i, best[i]][None], self._several_tours(n_tours, generator))
                blocks.append(Block(again.value, again.tours))
            yield Block.concatenate(blocks)

    def _several_tours(self, n_tours: int, generator: th.Generator) -> Router:
        """
        :param n_tours: How many tours to try for each subset
        :param generator: The source of randomness
        """
        return lambda subsets: self.router.plan(subsets, None, n_tours, generator)

    def _look(self, instance: Instances, views: Sequence[View], generator: th.Generator, n_samples: int = 0) -> Allocations:
        """
        :param instance: A batch of one on the allocator's device
        :param views: How to look at it
        :param generator: The source of randomness
        :param n_samples: How many allocations to sample in each view; 0 to decode one greedily
        :return: First a sample of each view, then a second one of each, and so on
        """
        shown = [reflect(instance, view.symmetry) for view in views]
        orders = th.cat([self.allocator.task_order(seen, view.sweep) for view, seen in zip(views, shown, strict=True)])
        arranged = Instances.concatenate(shown).reorder(orders)
        assignment = self.allocator.decode_episodes(arranged, max(n_samples, 1), n_samples == 0, generator)
        view = th.arange(len(views), device=orders.device).repeat(assignment.shape[1])
        return Allocations(arranged[view], orders[view], assignment.transpose(0, 1).flatten(0, 1))

    def _plan(self, looks: Sequence[Allocations]) -> Block:
        """
        :param looks: Equally many allocations of each instance
        :return: Their schedules
        """
        instances, order = Instances.concatenate([look.instances for look in looks]), th.cat([look.order for look in looks])
        planned = plan_tours(instances, th.cat([look.assignment for look in looks])[:, None], self.router.plan)
        tours = tours_of_tasks(planned.tours, order)
        return Block(planned.value.view(len(looks), -1), tours.view(len(looks), -1, *tours.shape[2:]))


def view_of(number: int) -> View:
    """
    :param number: Of an allocation in augmentation, from 0
    :return: How the allocator looks at it: after all symmetries in both directions, the sweep starts at another gap
    """
    turn, number = divmod(number, N_VIEWS)
    return View(number // N_DIRECTIONS, turn * N_DIRECTIONS + number % N_DIRECTIONS)


class View(NamedTuple):
    """
    A way to look at an instance.

    :param symmetry: Of the square, 0 for none
    :param sweep: Where the sweep starts and in which direction, as of the allocator's ``task_order``
    """

    symmetry: int
    sweep: int


class Allocations(NamedTuple):
    """
    Several allocations of one instance.

    :param instances: ``n_allocations`` times the instance, as the allocator saw it
    :param order: ``(n_allocations, n_tasks)`` int64, which task stands in each place
    :param assignment: ``(n_allocations, n_tasks)`` int64, the UAV of the task in each place
    """

    instances: Instances
    order: th.Tensor
    assignment: th.Tensor

    def first(self, n_allocations: int) -> Allocations:
        """
        :param n_allocations: How many to keep
        :return: Only these
        """
        return Allocations(self.instances[:n_allocations], self.order[:n_allocations], self.assignment[:n_allocations])

    def in_input_order(self) -> th.Tensor:
        """:return: ``(n_allocations, n_tasks)`` int64, the UAV of each task"""
        return th.empty_like(self.assignment).scatter_(1, self.order, self.assignment)


class Block(NamedTuple):
    """
    Some schedules of every instance.

    :param value: ``(batch, n_schedules)`` float64
    :param tours: ``(batch, n_schedules, n_uavs, n_steps)`` int64, tasks in the order of the input, -1 as padding
    """

    value: th.Tensor
    tours: th.Tensor

    @classmethod
    def concatenate(cls, blocks: Sequence[Block]) -> Block:
        """:param blocks: Of different instances with equally many UAVs, each with equally many schedules"""
        n_steps = max(block.tours.shape[-1] for block in blocks)
        padded = [functional.pad(block.tours, (0, n_steps - block.tours.shape[-1]), value=-1) for block in blocks]
        return cls(th.cat([block.value for block in blocks]), th.cat(padded))


class Shortlists:
    """
    The best schedules of every instance so far.

    :param n_instances: Number of instances
    :param length: How many to keep of each
    """

    def __init__(self, n_instances: int, length: int) -> None:
        self.length = length
        self._found: list[dict[Schedule, float]] = [{} for _ in range(n_instances)]

    def add(self, block: Block) -> None:
        """:param block: More schedules of the same instances"""
        values, order = block.value.sort(dim=1, descending=True, stable=True)
        for found, tours, value, places in zip(self._found, block.tours, values.tolist(), order, strict=True):
            worst = min(found.values()) if len(found) >= self.length else -math.inf
            new: dict[Schedule, float] = {}
            for place, objective in zip(places, value, strict=True):
                if objective <= worst or len(new) == self.length:
                    break
                new.setdefault(schedules(tours[place, None])[0], objective)
            # This sort is stable too: of equal ones, those that were there before stay.
            best = sorted((found | new).items(), key=lambda item: -item[1])
            found.clear()
            found.update(best[: self.length])

    def schedules(self) -> list[list[Schedule]]:
        """:return: For each instance, the best first"""
        return [list(found) for found in self._found]


def random_generator(instances: Instances, *seed: int) -> th.Generator:
    """
    :param instances: On the device where random numbers are needed
    :param seed: What the random numbers depend on
    """
    state = np.random.SeedSequence(seed).generate_state(1, np.uint64)
    return th.Generator(instances.device).manual_seed(int(state[0] >> np.uint64(1)))


def tours_of_tasks(tours: th.Tensor, order: th.Tensor) -> th.Tensor:
    """
    :param tours: ``(batch, n_samples, n_uavs, n_steps)`` int64, places of tasks in the order, -1 as padding
    :param order: ``(batch, n_tasks)`` int64, which task stands in each place
    :return: The tours with the tasks themselves
    """
    tasks = order.gather(1, tours.clamp(min=0).flatten(1)).view_as(tours)
    return tasks.masked_fill(tours < 0, -1)


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
    :param polish: For how many seconds per instance to go on from the best
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

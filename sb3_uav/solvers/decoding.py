"""Decoding a pair of networks: one greedy allocation, several samples, or several views of the same instance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_uav.common.random_streams import mixed_state
from sb3_uav.envs.allocation import plan_tours
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import Router
from sb3_uav.envs.symmetries import N_SYMMETRIES, combine, reflect, standard_pose
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.solvers.seen_instances import SeenInstance, Shown, View
from sb3_uav.solvers.shortlists import Block

DECODINGS = ("greedy", "sampling", "augment")
# Allocations are drawn in blocks of this many per instance, each from its own random numbers: memory does not grow with the
# number of samples, and a larger number only adds to the samples of a smaller one.
SAMPLE_BLOCK = 64
# An allocator with sweep starts at several gaps between the tasks, in both directions: the best of 128 samples then found 0.6
# to 1.4 % more tasks than with the widest gap alone. The number of sweeps divides the block sizes.
_N_SWEEPS = 8
# Number of views in augmentation before the sweep starts at another gap: all symmetries, swept in both directions.
_N_DIRECTIONS = 2
_N_VIEWS = _N_DIRECTIONS * N_SYMMETRIES
# It reserves a part of its samples for more tours of the best few allocations. With 128 samples, 96 allocations and 8 more
# tours for each of the best 4 found 0.6 to 1.7 % more tasks than 8 tours for each of 16 allocations.
_N_REVISITED, REVISITED_PART = 4, 0.25
# Under a time limit, blocks are smaller, so that the clock is read more often: twice as many views overran one second at
# 1,000 tasks.
_HURRIED_BLOCK, _HURRIED_VIEWS = 16, 2


def _view_of(number: int, pose: int = 0) -> View:
    """
    :param number: Number of an allocation in augmentation, from 0
    :param pose: Symmetry to begin with
    :return: Its view: after all symmetries in both directions, the sweep starts at another gap
    """
    turn, number = divmod(number, _N_VIEWS)
    return View(combine(pose, number // _N_DIRECTIONS), turn * _N_DIRECTIONS + number % _N_DIRECTIONS)


class Allocations(NamedTuple):
    """
    Several allocations of one instance, tasks in the order of the input.

    :param instances: The instance, repeated ``n_allocations`` times, with the symmetry that the allocator saw
    :param symmetry: ``(n_allocations,)`` int64, that symmetry
    :param assignment: ``(n_allocations, n_tasks)`` int64, the UAV of each task
    """

    instances: Instances
    symmetry: th.Tensor
    assignment: th.Tensor

    def first(self, n_allocations: int) -> Allocations:
        """
        :param n_allocations: How many to keep
        :return: The first of the allocations
        """
        return Allocations(self.instances[:n_allocations], self.symmetry[:n_allocations], self.assignment[:n_allocations])


class Decoder:
    """
    Turns instances into schedules, block by block.

    :param allocator: The upper level's policy
    :param router: The lower level's policy
    :param decode: One of :data:`DECODINGS`
    :param samples: Number of tours that are planned for every UAV of an instance, except with ``"greedy"``
    """

    def __init__(self, allocator: AllocatorPolicy, router: RouterPolicy, decode: str, samples: int) -> None:
        self.allocator = allocator
        self.router = router
        self.decode = decode
        self.samples = samples

    def blocks(self, instances: Instances, rows: Sequence[int], seed: int, hurry: bool) -> Iterator[Block]:
        """
        :param instances: ``batch`` instances on the allocator's device
        :param rows: Their row indices in the solved batch
        :param seed: Seed for sampling
        :param hurry: Whether to start with greedy decoding and to use smaller blocks
        :return: Schedules for all instances, block by block
        """
        if self.decode == "greedy" or hurry:
            order = self.allocator.task_order(instances)
            arranged = instances.reorder(order)
            planned = plan_tours(arranged, self.allocator.decode_episodes(arranged), self.router.plan)
            yield Block(planned.value, _tours_of_tasks(planned.tours, order))
        if self.decode == "sampling":
            size = _HURRIED_BLOCK if hurry else SAMPLE_BLOCK
            views = [View(0, sweep) for sweep in range(_N_SWEEPS if self.allocator.sweep else 1)]
            shown = [seen.show(views) for seen in self._seen(instances)]
            for first in range(0, self.samples, size):
                looks = [
                    self.look(views_of_row, _random_generator(instances, seed, row, first), size // len(views))
                    for views_of_row, row in zip(shown, rows, strict=True)
                ]
                yield self._plan([look.first(self.samples - first) for look in looks])
        elif self.decode == "augment":
            yield from self._views(instances, rows, seed, hurry)

    def _views(self, instances: Instances, rows: Sequence[int], seed: int, hurry: bool) -> Iterator[Block]:
        """
        :param instances: ``batch`` instances on the allocator's device
        :param rows: Their row indices in the solved batch
        :param seed: Seed for sampling
        :param hurry: Whether to use smaller blocks
        :return: Schedules of all views, the first of which have greedy allocations; then more tours for the best allocations
        """
        n_tours = int(REVISITED_PART * self.samples) // _N_REVISITED
        # A single tour would repeat the greedy one.
        n_allocations = self.samples - (_N_REVISITED * n_tours if n_tours > 1 else 0)
        size = _HURRIED_VIEWS if hurry else _N_VIEWS
        values, assignments = [], []
        # Mirror images get the same random numbers in the same views. Too few samples for all views start with the instance
        # as it is, so that they are not worse than the greedy allocation.
        poses = standard_pose(instances) if n_allocations >= _N_VIEWS else [0] * len(instances)
        seen = self._seen(instances)
        for first in range(0, n_allocations, size):
            numbers = range(first, min(first + size, n_allocations))
            looks = [
                self.look(
                    instance.show([_view_of(number, pose) for number in numbers]),
                    _random_generator(instances, seed, row, first),
                    int(first >= _N_VIEWS),
                )
                for instance, pose, row in zip(seen, poses, rows, strict=True)
            ]
            block = self._plan(looks)
            values.append(block.value)
            assignments.append(th.stack([look.assignment for look in looks]))
            yield block
        if n_tours > 1:
            best = th.cat(values, dim=1).sort(dim=1, descending=True, stable=True).indices[:, :_N_REVISITED]
            assignment = th.cat(assignments, dim=1)
            blocks = []
            for i, row in enumerate(rows):
                generator = _random_generator(instances, seed, row, self.samples)
                standing = reflect(instances[i], poses[i])
                again = plan_tours(standing, assignment[i, best[i]][None], self._several_tours(n_tours, generator))
                blocks.append(Block(again.value, again.tours))
            yield Block.concatenate(blocks)

    def _several_tours(self, n_tours: int, generator: th.Generator) -> Router:
        """
        :param n_tours: How many tours to try for each subset
        :param generator: The source of randomness
        :return: A router that tries them
        """
        return lambda subsets: self.router.plan(subsets, None, n_tours, generator)

    def _seen(self, instances: Instances) -> list[SeenInstance]:
        return [SeenInstance(self.allocator, instances[i]) for i in range(len(instances))]

    def look(self, shown: Shown, generator: th.Generator, n_samples: int = 0) -> Allocations:
        """
        :param shown: An instance in several views
        :param generator: The source of randomness
        :param n_samples: How many allocations to sample in each view; 0 to decode one greedily
        :return: The first sample of each view, then the second of each, and so on
        """
        assignment = self.allocator.decode_episodes(shown.instances, max(n_samples, 1), n_samples == 0, generator, shown.cache)
        view = th.arange(len(shown.order), device=assignment.device).repeat(assignment.shape[1])
        in_places = assignment.transpose(0, 1).flatten(0, 1)
        in_input_order = th.empty_like(in_places).scatter_(1, shown.order[view], in_places)
        return Allocations(shown.reflected[view], shown.symmetry[view], in_input_order)

    def _plan(self, looks: Sequence[Allocations]) -> Block:
        """
        :param looks: Allocations of each instance, equally many
        :return: Their schedules
        """
        instances = Instances.concatenate([look.instances for look in looks])
        assignment = th.cat([look.assignment for look in looks])[:, None]
        # Allocations in the same view share subsets, whatever the sweep.
        copy_of = th.cat([N_SYMMETRIES * number + look.symmetry for number, look in enumerate(looks)])
        planned = plan_tours(instances, assignment, self.router.plan, copy_of)
        return Block(planned.value.view(len(looks), -1), planned.tours.view(len(looks), -1, *planned.tours.shape[2:]))


def _random_generator(instances: Instances, *seed: int) -> th.Generator:
    """
    :param instances: Instances on the device where random numbers are needed
    :param seed: Numbers that the random numbers depend on
    :return: The source of randomness
    """
    return th.Generator(instances.device).manual_seed(int(mixed_state(*seed) >> np.uint64(1)))


def _tours_of_tasks(tours: th.Tensor, order: th.Tensor) -> th.Tensor:
    """
    :param tours: ``(batch, n_samples, n_uavs, n_steps)`` int64, places of tasks in the order, -1 as padding
    :param order: ``(batch, n_tasks)`` int64, which task stands in each place
    :return: The tours with the tasks themselves
    """
    tasks = order.gather(1, tours.clamp(min=0).flatten(1)).view_as(tours)
    return tasks.masked_fill(tours < 0, -1)

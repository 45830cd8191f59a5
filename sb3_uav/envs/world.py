"""A mixture of what real problems are like: maps, values, fleets, ranges and service costs of many kinds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_uav.distributions.layouts import DEPOTS, LAYOUTS, draw_depots, draw_tasks, log_uniform, places_among
from sb3_uav.distributions.task_values import VALUES, draw_values
from sb3_uav.envs.compaction import compact
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.sizes import check_size, n_instances_of

# Where UAVs start and end, and how often where fleets may differ from the paper's: in the depot; each in one of several
# depots; in the depot, and in other places; anywhere in the air, with a part of the range left, and in the depot.
SITES = {"one depot": 0.4, "several depots": 0.2, "open": 0.2, "in the air": 0.2}
# What serving a task costs, and how often, in the same rows.
SERVICES = {"none": 0.5, "constant": 0.25, "varying": 0.25}
# How often the ranges of UAVs differ in these rows; in the air they always do.
_UNEQUAL = 0.35
# Smallest range of a UAV, as a part of the largest: of unequal UAVs, and in the air.
_LEAST_RANGE, _LEAST_LEFT = 0.4, 0.2
# How often a UAV in the air cannot reach the depot any more; and the least range of others beyond the way from start to end.
_GROUNDED, _SPARE = 0.03, 1.05
# Part of a tour's length that goes into service costs.
_SERVICE_PARTS = (0.05, 0.5)
# Part of the tasks that the range is made for; above 1, the range is larger than all tasks need.
_SHARES = (0.08, 1.15)
# Even if all tasks lie in the depot, UAVs fly a hundredth of the map.
_LEAST_LENGTH = 0.01
# An optimal tour is about so long, relative to one along a space-filling curve.
_CURVE = 0.8
# The paper's range, in sides of its square. Half of its rows have that, the others so many times as much.
_PAPER_RANGE, _PAPER_FACTORS = 2.0, (0.6, 1.6)
# With fewer tasks per UAV, the paper's range would be enough for all.
_PAPER_TASKS_PER_UAV = 12
# Smallest number of tasks per UAV in training.
_TASKS_PER_UAV = 4
# How often a training batch has a single UAV, from which an allocator learns nothing and a router how to plan long tours.
_SOLO = 0.12
# How often tasks that no UAV can reach are left out of a training batch, as solvers do before networks see an instance.
_COMPACT = 0.75
# Bits of each coordinate on the space-filling curve.
_CURVE_BITS = 10


class Kinds(NamedTuple):
    """
    What was drawn for each row; every array is ``(batch,)``.

    :param layout: Names of :data:`~sb3_uav.distributions.layouts.LAYOUTS`
    :param depot: Names of :data:`~sb3_uav.distributions.layouts.DEPOTS`
    :param values: Names of :data:`~sb3_uav.distributions.task_values.VALUES`
    :param site: Names of :data:`SITES`
    :param service: Names of :data:`SERVICES`
    :param unequal: bool, whether ranges differ
    :param paper: bool, whether the row is one of the paper's distribution
    :param share: float64, which part of the tasks the range is made for
    """

    layout: np.ndarray
    depot: np.ndarray
    values: np.ndarray
    site: np.ndarray
    service: np.ndarray
    unequal: np.ndarray
    paper: np.ndarray
    share: np.ndarray


class _Fleet(NamedTuple):
    """
    :param start: ``(batch, n_uavs, 2)``
    :param end: ``(batch, n_uavs, 2)``
    :param part: ``(batch, n_uavs)``, range of each UAV relative to the mean of its row
    :param grounded: ``(batch, n_uavs)`` bool, never the first
    """

    start: np.ndarray
    end: np.ndarray
    part: np.ndarray
    grounded: np.ndarray


@dataclass(frozen=True)
class WorldGenerator:
    """
    Instances of every kind, drawn row by row: uniform, clustered and mixed maps, lattices, strips and rings; equal values,
    whole numbers, heavy tails, values that grow with the distance, one dear task far out, a few urgent ones; depots inside, in
    a corner and outside; ranges for a tenth of the tasks up to all of them. In some rows there are several depots, open ends,
    UAVs in the air with a part of their range, unequal ranges and service costs. A part of the rows is the paper's
    distribution.

    A unit of length means nothing to a map, so every instance is scaled to the same range of the UAV that flies farthest. The
    mean value of a row is 1, for the same reason. No task must be served: solvers turn that into values, which is the kind
    "urgent".

    Called directly, it draws instances of the largest size. :meth:`training_batch` and :meth:`batches` draw sizes too.

    :param n_tasks: Largest number of tasks
    :param n_uavs: Largest fleet
    :param max_distance: Range of the UAV that flies farthest
    :param min_tasks: Smallest number of tasks of a training batch
    :param min_uavs: Smallest fleet of a training batch; with 1, an eighth of the batches have a single UAV
    :param whole_share: Part of the rows, and of the training batches, in which fleets may differ from the paper's and serving
        a task may cost something; in the others UAVs are equal and only maps, values and ranges vary
    :param paper_share: Part of the rows that are drawn from the paper's distribution
    :raises ValueError: If a size or a share is not allowed
    """

    n_tasks: int = 1000
    n_uavs: int = 10
    max_distance: float = 2.0
    min_tasks: int = 20
    min_uavs: int = 1
    whole_share: float = 0.5
    paper_share: float = 0.15

    def __post_init__(self) -> None:
        check_size(self.n_tasks, self.n_uavs, self.max_distance)
        for name in ("min_tasks", "min_uavs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; give at least 1.")
        for name in ("whole_share", "paper_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; give a number from 0 to 1.")

    @property
    def beyond_the_paper(self) -> bool:
        """Whether some rows have starts, ends and ranges of their own, or service costs."""
        return self.whole_share > 0

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        return self.draw(batch_size, rng)[0]

    def draw(self, batch_size: int, rng: np.random.Generator) -> tuple[Instances, Kinds]:
        """
        :param batch_size: Number of instances
        :param rng: Random generator
        :return: Instances of the largest size, and of which kinds they are
        """
        kinds = self._kinds(batch_size, rng.random(batch_size) < self.whole_share, rng)
        return self._instances(kinds, self.n_tasks, self.n_uavs, rng), kinds

    def training_batch(self, batch_size: int, rng: np.random.Generator) -> Instances:
        """
        Instances of one random size. The logarithms of both sizes are uniform, with at least four tasks per UAV where there
        are so many.

        In most batches, tasks that no UAV can reach are left out, and shorter rows are padded at the end.

        :param batch_size: Number of instances of the smallest size; batches of larger sizes have fewer
        :param rng: Random generator
        :return: The instances
        """
        n_uavs = _log_uniform_integer(rng, min(max(self.min_uavs, 2), self.n_uavs), self.n_uavs)
        if self.min_uavs == 1 and rng.random() < _SOLO:
            n_uavs = 1
        least = min(self.min_tasks, self.n_tasks)
        n_tasks = _log_uniform_integer(rng, min(max(least, _TASKS_PER_UAV * n_uavs), self.n_tasks), self.n_tasks)
        n_rows = n_instances_of(batch_size, least, n_tasks)
        # All or none of the rows: a fleet of equal UAVs is quicker to compute with.
        is_whole = np.full(n_rows, rng.random() < self.whole_share)
        instances = self._instances(self._kinds(n_rows, is_whole, rng), n_tasks, n_uavs, rng)
        if rng.random() < _COMPACT:
            reachable = instances.reachable()
            if not reachable.all():
                instances, _ = compact(instances, reachable)
        return instances

    def batches(self, batch_size: int, rng: np.random.Generator, n_batches: int | None = None) -> Iterator[Instances]:
        """
        :param batch_size: As of :meth:`training_batch`
        :param rng: Random generator
        :param n_batches: How many batches; None for no end
        :return: Training batches, each of its own size
        """
        n_drawn = 0
        while n_batches is None or n_drawn < n_batches:
            yield self.training_batch(batch_size, rng)
            n_drawn += 1

    def _kinds(self, n_rows: int, is_whole: np.ndarray, rng: np.random.Generator) -> Kinds:
        """
        :param n_rows: Number of rows
        :param is_whole: ``(n_rows,)`` bool, where fleets and service costs may be any
        :param rng: Random generator
        :return: What to draw
        """

        def choose(odds: dict[str, float]) -> np.ndarray:
            weights = np.array(list(odds.values()))
            return rng.choice(np.array(list(odds)), n_rows, p=weights / weights.sum())

        paper = rng.random(n_rows) < self.paper_share
        is_whole = is_whole & ~paper
        site = np.where(is_whole, choose(SITES), "one depot")
        return Kinds(
            layout=np.where(paper, "uniform", choose({name: odds for name, (_, odds) in LAYOUTS.items()})),
            depot=np.where(paper, "random", choose(DEPOTS)),
            values=np.where(paper, "unit", choose({name: odds for name, (_, odds) in VALUES.items()})),
            site=site,
            service=np.where(is_whole, choose(SERVICES), "none"),
            unequal=is_whole & ((rng.random(n_rows) < _UNEQUAL) | (site == "in the air")),
            paper=paper,
            share=rng.uniform(*_SHARES, n_rows),
        )

    def _instances(self, kinds: Kinds, n_tasks: int, n_uavs: int, rng: np.random.Generator) -> Instances:
        """
        :param kinds: What to draw
        :param n_tasks: Number of tasks
        :param n_uavs: Number of UAVs
        :param rng: Random generator
        :return: The instances
        """
        tasks = draw_tasks(kinds.layout, n_tasks, rng)
        depot = draw_depots(kinds.depot, tasks, rng)
        # The paper's depot is anywhere in the square, not in the box around the tasks.
        depot = np.where(kinds.paper[:, None], rng.random(depot.shape), depot)
        values = draw_values(kinds.values, _distances(tasks, depot[:, None]), rng)
        fleet = _draw_fleet(kinds, depot, tasks, n_uavs, rng)
        ranges, service = _draw_ranges(kinds, tasks, fleet, rng)
        # Every other map is turned, the paper's never.
        angle = rng.uniform(0, 2 * np.pi, len(tasks)) * (rng.random(len(tasks)) < 0.5) * ~kinds.paper
        scale = self.max_distance / ranges.max(1)
        ranges = np.where(ranges == ranges.max(1, keepdims=True), self.max_distance, ranges * scale[:, None])
        depot, start, end, tasks = (
            _turned(points, angle) * scale[:, None, None] for points in (depot[:, None], fleet.start, fleet.end, tasks)
        )

        def tensor(array: np.ndarray) -> th.Tensor:
            return th.from_numpy(np.ascontiguousarray(array))

        return Instances(
            depot=tensor(depot[:, 0]),
            tasks=tensor(tasks),
            values=tensor(values),
            max_distance=tensor(ranges[:, 0] if (ranges == ranges[:, :1]).all() else ranges),
            n_uavs=n_uavs,
            task_mask=th.ones(tasks.shape[:2], dtype=th.bool, device="cpu"),
            start=None if (start == depot).all() else tensor(start),
            end=None if (end == depot).all() else tensor(end),
            service=None if (service == 0).all() else tensor(service * scale[:, None]),
        )


def _log_uniform_integer(rng: np.random.Generator, low: int, high: int) -> int:
    """:return: A number from ``low`` to ``high`` whose logarithm is about uniform"""
    return min(int(log_uniform(rng, low, high + 1, (1,))[0]), high)


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances over the last dimension, of size 2."""
    return np.hypot(*np.moveaxis(a - b, -1, 0))


def _turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """
    :param points: ``(batch, n, 2)``
    :param angle: ``(batch,)``, 0 for rows that stay as they are
    :return: The points, turned around the origin
    """
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _draw_fleet(kinds: Kinds, depot: np.ndarray, tasks: np.ndarray, n_uavs: int, rng: np.random.Generator) -> _Fleet:
    """
    :param kinds: What to draw
    :param depot: ``(batch, 2)``
    :param tasks: ``(batch, n_tasks, 2)``
    :param n_uavs: Number of UAVs
    :param rng: Random generator
    :return: The fleet
    """
    n_rows, shape = len(depot), (len(depot), n_uavs)
    home = np.broadcast_to(depot[:, None], (*shape, 2))
    places = places_among(tasks, n_uavs, rng)
    # The depot and up to three others, each with a UAV.
    bases = np.concatenate([depot[:, None], places], axis=1)
    n_bases = rng.integers(min(2, n_uavs), min(4, n_uavs), (n_rows, 1), endpoint=True)
    uav = np.arange(n_uavs)
    base = np.where(uav < n_bases, uav, (rng.random(shape) * n_bases).astype(np.int64))
    based = np.take_along_axis(bases, base[..., None], axis=1)
    # All land in the same place, or each in its own.
    landing = np.where(rng.random((n_rows, 1, 1)) < 0.5, places[:, :1], places)
    is_several, is_open, is_flying = ((kinds.site == name)[:, None, None] for name in ("several depots", "open", "in the air"))
    least = np.where(is_flying[..., 0], _LEAST_LEFT, _LEAST_RANGE)
    part = np.where(kinds.unequal[:, None], least + (1 - least) * rng.random(shape), 1.0)
    return _Fleet(
        start=np.where(is_several, based, np.where(is_flying, places, home)),
        end=np.where(is_several, based, np.where(is_open, landing, home)),
        part=part / part.mean(1, keepdims=True),
        grounded=is_flying[..., 0] & (rng.random(shape) < _GROUNDED) & (uav > 0),
    )


def _draw_ranges(kinds: Kinds, tasks: np.ndarray, fleet: _Fleet, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """
    :param kinds: What to draw
    :param tasks: ``(batch, n_tasks, 2)``
    :param fleet: The fleet
    :param rng: Random generator
    :return: Ranges ``(batch, n_uavs)`` and service costs ``(batch, n_tasks)``. At least one task of each row is in reach
    """
    n_rows, n_tasks, n_uavs = *tasks.shape[:2], fleet.part.shape[1]
    straight = _distances(fleet.start, fleet.end)
    # Length of a flight of each UAV to each task and on.
    flights = _distances(fleet.start[:, :, None], tasks[:, None]) + _distances(tasks[:, None], fleet.end[:, :, None])
    nearest = flights.min(1)
    served = np.maximum(np.ceil(np.minimum(kinds.share, 1.0) * n_tasks), 1.0)[:, None]
    is_served = nearest.argsort(1, kind="stable").argsort(1) < served
    # The nearest tasks, shared out among the UAVs, and the ways there and back.
    length = _CURVE * _curve_length(tasks, is_served) / n_uavs + (nearest * is_served).sum(1) / served[:, 0]
    length = np.maximum(length, _SPARE * (nearest * is_served).max(1)) * np.maximum(kinds.share, 1.0)
    length = np.maximum(length, _LEAST_LENGTH)
    factor = np.where(rng.random(n_rows) < 0.5, 1.0, rng.uniform(*_PAPER_FACTORS, n_rows))
    is_paper = kinds.paper & (n_tasks >= _PAPER_TASKS_PER_UAV * n_uavs)
    length = np.where(is_paper, _PAPER_RANGE * factor, length)
    part = rng.uniform(*_SERVICE_PARTS, n_rows) * (kinds.service != "none")
    length = length / (1 - part)
    cost = np.where((kinds.service == "varying")[:, None], rng.uniform(0, 2, (n_rows, n_tasks)), 1.0)
    service = cost * (part * length * n_uavs / served[:, 0])[:, None]

    ranges = np.where(fleet.grounded, 0.0, np.maximum(length[:, None] * fleet.part, _SPARE * straight))
    need = (flights + service[:, None]).min(2) / np.maximum(ranges, 1e-12)
    need[fleet.grounded] = np.inf
    ranges *= np.maximum(_SPARE * need.min(1, keepdims=True), 1.0)
    # Half of what they need to get home.
    return np.where(fleet.grounded, 0.5 * straight, ranges), service


def _curve_length(points: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """
    :param points: ``(batch, n, 2)``
    :param kept: ``(batch, n)`` bool, those to visit
    :return: ``(batch,)``, length of the paths through them in the order of a Hilbert curve
    """
    low, high = points.min(1, keepdims=True), points.max(1, keepdims=True)
    side = np.maximum((high - low).max(2, keepdims=True), 1e-12)
    x, y = np.moveaxis(((points - low) / side * (2**_CURVE_BITS - 1)).astype(np.int64), -1, 0)
    place = np.zeros_like(x)
    for bit in reversed(range(_CURVE_BITS)):
        right, up = x >> bit & 1, y >> bit & 1
        place += ((3 * right) ^ up) << 2 * bit
        # The quadrant's own curve is reflected and turned.
        flip = (up == 0) & (right == 1)
        size = (1 << bit) - 1
        x, y = np.where(flip, size - (x & size), x & size), np.where(flip, size - (y & size), y & size)
        x, y = np.where(up == 0, y, x), np.where(up == 0, x, y)
    order = np.where(kept, place, np.iinfo(np.int64).max).argsort(1, kind="stable")
    path = np.take_along_axis(points, order[..., None], axis=1)
    legs = _distances(path[:, 1:], path[:, :-1])
    return (legs * (np.arange(1, points.shape[1]) < kept.sum(1, keepdims=True))).sum(1)

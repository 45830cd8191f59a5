"""The mixed-integer linear program of the paper (its equations (1) to (8)), solved by HiGHS or by Gurobi."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.solvers.base import NoScheduleError, Solution
from sb3_uav.solvers.limits import TimeLimitedSolver
from sb3_uav.solvers.programs import BACKENDS, Program, Rows

# Tasks nearer to each other than this, in units of the maximum flight distance, are one place.
COINCIDENT = 1e-12
# By how much a tour may exceed 1: less than the reduction leaves of the checker's tolerance.
_LENGTH_TOLERANCE = 1e-13


class _Places(NamedTuple):
    """
    The distinct positions of the tasks; ``n`` of them are not the depot.

    :param nodes: Nodes of the reduced instance at the depot (without the depot itself), then those at each place
    :param distances: ``(n + 1, n + 1)``, between the depot and the places
    :param values: ``(n,)``, total value of each place
    """

    nodes: list[list[int]]
    distances: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, reduced: ReducedInstance) -> _Places:
        """
        :param reduced: The reduced instance
        :return: Its places
        """
        # Of every node, the first that it coincides with; chains of them are one place.
        owner = (reduced.distances <= COINCIDENT).argmax(1)
        while (owner[owner] != owner).any():
            owner = owner[owner]
        kept, place_of = np.unique(owner, return_inverse=True)
        nodes: list[list[int]] = [[] for _ in kept]
        for node, place in enumerate(place_of[1:].tolist(), start=1):
            nodes[place].append(node)
        values = np.bincount(place_of[1:], weights=reduced.values, minlength=len(kept))
        return cls(nodes, reduced.distances[np.ix_(kept, kept)], values[1:])

    def tour_value(self, tour: Sequence[int]) -> float:
        return math.fsum(self.values[place - 1] for place in tour if place > 0)

    def is_tour(self, cycle: Sequence[int]) -> bool:
        """Whether a cycle of places goes through the depot and is short enough."""
        length = math.fsum(self.distances[a, b] for a, b in pairwise((*cycle, cycle[0])))
        return 0 in cycle and length <= 1 + _LENGTH_TOLERANCE


class MILP(TimeLimitedSolver):
    """
    The paper's three-index model, by branch and bound.

    It is built for what makes it exact: without tasks that no UAV can reach, for which (8) has no solution; with coincident
    tasks as one place, because (7) allows cycles of length 0; and with no more UAVs than places, because (5) sends every UAV
    out. Tasks count with their value in (1). Cycles that a solver's tolerances admit nevertheless are forbidden, and the
    program is solved again. At the time limit, the best schedule so far is returned with the proven bound; without one,
    :class:`~sb3_uav.solvers.base.NoScheduleError` is raised, which holds the bound.

    Nothing is added against the symmetry of identical UAVs: that speeds up proofs for ten tasks, but HiGHS then finds no
    schedule at all for eighty.

    :param time_limit: Seconds per instance
    :param backend: ``"highs"`` or ``"gurobi"``
    :param threads: How many threads the backend may use
    :raises ImportError: If the backend is not installed
    :raises ValueError: If an argument is not allowed
    :raises UnavailableError: If Gurobi finds no valid license
    """

    name = "milp"

    def __init__(self, time_limit: float = 60.0, backend: str = "highs", threads: int = 1) -> None:
        super().__init__(time_limit)
        if backend not in BACKENDS:
            raise ValueError(f"backend of milp is {backend!r}; choose one of {sorted(BACKENDS)}.")
        if threads < 1:
            raise ValueError(f"threads of milp is {threads}; give at least 1.")
        self.threads = threads
        self.backend = BACKENDS[backend]()

    def check(self, instances: Instances) -> None:
        super().check(instances)
        """
        :param instances: The instances to solve
        :raises ValueError: If the model of one of them is too large for the backend
        """
        for row in range(len(instances)):
            places = _Places.of(ReducedInstance.of(instances[row]))
            try:
                self.backend.check_size(*_program_size(len(places.values), instances.n_uavs))
            except ValueError as error:
                raise ValueError(f"instance {row}: {error}.") from error

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        time_limit = self.time_limit if time_limit is None else time_limit
        deadline = self.deadline(time_limit)
        seed = int(rng.integers(2**30))
        reduced = ReducedInstance.of(instance)
        places = _Places.of(reduced)
        self.backend.check_size(*_program_size(len(places.values), reduced.fleet_size))
        free_value = math.fsum(reduced.values[node - 1] for node in places.nodes[0])
        bound = math.fsum(reduced.values)
        value = 0.0
        tours: list[tuple[int, ...]] = [(0,)]
        forbidden: list[tuple[int, ...]] = []
        while len(places.values) > 0 and (remaining := deadline - time.perf_counter()) > 0:
            program = _paper_program(places, reduced.fleet_size, forbidden)
            answer = self.backend.solve(program, remaining, self.threads, seed)
            bound = min(bound, free_value + answer.bound * places.values.max())
            if answer.columns is None:
                break
            cycles = _flown_cycles(answer.columns, len(places.values))
            found = [cycle for cycle in cycles if places.is_tour(cycle)]
            found_value = math.fsum(map(places.tour_value, found))
            if found_value > value:
                value, tours = found_value, found
            if len(found) == len(cycles):
                break
            forbidden += [cycle for cycle in cycles if not places.is_tour(cycle)]
        bound = float(max(bound, free_value + value))
        if len(places.values) > 0 and value == 0:
            raise NoScheduleError(f"no schedule found within the time limit of {time_limit:g} s; bound {bound:g}", bound)
        routes = [[node for place in tour[1:] for node in places.nodes[place]] for tour in tours]
        # Tasks at the depot cost nothing.
        routes[0] += places.nodes[0]
        return Solution(reduced.schedule(routes), bound)


def _arcs(n_places: int) -> tuple[np.ndarray, np.ndarray]:
    """
    :param n_places: Number of places
    :return: Start and end of every arc between the depot, which is 0, and the places, ``(n_places * (n_places + 1),)`` each
    """
    start, end = np.nonzero(~np.eye(n_places + 1, dtype=bool))
    return start, end


def _program_size(n_places: int, n_uavs: int) -> tuple[int, int]:
    """
    :param n_places: Number of places
    :param n_uavs: Number of UAVs
    :return: Number of columns and of rows of :func:`_paper_program`
    """
    n_uavs = min(n_uavs, n_places)
    return n_uavs * n_places * (n_places + 3), n_uavs * (n_places**2 + 2 * n_places + 3) + n_places + 1


def _paper_program(places: _Places, n_uavs: int, forbidden: Sequence[tuple[int, ...]] = ()) -> Program:
    """
    The paper's model, its numbers in brackets below; distances are in units of the maximum flight distance.

    The columns of UAV after UAV are x of every arc, y of every place, and z of every place. The paper's two copies of the
    depot are one here: z of the first is 0, and (7) towards the second says the same as (8).

    :param places: At least one place
    :param n_uavs: Number of UAVs
    :param forbidden: Cycles of places that no UAV may fly, in either direction
    :return: The program; its objective is in units of the largest value
    """
    n_places = len(places.values)
    n_uavs = min(n_uavs, n_places)
    start, end = _arcs(n_places)
    width = len(start) + 2 * n_places
    first_column = width * np.arange(n_uavs)[:, None]
    # Of UAVs and arcs, (n_uavs, n_arcs); and of UAVs and places, (n_uavs, n_places).
    x = first_column + np.arange(len(start))
    y = first_column + len(start) + np.arange(n_places)
    z = y + n_places
    leaves_place, enters_place = start > 0, end > 0
    length = places.distances[start, end]
    rows = Rows()

    # (2) At most one UAV visits a place.
    rows.add(rows.new(-np.inf, np.ones(n_places)), y, 1.0)
    # (3) It leaves every place that it visits,
    row = rows.new(np.zeros(y.shape), 0.0)
    rows.add(row[:, start[leaves_place] - 1], x[:, leaves_place], 1.0)
    rows.add(row, y, -1.0)
    # (4) as often as it arrives; the same for the depot, once at most.
    row = rows.new(np.zeros((n_uavs, n_places + 1)), 0.0)
    rows.add(row[:, start], x, 1.0)
    rows.add(row[:, end], x, -1.0)
    rows.add(rows.new(-np.inf, np.ones((n_uavs, 1))), x[:, ~leaves_place], 1.0)
    # (5) Every UAV leaves the depot.
    rows.add(rows.new(n_uavs, [[n_uavs]]), x[:, ~leaves_place], 1.0)
    # (6) No UAV flies farther than it can.
    rows.add(rows.new(-np.inf, np.ones((n_uavs, 1))), x, length)
    # (7) Along its tour, z is at least what it has flown.
    row = rows.new(-np.inf, np.broadcast_to(1 - length[enters_place], (n_uavs, enters_place.sum())))
    rows.add(row, x[:, enters_place], 1.0)
    rows.add(row, z[:, end[enters_place] - 1], -1.0)
    between_places = leaves_place[enters_place]
    rows.add(row[:, between_places], z[:, start[enters_place & leaves_place] - 1], 1.0)

    for cycle in forbidden:
        for direction in (cycle, cycle[::-1]):
            arcs = [np.flatnonzero((start == a) & (end == b)) for a, b in pairwise((*direction, direction[0]))]
            rows.add(rows.new(-np.inf, np.full((n_uavs, 1), len(cycle) - 1.0)), x[:, np.concatenate(arcs)], 1.0)

    # (1) The value of the visited places.
    objective = np.zeros(n_uavs * width)
    objective[y] = places.values / places.values.max()
    # (8) z leaves enough to fly home.
    column_upper = np.ones(n_uavs * width)
    column_upper[z] = 1 - places.distances[0, 1:]
    binary = np.ones(n_uavs * width, dtype=bool)
    binary[z] = False
    return rows.program(objective, column_upper, binary)


def _flown_cycles(columns: np.ndarray, n_places: int) -> list[tuple[int, ...]]:
    """
    :param columns: A solution of :func:`_paper_program`
    :param n_places: Number of places
    :return: The cycles of places that its UAVs fly; those through the depot start with it, which is 0
    """
    start, end = _arcs(n_places)
    x = columns.reshape(-1, len(start) + 2 * n_places)[:, : len(start)]
    cycles = []
    for flown in x > 0.5:
        successor = dict(zip(start[flown].tolist(), end[flown].tolist(), strict=True))
        while successor:
            cycle = [min(successor)]
            while (following := successor.pop(cycle[-1])) != cycle[0]:
                cycle.append(following)
            cycles.append(tuple(cycle))
    return cycles

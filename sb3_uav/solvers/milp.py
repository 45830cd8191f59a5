"""The mixed-integer linear program of the paper (its equations (1) to (8)), solved by HiGHS or by Gurobi."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import ReducedInstance, UavKind
from sb3_uav.solvers.base import NoScheduleError, Solution
from sb3_uav.solvers.limits import TimeLimitedSolver
from sb3_uav.solvers.programs import BACKENDS, Program, Rows

# Tasks nearer to each other than this, in units of the maximum flight distance, are one place.
COINCIDENT = 1e-12
# By how much a tour may exceed 1: less than the reduction leaves of the checker's tolerance.
_LENGTH_TOLERANCE = 1e-13
# In units of what a UAV can fly.
_TOO_FAR = 2.0
# Solvers tell objectives apart that differ by a little more than 1e-9. Where values span more than this, or are whole and
# greater, the objective is this many times as large, so that whole values up to 1e9 keep their order.
_WIDE_SPAN = 1e6


class _Places(NamedTuple):
    """
    The distinct positions of the tasks, and what each kind of UAVs flies to and from them.

    Place 0 stands for the start of a UAV and for its end. Where all UAVs start and end at one depot, equally far from their
    limit, tasks there are at place 0 too.

    :param nodes: Nodes of the reduced instance at place 0 (without the sites), then those at each of the other ``n`` places
    :param values: ``(n,)``, total value of each place but the first
    :param distances: ``(n_kinds, n + 1, n + 1)``, in units of what such a UAV can fly: in the first row from its start, in
        the first column to its end
    :param kind_of: ``(n_uavs,)`` int64, the kind of every UAV; of each no more than there are places
    :param uavs: ``(n_uavs,)`` int64, their numbers in the reduced instance
    :param has_one_depot: Whether all UAVs are equal, and start where they end
    """

    nodes: list[list[int]]
    values: np.ndarray
    distances: np.ndarray
    kind_of: np.ndarray
    uavs: np.ndarray
    has_one_depot: bool

    @classmethod
    def of(cls, reduced: ReducedInstance) -> _Places:
        """
        :param reduced: The reduced instance
        :return: Its places
        """
        none = np.zeros(0, np.int64)
        if reduced.n_tasks == 0:
            return cls([[]], np.zeros(0), np.zeros((0, 1, 1)), none, none, True)
        has_one_depot = len(reduced.kinds) == 1 and reduced.n_sites == 1
        first = 0 if has_one_depot else reduced.n_sites
        # Of every node, the first that it coincides with; chains of them are one place.
        owner = (reduced.distances[first:, first:] <= COINCIDENT * reduced.limits.min()).argmax(1) + first
        owner = np.concatenate([np.zeros(first, np.int64), owner])
        while (owner[owner] != owner).any():
            owner = owner[owner]
        owner[:first] = 0
        kept, place_of = np.unique(owner, return_inverse=True)
        nodes: list[list[int]] = [[] for _ in kept]
        for node, place in enumerate(place_of[reduced.n_sites :].tolist(), start=reduced.n_sites):
            nodes[place].append(node)
        values = np.bincount(place_of[reduced.n_sites :], weights=reduced.values, minlength=len(kept))[1:]
        distances = np.stack([_scaled_distances(reduced, kind, kept) for kind in reduced.kinds])
        uavs = [np.array(own[: len(values)], np.int64) for own in reduced.uavs_of_kinds()]
        kind_of = np.repeat(np.arange(len(uavs)), [len(own) for own in uavs])
        return cls(nodes, values, distances, kind_of, np.concatenate([none, *uavs]), has_one_depot)

    def tour_value(self, tour: Sequence[int]) -> float:
        return math.fsum(self.values[place - 1] for place in tour if place > 0)

    def is_tour(self, cycle: Sequence[int], uav: int) -> bool:
        """Whether a cycle of places goes through the start and end of a UAV, and is short enough for it."""
        distances = self.distances[self.kind_of[uav]]
        length = math.fsum(distances[a, b] for a, b in pairwise((*cycle, cycle[0])))
        return 0 in cycle and length <= 1 + _LENGTH_TOLERANCE


def _scaled_distances(reduced: ReducedInstance, kind: UavKind, kept: np.ndarray) -> np.ndarray:
    """
    :param reduced: The reduced instance
    :param kind: Some of its UAVs
    :param kept: ``(n + 1,)``, a node at each place; the first is a site
    :return: ``(n + 1, n + 1)``, see :class:`_Places`
    """
    distances = reduced.distances[np.ix_(kept, kept)]
    distances[0, 1:] = reduced.distances[kind.start, kept[1:]]
    distances[1:, 0] = reduced.distances[kept[1:], kind.end]
    # What is too far may be any distance that is too far: large numbers would only cost precision.
    return np.divide(distances, kind.limit, out=np.where(distances > 0, _TOO_FAR, 0.0), where=kind.limit > 0).clip(
        max=_TOO_FAR
    )


class _Forbidden(NamedTuple):
    """
    :param cycle: Places in flying order
    :param uavs: ``(n,)`` int64, the UAVs that may not fly it
    :param in_both_directions: Whether not in the other direction either
    """

    cycle: tuple[int, ...]
    uavs: np.ndarray
    in_both_directions: bool


class MILP(TimeLimitedSolver):
    """
    The paper's three-index model, by branch and bound.

    It is built for what makes it exact: without tasks that no UAV can reach, for which (8) has no solution; with coincident
    tasks as one place, because (7) allows cycles of length 0; and with no more UAVs than places, because (5) sends every UAV
    out. Tasks count with their value in (1). Of UAVs that differ, each has its own distances, and (5) lets it stay where it
    is. Cycles that a solver's tolerances admit nevertheless are forbidden, and the program is solved again. At the time limit,
    the best schedule so far is returned with the proven bound; without one,
    :class:`~sb3_uav.solvers.base.NoScheduleError` is raised, which holds the bound.

    Values are told apart, and the bound is exact, to 1e-9 of the greatest value, and to 1e-15 of it if values are whole and
    greater than a million, or span more than that: whole values up to 1e9 are exact.

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
    solves_whole_problem = True

    def __init__(self, time_limit: float = 60.0, backend: str = "highs", threads: int = 1) -> None:
        super().__init__(time_limit)
        if backend not in BACKENDS:
            raise ValueError(f"backend of milp is {backend!r}; choose one of {sorted(BACKENDS)}.")
        if threads < 1:
            raise ValueError(f"threads of milp is {threads}; give at least 1.")
        self.threads = threads
        self.backend = BACKENDS[backend]()

    def check(self, instances: Instances) -> None:
        """
        :param instances: The instances to solve
        :raises ValueError: If the model of one of them is too large for the backend
        """
        super().check(instances)
        for row in range(len(instances)):
            places = _Places.of(ReducedInstance.of(instances[row]))
            try:
                self.backend.check_size(*_program_size(len(places.values), len(places.uavs)))
            except ValueError as error:
                raise ValueError(f"instance {row}: {error}.") from error

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        time_limit = self.time_limit if time_limit is None else time_limit
        deadline = self.deadline(time_limit)
        seed = int(rng.integers(2**30))
        reduced = ReducedInstance.of(instance)
        places = _Places.of(reduced)
        self.backend.check_size(*_program_size(len(places.values), len(places.uavs)))
        free_value = math.fsum(reduced.values[node - 1] for node in places.nodes[0])
        bound = math.fsum(reduced.values)
        value = 0.0
        tours: list[tuple[int, tuple[int, ...]]] = []
        forbidden: list[_Forbidden] = []
        while len(places.values) > 0 and (remaining := deadline - time.perf_counter()) > 0:
            program = _paper_program(places, forbidden)
            answer = self.backend.solve(program, remaining, self.threads, seed)
            bound = min(bound, free_value + answer.bound * _value_unit(places.values))
            if answer.columns is None:
                break
            cycles = _flown_cycles(answer.columns, len(places.values))
            found = [(uav, cycle) for uav, cycle in cycles if places.is_tour(cycle, uav)]
            found_value = math.fsum(places.tour_value(cycle) for _, cycle in found)
            if found_value > value:
                value, tours = found_value, found
            if len(found) == len(cycles):
                break
            forbidden += [_forbid(places, cycle, uav) for uav, cycle in cycles if not places.is_tour(cycle, uav)]
        bound = float(max(bound, free_value + value))
        if len(places.values) > 0 and value == 0:
            raise NoScheduleError(f"no schedule found within the time limit of {time_limit:g} s; bound {bound:g}", bound)
        routes: list[list[int]] = [[] for _ in range(max(reduced.n_uavs, 1))]
        for uav, tour in tours:
            routes[places.uavs[uav]] = [node for place in tour[1:] for node in places.nodes[place]]
        # Tasks at the depot cost nothing.
        routes[0] += places.nodes[0]
        return Solution(reduced.schedule(routes), bound)


def _forbid(places: _Places, cycle: tuple[int, ...], uav: int) -> _Forbidden:
    """
    :param places: The places
    :param cycle: A cycle that is no tour
    :param uav: A UAV that has flown it
    :return: The cycle, for all UAVs for which it is none for the same reason
    """
    everyone = np.arange(len(places.uavs))
    if 0 not in cycle or places.has_one_depot:
        return _Forbidden(cycle, everyone, True)
    return _Forbidden(cycle, everyone[places.kind_of == places.kind_of[uav]], False)


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


def _paper_program(places: _Places, forbidden: Sequence[_Forbidden] = ()) -> Program:
    """
    The paper's model, its numbers in brackets below; distances are in units of the maximum flight distance of the UAV.

    The columns of UAV after UAV are x of every arc, y of every place, and z of every place. The paper's two copies of the
    depot are one here: z of the first is 0, and (7) towards the second says the same as (8).

    :param places: At least one place
    :param forbidden: Cycles of places that UAVs may not fly
    :return: The program; its objective is in units of :func:`_value_unit`
    """
    n_places, n_uavs = len(places.values), len(places.uavs)
    start, end = _arcs(n_places)
    width = len(start) + 2 * n_places
    first_column = width * np.arange(n_uavs)[:, None]
    # Of UAVs and arcs, (n_uavs, n_arcs); and of UAVs and places, (n_uavs, n_places).
    x = first_column + np.arange(len(start))
    y = first_column + len(start) + np.arange(n_places)
    z = y + n_places
    leaves_place, enters_place = start > 0, end > 0
    # Of UAVs and arcs.
    length = places.distances[:, start, end][places.kind_of]
    # (8) z leaves enough to fly home.
    most_flown = 1 - places.distances[places.kind_of, 1:, 0]
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
    # (5) Every UAV leaves the depot, unless there may be nothing for it to do.
    rows.add(rows.new(n_uavs if places.has_one_depot else -np.inf, [[n_uavs]]), x[:, ~leaves_place], 1.0)
    # (6) No UAV flies farther than it can.
    rows.add(rows.new(-np.inf, np.ones((n_uavs, 1))), x, length)
    # (7) Along its tour, z is at least what it has flown.
    added = length[:, enters_place]
    # What relaxes it where an arc is not flown; between equal UAVs' only depot, the triangle inequality makes 1 suffice.
    relaxing = np.ones(added.shape)
    if not places.has_one_depot:
        relaxing = added + np.concatenate([np.zeros((n_uavs, 1)), most_flown], axis=1).clip(0)[:, start[enters_place]]
    row = rows.new(-np.inf, relaxing - added)
    rows.add(row, x[:, enters_place], relaxing)
    rows.add(row, z[:, end[enters_place] - 1], -1.0)
    between_places = leaves_place[enters_place]
    rows.add(row[:, between_places], z[:, start[enters_place & leaves_place] - 1], 1.0)

    for cycle, uavs, in_both_directions in forbidden:
        for direction in (cycle, cycle[::-1]) if in_both_directions else (cycle,):
            arcs = [np.flatnonzero((start == a) & (end == b)) for a, b in pairwise((*direction, direction[0]))]
            rows.add(rows.new(-np.inf, np.full((len(uavs), 1), len(cycle) - 1.0)), x[uavs][:, np.concatenate(arcs)], 1.0)

    # (1) The value of the visited places.
    objective = np.zeros(n_uavs * width)
    objective[y] = places.values / _value_unit(places.values)
    column_upper = np.ones(n_uavs * width)
    column_upper[z] = most_flown.clip(0)
    if not places.has_one_depot:
        is_near = places.distances[places.kind_of, 0, 1:] <= most_flown
        column_upper[y] = is_near
        column_upper[x[:, leaves_place]] = is_near[:, start[leaves_place] - 1]
        column_upper[x[:, enters_place]] *= is_near[:, end[enters_place] - 1]
    binary = np.ones(n_uavs * width, dtype=bool)
    binary[z] = False
    return rows.program(objective, column_upper, binary)


def _value_unit(values: np.ndarray) -> float:
    """
    :param values: ``(n,)``, of the places
    :return: The unit of the objective: the largest value, or a part of it where small differences must count
    """
    largest = float(values.max())
    is_whole = bool((values == np.rint(values)).all())
    is_wide = largest > _WIDE_SPAN * values.min() or (is_whole and largest > _WIDE_SPAN)
    return largest / _WIDE_SPAN if is_wide else largest


def _flown_cycles(columns: np.ndarray, n_places: int) -> list[tuple[int, tuple[int, ...]]]:
    """
    :param columns: A solution of :func:`_paper_program`
    :param n_places: Number of places
    :return: UAV and places of every cycle that is flown; those through start and end begin with 0
    """
    start, end = _arcs(n_places)
    x = columns.reshape(-1, len(start) + 2 * n_places)[:, : len(start)]
    cycles = []
    for uav, flown in enumerate(x > 0.5):
        successor = dict(zip(start[flown].tolist(), end[flown].tolist(), strict=True))
        while successor:
            cycle = [min(successor)]
            while (following := successor.pop(cycle[-1])) != cycle[0]:
                cycle.append(following)
            cycles.append((uav, tuple(cycle)))
    return cycles

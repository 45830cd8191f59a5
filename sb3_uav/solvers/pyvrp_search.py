"""PyVRP: iterated local search for vehicle routing with optional clients, from nothing or from a given schedule."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from sb3_uav.common.optional import install_command, require
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import RESOLUTION, ReducedInstance
from sb3_uav.envs.schedule import Schedule
from sb3_uav.solvers.base import Solution
from sb3_uav.solvers.limits import TimeLimitedSolver, deadline_after
from sb3_uav.solvers.overlong_tours import with_feasible_tours

# Its interface changes with every minor version.
_SUPPORTED_VERSION = "0.14."
_NUM_NEIGHBOURS = 20
# Prizes of tasks whose values are rounded are whole multiples of the smallest that outweighs all distances; this many at most.
_LARGEST_PRIZE = 100_000
# How far PyVRP may raise the cost of tours that are too long: for an excess of the maximum flight distance, to so many times
# the largest prize. Its own bound, per unit of distance, suffices for equal values; it is far too low for prizes that differ
# much, because infeasible tours would pay and no feasible schedule be found.
_PENALTY_PER_PRIZE = 1000
_DEFAULT_MAX_PENALTY = 100_000.0
# PyVRP adds in int64; this leaves room for the sum of two costs.
LARGEST_COST = 2**61


class PyVRP(TimeLimitedSolver):
    """
    PyVRP's iterated local search: tasks are optional clients whose prizes outweigh all the length that the fleet can save, so
    that value is maximized first and length minimized second. It ends before the time limit when all tasks are visited.

    :param time_limit: Seconds per instance
    :param num_neighbours: Size of the granular neighborhoods
    :raises ImportError: If PyVRP 0.14 is not installed
    :raises ValueError: If the time limit is not a finite number above 0, or the number of neighbors is below 1
    """

    name = "pyvrp"
    solves_whole_problem = True

    def __init__(self, time_limit: float = 10.0, num_neighbours: int = _NUM_NEIGHBOURS) -> None:
        super().__init__(time_limit)
        if num_neighbours < 1:
            raise ValueError(f"num_neighbours of pyvrp is {num_neighbours}; give at least 1.")
        _require_pyvrp(self.name)
        self.num_neighbours = num_neighbours

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        deadline = self.deadline(time_limit)
        return Solution(_search(instance, None, deadline, int(rng.integers(2**31)), self.num_neighbours))


def polish_schedule(
    instance: Instances, schedule: Schedule, time_limit: float, seed: int = 0, num_neighbours: int = _NUM_NEIGHBOURS
) -> Schedule:
    """
    Improve a schedule with PyVRP, which starts from it.

    :param instance: A batch of one
    :param schedule: A feasible schedule of it
    :param time_limit: Seconds
    :param seed: Seed of PyVRP
    :param num_neighbours: Size of the granular neighborhoods
    :return: A feasible schedule of at least the same value
    :raises ImportError: If PyVRP 0.14 is not installed
    :raises ValueError: If the time limit is not a finite number above 0
    """
    found = _search(instance, schedule, deadline_after(time_limit, "polish_schedule"), seed, num_neighbours)
    return max(found, schedule, key=lambda candidate: _total_value(instance, candidate))


def has_pyvrp() -> bool:
    """Whether a supported version is installed."""
    try:
        _require_pyvrp("pyvrp")
    except ImportError:
        return False
    return True


def _require_pyvrp(solver: str) -> Any:
    """
    :param solver: Name of the solver that needs it
    :return: The module ``pyvrp``
    :raises ImportError: If it is not installed, or not in a supported version
    """
    pyvrp = require("pyvrp", f"Solver {solver}", "solvers")
    found = version("pyvrp")
    if not found.startswith(_SUPPORTED_VERSION):
        raise ImportError(
            f"Solver {solver} needs PyVRP 0.14, which needs Python 3.11 or newer; found PyVRP {found}. "
            f"Run: {install_command('solvers')}"
        )
    return pyvrp


def _total_value(instance: Instances, schedule: Schedule) -> float:
    values = instance.prizes[0].tolist()
    return sum(values[task] for route in schedule.routes for task in route)


def _search(instance: Instances, initial: Schedule | None, deadline: float, seed: int, num_neighbours: int) -> Schedule:
    """
    :param instance: A batch of one
    :param initial: Where to start; a random solution when None
    :param deadline: When to stop, in seconds of ``time.perf_counter``
    :param seed: Seed of PyVRP
    :param num_neighbours: Size of the granular neighborhoods
    :return: The best schedule found
    """
    pyvrp = _require_pyvrp("pyvrp")
    reduced = ReducedInstance.of(instance)
    if reduced.n_tasks == 0:
        return reduced.schedule([])
    prizes = reduced.integer_prizes(_LARGEST_PRIZE, LARGEST_COST // _PENALTY_PER_PRIZE)
    data = _problem_data(pyvrp, reduced, prizes)
    params = pyvrp.SolveParams(
        neighbourhood=pyvrp.search.NeighbourhoodParams(num_neighbours=num_neighbours),
        penalty=pyvrp.PenaltyParams(max_penalty=max(_DEFAULT_MAX_PENALTY, _PENALTY_PER_PRIZE * prizes.max() / RESOLUTION)),
    )

    least_prize = int(prizes.min())

    def stop(best_cost: int) -> bool:
        # A feasible solution that costs less than any prize has collected them all.
        return best_cost < least_prize or time.perf_counter() >= deadline

    with warnings.catch_warnings():
        # Penalties that reach their bound do not matter: an instance always has a feasible solution.
        warnings.simplefilter("ignore", pyvrp.exceptions.PenaltyBoundWarning)
        best = pyvrp.solve(
            data,
            stop,
            seed,
            collect_stats=False,
            params=params,
            initial_solution=None if initial is None else _solution(pyvrp, data, reduced, reduced.routes(initial)),
        ).best
    return reduced.schedule(with_feasible_tours(reduced, _routes(reduced, best)))


def _solution(pyvrp: Any, data: Any, reduced: ReducedInstance, routes: Sequence[Sequence[int]]) -> Any:
    """
    :param pyvrp: The module
    :param data: PyVRP's description of what to plan
    :param reduced: What to plan
    :param routes: Routes of UAV after UAV, as nodes
    :return: PyVRP's description of these routes
    """
    kind_of = [kind for kind, uavs in enumerate(reduced.uavs_of_kinds()) for _ in uavs]
    visits = [([node - reduced.n_sites for node in route], kind) for route, kind in zip(routes, kind_of, strict=False)]
    return pyvrp.Solution(data, [pyvrp.Route(data, clients, kind) for clients, kind in visits if clients])


def _routes(reduced: ReducedInstance, solution: Any) -> list[list[int]]:
    """
    :param reduced: What is planned
    :param solution: PyVRP's solution
    :return: Its routes as nodes, of UAV after UAV; trailing empty routes are left out
    """
    flown: list[list[list[int]]] = [[] for _ in reduced.kinds]
    for route in solution.routes():
        clients = [activity.idx for activity in route if activity.is_client()]
        flown[route.vehicle_type()].append([client + reduced.n_sites for client in clients])
    return reduced.of_kinds(flown)


def _problem_data(pyvrp: Any, reduced: ReducedInstance, prizes: np.ndarray) -> Any:
    """
    :param pyvrp: The module
    :param reduced: What to plan
    :param prizes: ``(n,)`` int64
    :return: PyVRP's description of it; depot ``i`` is node ``i``, client ``i`` is node
        ``n_sites + i``, and vehicle type ``i`` is kind ``i``
    """
    distances = reduced.coarse_distances()
    n_sites = reduced.n_sites
    return pyvrp.ProblemData(
        # All distances are in the matrix.
        locations=[pyvrp.Location(0, 0)] * len(distances),
        clients=[pyvrp.Client(node, prize=prize, required=False) for node, prize in enumerate(prizes.tolist(), start=n_sites)],
        depots=[pyvrp.Depot(site) for site in range(n_sites)],
        vehicle_types=[
            pyvrp.VehicleType(
                num_available=len(uavs),
                start_depot=kind.start,
                end_depot=kind.end,
                max_distance=reduced.coarse_limit(kind),
            )
            for kind, uavs in zip(reduced.kinds, reduced.uavs_of_kinds(), strict=True)
        ],
        distance_matrices=[distances],
        duration_matrices=[np.zeros_like(distances)],
    )

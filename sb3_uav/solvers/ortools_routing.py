"""OR-Tools' routing library: the paper's baseline, and the same with guided local search."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

import numpy as np

from sb3_uav.common.optional import require
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import ReducedInstance
from sb3_uav.envs.schedule import Schedule
from sb3_uav.solvers.base import OneByOneSolver, Solution
from sb3_uav.solvers.limits import TimeLimitedSolver

# Prizes of tasks whose values are rounded are whole multiples of the smallest that outweighs all distances; this many at most.
_LARGEST_PRIZE = 1_000_000
# More than any move of the local search takes.
_SECONDS_PER_MOVE = 86_400
# OR-Tools adds in int64; this leaves room for the distances.
LARGEST_COST = 2**60


class ORTools(OneByOneSolver):
    """
    A first solution by PATH_CHEAPEST_ARC and local search to its local optimum, without a metaheuristic: the OR-Tools row of
    the paper's tables.

    Arcs cost their length, and every unvisited task a penalty in proportion to its value that outweighs all the length that
    the fleet can save. There is no time limit, and nothing is random.

    :raises ImportError: If OR-Tools is not installed
    """

    name = "ortools"
    solves_whole_problem = True
    uses_time_limit = False

    def __init__(self) -> None:
        _require_routing(self.name)

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        return Solution(_solve(self.name, instance))


class ORToolsGLS(TimeLimitedSolver):
    """
    The same with OR-Tools' guided local search until the time limit.

    It runs until the limit even when all tasks are visited, because OR-Tools then still shortens the tours.

    :param time_limit: Seconds per instance
    :raises ImportError: If OR-Tools is not installed
    :raises ValueError: If the time limit is not a finite number above 0
    """

    name = "ortools-gls"
    solves_whole_problem = True

    def __init__(self, time_limit: float = 10.0) -> None:
        super().__init__(time_limit)
        _require_routing(self.name)

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        return Solution(_solve(self.name, instance, self.deadline(time_limit)))


def _require_routing(solver: str) -> Any:
    """
    :param solver: Name of the solver that needs it
    :return: The module ``ortools.constraint_solver.pywrapcp``
    :raises ImportError: If OR-Tools is not installed
    """
    return require("ortools.constraint_solver.pywrapcp", f"Solver {solver}", "solvers")


def _solve(solver: str, instance: Instances, deadline: float | None = None) -> Schedule:
    """
    :param solver: Name of the solver, for errors
    :param instance: A batch of one
    :param deadline: When guided local search ends, in seconds of ``time.perf_counter``; plain local search when None
    :return: The schedule; at least a first one, even if the deadline comes before it
    :raises RuntimeError: If OR-Tools fails
    """
    pywrapcp = _require_routing(solver)
    reduced = ReducedInstance.of(instance)
    if reduced.n_tasks == 0:
        return reduced.schedule([])
    starts, ends = ([getattr(uav, place) for uav in reduced.uavs] for place in ("start", "end"))
    manager = pywrapcp.RoutingIndexManager(len(reduced.distances), reduced.n_uavs, starts, ends)
    routing = pywrapcp.RoutingModel(manager)
    routing.SetArcCostEvaluatorOfAllVehicles(routing.RegisterTransitMatrix(reduced.arc_costs().tolist()))
    flown = routing.RegisterTransitMatrix(reduced.fine_distances().tolist())
    routing.AddDimensionWithVehicleCapacity(flown, 0, reduced.fine_limits().tolist(), True, "distance")
    prizes = reduced.integer_prizes(_LARGEST_PRIZE, LARGEST_COST).tolist()
    for node, penalty in enumerate(prizes, start=reduced.n_sites):
        routing.AddDisjunction([manager.NodeToIndex(node)], penalty)
    solution = routing.SolveWithParameters(_search_parameters(pywrapcp, deadline))
    if solution is None and deadline is not None:
        # The time was up before the first solution, which takes little time.
        solution = routing.SolveWithParameters(_first_solution_parameters(pywrapcp))
    if solution is None:
        raise RuntimeError("OR-Tools found no schedule, although an empty one is feasible.")
    routes = []
    for uav in range(reduced.n_uavs):
        route = []
        index = solution.Value(routing.NextVar(routing.Start(uav)))
        while not routing.IsEnd(index):
            route.append(manager.IndexToNode(index))
            index = solution.Value(routing.NextVar(index))
        routes.append(route)
    return reduced.schedule(routes)


def _first_solution_parameters(pywrapcp: Any) -> Any:
    """
    :param pywrapcp: The module
    :return: OR-Tools' search parameters, to end with the first solution
    """
    parameters = _search_parameters(pywrapcp, None)
    parameters.solution_limit = 1
    return parameters


def _search_parameters(pywrapcp: Any, deadline: float | None) -> Any:
    """
    :param pywrapcp: The module
    :param deadline: As in :func:`_solve`
    :return: OR-Tools' search parameters
    """
    parameters = pywrapcp.DefaultRoutingSearchParameters()
    enums = import_module("ortools.constraint_solver.routing_enums_pb2")
    parameters.first_solution_strategy = enums.FirstSolutionStrategy.PATH_CHEAPEST_ARC
    if deadline is None:
        parameters.local_search_metaheuristic = enums.LocalSearchMetaheuristic.GREEDY_DESCENT
        # By default some of its moves give up after 0.1 s, and a busy machine finds another local optimum.
        parameters.lns_time_limit.FromSeconds(_SECONDS_PER_MOVE)
    else:
        parameters.local_search_metaheuristic = enums.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
        # Building the model counts too.
        parameters.time_limit.FromMilliseconds(max(1, round(1000 * (deadline - time.perf_counter()))))
    return parameters

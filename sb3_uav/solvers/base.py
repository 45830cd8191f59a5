"""What every solver looks like, and how one is made from its name."""

from __future__ import annotations

import inspect
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, get_args

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule


@dataclass(frozen=True)
class SolverResult:
    """
    What a solver found for one instance.

    :param schedule: The schedule; nobody has checked it yet
    :param seconds: Wall time of the instance: that of its batch, divided by the size of the batch
    :param batch_size: How many instances were solved at once
    :param bound: A proven upper bound of the objective, where the solver knows one
    """

    schedule: Schedule
    seconds: float
    batch_size: int = 1
    bound: float | None = None


class Solver(ABC):
    """
    Turns instances into schedules.

    :ivar uses_time_limit: Whether it may find other schedules with another time limit; if not, evaluations at several time
        limits run it once
    :ivar name: How tables and files call it
    :ivar spec: The text that :func:`make_solver` made it from
    :ivar files: Files that it was made from, by their purpose; evaluations record their hashes
    """

    uses_time_limit: bool = True
    name: str
    spec: str | None = None
    files: Mapping[str, Path] = {}

    def settings(self) -> dict[str, Any]:
        """
        :return: What decides its results beside instances, time limit and seed, as plain data; results of earlier evaluations
            are used again only if it is the same
        """
        return {} if self.spec is None else {"spec": self.spec}

    def check(self, instances: Instances) -> None:  # noqa: B027 (most solvers take any instances)
        """
        Called for all instances before any solver runs, so that a long evaluation does not fail half-way.

        :param instances: What is going to be solved
        :raises ValueError: If the solver cannot treat them; the message says why
        """

    def prepare(self) -> None:  # noqa: B027 (most solvers have nothing to prepare)
        """
        Called in every process before it solves an instance, often more than once; what it takes does not count as time of the
        instance. For what is the same for all of them, such as loading code.
        """

    @abstractmethod
    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        """
        :param instances: ``batch`` instances on the CPU, possibly padded
        :param time_limit: Seconds per instance for solvers that can use more or less of them; their own default when None.
            Others ignore it
        :param seed: Of all the randomness; without a time limit the same seed gives the same schedules
        :return: One result per instance
        :raises ValueError: If the solver cannot treat these instances, see :meth:`check`
        """

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        """
        Solve some of the instances exactly as :meth:`solve` solves them among all, and hand out what is known already.

        :param instances: ``batch`` instances on the CPU, possibly padded
        :param rows: Indices of those to solve
        :param time_limit: As for :meth:`solve`
        :param seed: As for :meth:`solve`
        :return: Index and result of each
        """
        results = self.solve(instances, time_limit, seed)
        if len(results) != len(instances):
            raise ValueError(f"{self.name} returned {len(results)} results for {len(instances)} instances.")
        for row in rows:
            yield row, results[row]


class Solution(NamedTuple):
    """
    :param schedule: The schedule
    :param bound: A proven upper bound of the objective, where the solver knows one
    """

    schedule: Schedule
    bound: float | None = None


class OneByOneSolver(Solver):
    """A solver that treats every instance alone, with random numbers that depend on the seed and its row only."""

    @abstractmethod
    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        """
        :param instance: A batch of one, without padding
        :param time_limit: Seconds, or None for the solver's own default
        :param rng: The source of randomness
        :return: The schedule, and a bound where one is known
        """

    def solve_row(self, instance: Instances, row: int, time_limit: float | None = None, seed: int = 0) -> SolverResult:
        """
        :param instance: A batch of one, possibly padded
        :param row: Its index in what is being solved
        :param time_limit: As for :meth:`solve`
        :param seed: As for :meth:`solve`
        :return: What :meth:`solve` finds for that row
        """
        self.prepare()
        start = time.perf_counter()
        # A row that is all padding keeps one slot, because no instance has none.
        trimmed = instance.trim(max(int(instance.task_mask.sum()), 1))
        solution = self.solve_one(trimmed, time_limit, np.random.default_rng([seed, row]))
        return SolverResult(solution.schedule, time.perf_counter() - start, bound=solution.bound)

    def solve_rows(
        self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0
    ) -> Iterator[tuple[int, SolverResult]]:
        for row in rows:
            yield row, self.solve_row(instances[row], row, time_limit, seed)

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [result for _, result in self.solve_rows(instances, range(len(instances)), time_limit, seed)]


# Name -> "module:class", or a function that returns a solver. The module is imported when the solver is made, so that only
# those that are used must be installed.
SOLVERS: dict[str, str] = {
    "dl-drl": "sb3_uav.solvers.dl_drl:load_dl_drl",
    # The paper's name for pairs whose router was not trained with the allocator.
    "dl-drl-i": "sb3_uav.solvers.dl_drl:load_dl_drl_i",
    "kmeans-am": "sb3_uav.solvers.kmeans_am:load_kmeans_am",
    "greedy-insertion": "sb3_uav.solvers.insertion:GreedyInsertion",
    "milp": "sb3_uav.solvers.milp:MILP",
    "ortools": "sb3_uav.solvers.ortools_routing:ORTools",
    "ortools-gls": "sb3_uav.solvers.ortools_routing:ORToolsGLS",
    "pyvrp": "sb3_uav.solvers.pyvrp_search:PyVRP",
    "kmeans-nearest": "sb3_uav.solvers.heuristics:KMeansNearest",
    "kmeans-vnd": "sb3_uav.solvers.kmeans_vnd:KMeansVND",
    "random-nearest": "sb3_uav.solvers.heuristics:RandomNearest",
}


def make_solver(spec: str, **defaults: Any) -> Solver:
    """
    Make a solver from text.

    :param spec: ``name`` or ``name:key=value,key=value``; the keys are the arguments of the solver's constructor, and
        ``name``, which tables and files shall call it by
    :param defaults: Arguments for solvers that have them, where ``spec`` does not give them
    :return: The solver; unless told otherwise its ``name`` is the whole ``spec``, so that variants can be told apart
    :raises ValueError: If the name, a key or a value is not allowed; the message lists the choices
    :raises ImportError: If the solver needs a package that is not installed
    """
    factory = solver_factory(spec)
    name, _, text = spec.partition(":")
    solver = factory(**_parse_options(name, text, factory, defaults))
    solver.name, solver.spec = solver_label(spec), spec
    return solver


def solver_factory(spec: str) -> Callable[..., Solver]:
    """
    :param spec: As of :func:`make_solver`
    :return: The class of the solver, or the function that makes it
    :raises ValueError: If there is no such solver
    :raises ImportError: If the module that it is in, or what that module imports, is not installed
    """
    name = spec.partition(":")[0]
    if name not in SOLVERS:
        raise ValueError(f"Unknown solver {name!r}; choose one of {sorted(SOLVERS)}.")
    module, _, attribute = SOLVERS[name].partition(":")
    return getattr(import_module(module), attribute)


def solver_label(spec: str) -> str:
    """
    :param spec: As of :func:`make_solver`
    :return: What tables and files call the solver: the option ``name``, or the whole text
    """
    options = dict(item.partition("=")[::2] for item in spec.partition(":")[2].split(","))
    return options.get("name") or spec


def _parse_options(name: str, text: str, factory: Callable[..., Solver], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param name: Name of the solver, for errors
    :param text: ``key=value,key=value``, or nothing
    :param factory: A class or a function, whose arguments say which keys there are, and of which type
    :param defaults: Arguments where the text does not give them
    :return: The arguments
    :raises ValueError: If a key or a value is not allowed, or one is missing
    """
    parameters = inspect.signature(factory, eval_str=True).parameters
    choices = {key: _plain_type(parameter.annotation) for key, parameter in parameters.items()} | {"name": str}
    known = ", ".join(f"{option}=<{hint.__name__}>" for option, hint in sorted(choices.items()))
    options: dict[str, Any] = {}
    for item in filter(None, text.split(",")):
        key, equals, value = item.partition("=")
        if not equals or key not in choices:
            raise ValueError(f"Solver {name!r} has no option {item!r}; its options are: {known}.")
        if key in options:
            raise ValueError(f"Solver {name!r} is given the option {key!r} twice.")
        options[key] = _parse_value(f"Option {item!r} of solver {name!r}", value, choices[key])
    # How it is called is no argument of the solver.
    options.pop("name", None)
    options = {key: value for key, value in defaults.items() if key in parameters} | options
    missing = [key for key, parameter in parameters.items() if parameter.default is parameter.empty and key not in options]
    if missing:
        raise ValueError(f"Solver {name!r} needs the option {missing[0]}=<{choices[missing[0]].__name__}>; it has: {known}.")
    return options


def _plain_type(hint: Any) -> type:
    """
    :param hint: Type hint of an option
    :return: The type that a value given as text must have, without the None that stands for its absence
    """
    if isinstance(hint, UnionType):
        (hint,) = (kind for kind in get_args(hint) if kind is not NoneType)
    return hint


def _parse_value(what: str, value: str, kind: type) -> Any:
    """
    :param what: What the value is, named in errors
    :param value: The text
    :param kind: ``int``, ``float``, ``bool`` or ``str``
    :raises ValueError: If the text is not of that type
    """
    if kind is bool:
        if value.lower() not in ("true", "false", "1", "0"):
            raise ValueError(f"{what} must be true or false, or 1 or 0.")
        return value.lower() in ("true", "1")
    try:
        return kind(value)
    except ValueError as error:
        raise ValueError(f"{what} must be of type {kind.__name__}.") from error

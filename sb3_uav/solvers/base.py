"""What every solver looks like, and how one is made from its name."""

from __future__ import annotations

import inspect
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, get_type_hints

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

    :ivar name: How tables and files call it
    """

    name: str

    def check(self, instances: Instances) -> None:  # noqa: B027 (most solvers take any instances)
        """
        Called for all instances before any solver runs, so that a long evaluation does not fail half-way.

        :param instances: What is going to be solved
        :raises ValueError: If the solver cannot treat them; the message says why
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

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        results = []
        for row, n_tasks in enumerate(instances.task_mask.sum(1).tolist()):
            start = time.perf_counter()
            # A row that is all padding keeps one slot, because no instance has none.
            solution = self.solve_one(instances[row].trim(max(n_tasks, 1)), time_limit, np.random.default_rng([seed, row]))
            results.append(SolverResult(solution.schedule, time.perf_counter() - start, bound=solution.bound))
        return results


# Name -> "module:class". The module is imported when the solver is made, so that only those that are used must be installed.
SOLVERS: dict[str, str] = {
    "kmeans-nearest": "sb3_uav.solvers.heuristics:KMeansNearest",
    "random-nearest": "sb3_uav.solvers.heuristics:RandomNearest",
}


def make_solver(spec: str) -> Solver:
    """
    Make a solver from text.

    :param spec: ``name`` or ``name:key=value,key=value``; the keys are the arguments of the solver's constructor
    :return: The solver; its ``name`` is the whole ``spec``, so that variants can be told apart
    :raises ValueError: If the name, a key or a value is not allowed; the message lists the choices
    """
    name, _, text = spec.partition(":")
    if name not in SOLVERS:
        raise ValueError(f"Unknown solver {name!r}; choose one of {sorted(SOLVERS)}.")
    module, _, attribute = SOLVERS[name].partition(":")
    solver_class: type[Solver] = getattr(import_module(module), attribute)
    solver = solver_class(**_parse_options(name, text, solver_class))
    solver.name = spec
    return solver


def _parse_options(name: str, text: str, solver_class: type[Solver]) -> dict[str, Any]:
    """
    :param name: Name of the solver, for errors
    :param text: ``key=value,key=value``, or nothing
    :param solver_class: Whose constructor says which keys there are, and of which type
    :return: Arguments of the constructor
    :raises ValueError: If a key or a value is not allowed
    """
    hints = get_type_hints(solver_class.__init__)
    choices = {key: hints[key] for key in inspect.signature(solver_class).parameters}
    options: dict[str, Any] = {}
    for item in filter(None, text.split(",")):
        key, equals, value = item.partition("=")
        if not equals or key not in choices:
            known = ", ".join(f"{option}=<{hint.__name__}>" for option, hint in sorted(choices.items())) or "none"
            raise ValueError(f"Solver {name!r} has no option {item!r}; its options are: {known}.")
        if key in options:
            raise ValueError(f"Solver {name!r} is given the option {key!r} twice.")
        options[key] = _parse_value(f"Option {item!r} of solver {name!r}", value, choices[key])
    return options


def _parse_value(what: str, value: str, kind: type) -> Any:
    """
    :param what: What the value is, named in errors
    :param value: The text
    :param kind: ``int``, ``float``, ``bool`` or ``str``
    :raises ValueError: If the text is not of that type
    """
    if kind is bool:
        if value.lower() not in ("true", "false"):
            raise ValueError(f"{what} must be true or false.")
        return value.lower() == "true"
    try:
        return kind(value)
    except ValueError as error:
        raise ValueError(f"{what} must be of type {kind.__name__}.") from error

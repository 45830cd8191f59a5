"""All solvers by name, and how one is made from text."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from types import NoneType, UnionType
from typing import Any, get_args

from sb3_uav.solvers.base import Solver

# Name -> "module:class", or a function that returns a solver. The module is imported when the solver is made, so that only
# those that are used must be installed.
SOLVERS: dict[str, str] = {
    "dl-drl": "sb3_uav.solvers.dl_drl:load_dl_drl",
    # The paper's name for pairs whose router was not trained with the allocator.
    "dl-drl-i": "sb3_uav.solvers.dl_drl:load_dl_drl_i",
    "kmeans-am": "sb3_uav.solvers.kmeans_am:load_kmeans_am",
    # Any other zip of SB3, on the step loop of its environment.
    "sb3": "sb3_uav.solvers.sb3_zip:load_sb3",
    "greedy-insertion": "sb3_uav.solvers.insertion:GreedyInsertion",
    "local-search": "sb3_uav.solvers.local_search:LocalSearchSolver",
    "milp": "sb3_uav.solvers.milp:MILP",
    "ortools": "sb3_uav.solvers.ortools_routing:ORTools",
    "ortools-gls": "sb3_uav.solvers.ortools_routing:ORToolsGLS",
    "pyvrp": "sb3_uav.solvers.pyvrp_search:PyVRP",
    "kmeans-nearest": "sb3_uav.solvers.nearest_task:KMeansNearest",
    "kmeans-vnd": "sb3_uav.solvers.kmeans_vnd:KMeansVND",
    "random-nearest": "sb3_uav.solvers.nearest_task:RandomNearest",
}


def make_solver(spec: str, **defaults: Any) -> Solver:
    """
    Make a solver from text.

    :param spec: ``name`` or ``name:key=value,key=value``; the keys are the arguments of the solver's constructor, and
        ``name``, the label in tables and files. A value with a comma stands in quotes, ``key="a,b"`` or ``key='a,b'``, in
        which the quote itself is written twice
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
        raise ValueError(f"Unknown solver {name!r:.80}; choose one of {sorted(SOLVERS)}.")
    module, _, attribute = SOLVERS[name].partition(":")
    return getattr(import_module(module), attribute)


def solver_label(spec: str) -> str:
    """
    :param spec: As of :func:`make_solver`
    :return: Label of the solver in tables and files: the option ``name``, or the whole text
    """
    try:
        options = dict(item.partition("=")[::2] for item in _split_options(spec.partition(":")[2]))
    except ValueError:
        return spec
    return options.get("name") or spec


def _split_options(text: str) -> list[str]:
    """
    :param text: ``key=value,key=value``, values with commas in quotes
    :return: Each ``key=value``, without the quotes
    :raises ValueError: If a closing quote is missing, or something other than a comma follows it
    """
    items = []
    while text:
        plain = re.match(r"[^,=]*=?", text)
        assert plain is not None
        value = text[plain.end() :]
        if plain[0].endswith("=") and value[:1] in ("'", '"'):
            quote = value[0]
            quoted = re.match(f"{quote}((?:[^{quote}]|{quote}{quote})*){quote}(,|$)", value)
            if quoted is None:
                raise ValueError(
                    f"The value of {text!r:.200} begins with a quote; end it with another one, followed by a comma or by "
                    "nothing."
                )
            items.append(plain[0] + quoted[1].replace(quote * 2, quote))
            text = value[quoted.end() :]
        else:
            item, _, text = text.partition(",")
            items.append(item)
    return [item for item in items if item]


def _parse_options(name: str, text: str, factory: Callable[..., Solver], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param name: Name of the solver, for errors
    :param text: ``key=value,key=value``, or nothing
    :param factory: A class or a function, whose arguments define the keys and their types
    :param defaults: Arguments where the text does not give them
    :return: The arguments
    :raises ValueError: If a key or a value is not allowed, or one is missing
    """
    parameters = inspect.signature(factory, eval_str=True).parameters
    choices = {key: _plain_type(parameter.annotation) for key, parameter in parameters.items()} | {"name": str}
    known = ", ".join(f"{option}=<{hint.__name__}>" for option, hint in sorted(choices.items()))
    options: dict[str, Any] = {}
    for item in _split_options(text):
        key, equals, value = item.partition("=")
        if not equals or key not in choices:
            raise ValueError(f"Solver {name!r} has no option {item!r:.200}; its options are: {known}.")
        if key in options:
            raise ValueError(f"Solver {name!r} is given the option {key!r} twice.")
        options[key] = _parse_value(f"Option {item!r:.200} of solver {name!r}", value, choices[key])
    # The label is no argument of the solver.
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
    :param what: Description of the value, for errors
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

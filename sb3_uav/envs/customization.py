"""
Generators, distributions, routers and rewards of the user, as objects or, in a YAML, by dotted path.

================ =================================================================================================
argument         what the path names
================ =================================================================================================
``generator``    a class or function that makes a generator
                 (:class:`~sb3_uav.envs.generators.InstanceGenerator`); those of ``n_tasks``, ``n_uavs`` and
                 ``max_distance`` that it has as parameters are passed to it
``distribution`` ``function(n_instances, n_tasks, rng)``, which returns arrays: depots ``(n_instances, 2)``, tasks
                 ``(n_instances, n_tasks, 2)`` and, if not all are 1, values ``(n_instances, n_tasks)``
``router``       ``function(instances)``, which plans one tour per row (:data:`~sb3_uav.envs.routing.Router`); also
                 the zip of a trained router, or the name of a trained pair
``reward``       ``function(instances, tours)``, which values one complete schedule per row
                 (:data:`~sb3_uav.envs.rewards.Reward`)
================ =================================================================================================

A mapping from the path to further arguments passes those too, as for callbacks in a zoo's YAML::

    env_kwargs:
      generator: {sb3_uav.envs.ClusteredGenerator: {n_clusters: 3}}

Whatever is given is tried out on two instances when the environment is made, without touching any random stream. But nothing
is drawn from a generator that is given as an object, which may have a state of its own. All four work in both drivers. With a
reward of the user, episodes have no ``is_success``, which is about the values of tasks. A router that plans equal rows alike
can be marked with :func:`~sb3_uav.envs.routing.deterministic`: subsets that several samples share are then planned once.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th

from sb3_uav.common.imports import import_object, offered
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.envs.distances import distance_limit, euclidean
from sb3_uav.envs.generators import (
    ClusteredGenerator,
    FixedGenerator,
    InstanceGenerator,
    MixtureGenerator,
    UniformGenerator,
    make_generator,
)
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.rewards import Reward
from sb3_uav.envs.world import WorldGenerator

_N_TRIED = 2
_STATELESS = (UniformGenerator, ClusteredGenerator, MixtureGenerator, WorldGenerator, FixedGenerator)
_PATH_ADVICE = "give the dotted path of one that can be imported from here"


@dataclass(frozen=True)
class _Call:
    """
    A function with further arguments; equal to another with the same, so that environments of one YAML are equal too.

    :param function: The function
    :param arguments: Keyword arguments
    """

    function: Callable[..., Any]
    arguments: dict[str, Any] = field(hash=False)

    def __call__(self, *args: Any) -> Any:
        return self.function(*args, **self.arguments)


@dataclass(frozen=True)
class _Made:
    """
    An object of a class without an equality of its own; equal to another that was made in the same way.

    :param factory: What made it
    :param arguments: Keyword arguments of the factory
    :param made: The object, whose attributes are found here too
    """

    factory: Callable[..., Any]
    arguments: dict[str, Any] = field(hash=False)
    made: Any = field(compare=False)

    def __call__(self, *args: Any) -> Any:
        return self.made(*args)

    def __getattr__(self, name: str) -> Any:
        # Python asks a copy in the making for some of these, which has no object yet.
        if name.startswith("__") or name == "made":
            raise AttributeError(name)
        return getattr(self.made, name)


@dataclass(frozen=True)
class _FunctionGenerator:
    """
    Instances from a distribution of the user.

    :param function: ``function(n_instances, n_tasks, rng)``, see the module
    :param n_tasks: Number of tasks
    :param n_uavs: Number of UAVs
    :param max_distance: Maximum flight distance
    """

    function: Callable[..., Any]
    n_tasks: int
    n_uavs: int
    max_distance: float

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        drawn = self.function(batch_size, self.n_tasks, rng)
        if not isinstance(drawn, tuple) or len(drawn) not in (2, 3):
            raise ValueError(f"it returned {drawn!r:.60}; return a tuple of depots and tasks, or of depots, tasks and values.")
        depot, tasks, *values = (th.tensor(np.asarray(part), dtype=th.float64, device="cpu") for part in drawn)
        ones = th.ones(batch_size, self.n_tasks, dtype=th.float64, device="cpu")
        return Instances(
            depot=depot,
            tasks=tasks,
            values=values[0] if values else ones,
            max_distance=th.full((batch_size,), self.max_distance, dtype=th.float64, device="cpu"),
            n_uavs=self.n_uavs,
            task_mask=ones.bool(),
        )


def _refusal(argument: str, given: Any, reason: object) -> ValueError:
    text = str(reason).strip() or type(reason).__name__
    return ValueError(f"{argument} is {given!r:.200}: {text}")


def _imported(argument: str, given: Any) -> tuple[Any, dict[str, Any]]:
    """
    :param argument: Name of the environment's argument
    :param given: An object, a dotted path, or a mapping from a dotted path to arguments
    :return: The object, and the arguments
    :raises ValueError: If the path cannot be imported, or the mapping is another one
    """
    path, arguments = given, dict[str, Any]()
    if isinstance(given, dict):
        if len(given) != 1 or not all(isinstance(value, dict | None) for value in given.values()):
            raise _refusal(argument, given, "write one dotted path and a mapping of its arguments, {path: {key: value}}.")
        path, arguments = next((key, value or {}) for key, value in given.items())
    if not isinstance(path, str):
        return path, arguments
    try:
        return import_object(path), arguments
    except ValueError as error:
        raise _refusal(argument, given, f"cannot be imported ({error}); {_PATH_ADVICE}.") from error


def _function(argument: str, given: Any, what: str) -> Callable[..., Any]:
    """
    :param what: How the function is called, for the error
    :return: The function, or an object of the class, that was given
    :raises ValueError: If it cannot be called
    """
    found, arguments = _imported(argument, given)
    if isinstance(found, type):
        found, arguments = _made(argument, given, found, arguments), {}
    if not callable(found):
        raise _refusal(argument, given, f"it is of type {type(found).__name__}, which cannot be called; give {what}.")
    return _Call(found, arguments) if arguments else found


def _made(argument: str, given: Any, factory: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    """:return: What the factory makes, equal to whatever it makes with equal arguments"""
    try:
        made = factory(**arguments)
    except Exception as error:
        raise _refusal(argument, given, f"could not be made with {arguments} ({type(error).__name__}: {error}).") from error
    equality: Any = type(made).__eq__
    return _Made(factory, arguments, made) if callable(made) and equality is object.__eq__ else made


# ------------------------------------------------------------------------------------------------------------ instances


def make_source(
    n_tasks: int, n_uavs: int, max_distance: float, distribution: Any, instances: Any, generator: Any
) -> InstanceGenerator:
    """
    :param n_tasks: Number of tasks, as in :func:`~sb3_uav.envs.generators.make_generator`
    :param n_uavs: Number of UAVs
    :param max_distance: Maximum flight distance
    :param distribution: Name of a distribution, which an id may have brought along, or one of the user
    :param instances: Instances or their file; they replace a distribution with a name
    :param generator: A generator, or what makes it; it replaces a distribution with a name too
    :return: The generator of an environment's instances
    :raises ValueError: If an argument cannot be used, or two contradict each other
    """
    is_named = isinstance(distribution, str) and "." not in distribution
    if generator is None and (instances is not None or is_named):
        if not is_named:
            raise ValueError("instances and distribution both say what to draw; give one of them.")
        return make_generator(n_tasks, n_uavs, max_distance, distribution, instances)
    if generator is not None and (instances is not None or not is_named):
        other = "instances" if instances is not None else "distribution"
        raise ValueError(f"generator and {other} both say what to draw; give one of them.")
    if generator is None:
        function = _function("distribution", distribution, "function(n_instances, n_tasks, rng)")
        # The checks of the sizes are those of the plain distribution.
        make_generator(n_tasks, n_uavs, max_distance)
        source: Any = _FunctionGenerator(function, n_tasks, n_uavs, max_distance)
        _try_generator("distribution", distribution, source, repeatable=True)
        return source
    source, arguments = _imported("generator", generator)
    is_factory = isinstance(source, type) or (callable(source) and not hasattr(source, "n_tasks"))
    if is_factory:
        sizes = {"n_tasks": n_tasks, "n_uavs": n_uavs, "max_distance": max_distance}
        accepted = _parameters(source)
        known = {name: value for name, value in sizes.items() if name in accepted}
        source = _made("generator", generator, source, {**known, **arguments})
    for name in ("n_tasks", "n_uavs"):
        size = getattr(source, name, None)
        if not isinstance(size, int | np.integer) or isinstance(size, bool) or size < 1:
            raise _refusal("generator", generator, f"its {name} is {size!r}; it needs a whole number of at least 1.")
    if not callable(source):
        raise _refusal(
            "generator", generator, f"it is of type {type(source).__name__}, which cannot be called with (batch_size, rng)."
        )
    if is_drawable(generator, source):
        _try_generator("generator", generator, source, repeatable=is_factory)
    return source


def is_drawable(generator: Any, source: InstanceGenerator) -> bool:
    """
    :param generator: What an environment was given
    :param source: The generator that was made of it
    :return: Whether drawing from it changes nothing. An object of the user may have a state, and other instances the next time
    """
    return source is not generator or type(source) in _STATELESS


def _parameters(factory: Callable[..., Any]) -> set[str]:
    try:
        return set(inspect.signature(factory).parameters)
    except ValueError:
        return set()


def _try_generator(argument: str, given: Any, source: InstanceGenerator, repeatable: bool) -> None:
    """
    :param repeatable: Whether it must draw the same instances from the same random numbers, which training relies on. One
        that was given as an object may have reasons not to
    """
    drawn = _drawn(argument, given, source)
    if repeatable and drawn.digest() != _drawn(argument, given, source).digest():
        raise _refusal(
            argument, given, "it draws different instances from equal random generators; draw with the rng that it is given."
        )


def _drawn(argument: str, given: Any, source: InstanceGenerator) -> Instances:
    """:return: Two instances, checked"""
    try:
        with undisturbed_random_state():
            drawn = source(_N_TRIED, np.random.default_rng(0))
        if not isinstance(drawn, Instances):
            raise ValueError(f"it returned an object of type {type(drawn).__name__}; return sb3_uav.envs.Instances.")
        found, expected = (len(drawn), drawn.n_tasks, drawn.n_uavs), (_N_TRIED, source.n_tasks, source.n_uavs)
        # Fewer tasks are padded.
        if found != expected and (found[::2] != expected[::2] or drawn.n_tasks > source.n_tasks):
            text = "{} instances of {} tasks and {} UAVs"
            raise ValueError(f"it drew {text.format(*found)} instead of {text.format(*expected)}.")
        drawn.validate()
    except Exception as error:
        raise _refusal(argument, given, error if isinstance(error, ValueError) else f"it failed with {error!r}.") from error
    return drawn


# ----------------------------------------------------------------------------------------------------- routers, rewards


def make_router(router: Any) -> Callable[[Instances], th.Tensor] | None:
    """
    :param router: What an environment was given; None for none
    :return: The router
    :raises ValueError: If there is no such file, pair or function
    """
    if isinstance(router, str) and (router.endswith(".zip") or "." not in router):
        try:
            found: Callable[[Instances], th.Tensor] = offered("load_router")(router)
        except (ValueError, OSError) as error:
            raise _refusal("router", router, f"{error} Or give the dotted path of a function.") from error
        return found
    return None if router is None else _function("router", router, "function(instances)")


def make_reward(reward: Any) -> Reward | None:
    """
    :param reward: What an environment was given; None for none
    :return: The reward
    :raises ValueError: If there is no such function
    """
    return None if reward is None else _function("reward", reward, "function(instances, tours)")


def try_router(
    given: Any, router: Callable[[Instances], th.Tensor], divide: Callable[[Instances], Instances], source: InstanceGenerator
) -> None:
    """
    Let a router plan the tours of two instances.

    :param given: What the environment was given
    :param router: The router made of it
    :param divide: Turns instances into single-UAV ones
    :param source: Generator of the environment's instances
    :raises ValueError: If it fails, or returns anything but feasible tours
    """
    try:
        with undisturbed_random_state(), th.no_grad():
            subsets = divide(source(_N_TRIED, np.random.default_rng(0)))
            _check_tours(subsets, router(subsets))
    except Exception as error:
        raise _refusal("router", given, error if isinstance(error, ValueError) else f"it failed with {error!r}.") from error


def _check_tours(subsets: Instances, nodes: Any) -> None:
    form = f"return int64 nodes of shape ({len(subsets)}, n_steps): 0 is the depot and padding, j + 1 the task j"
    if not isinstance(nodes, th.Tensor) or nodes.dtype != th.int64 or nodes.dim() != 2 or len(nodes) != len(subsets):
        is_tensor = isinstance(nodes, th.Tensor)
        what = f"{nodes.dtype} of shape {tuple(nodes.shape)}" if is_tensor else f"an object of type {type(nodes).__name__}"
        raise ValueError(f"it returned {what}; {form}.")
    nodes = nodes.to(subsets.device)
    if nodes.numel() and (nodes.min() < 0 or nodes.max() > subsets.n_tasks):
        raise ValueError(f"it returned nodes from {nodes.min()} to {nodes.max()} for {subsets.n_tasks} tasks; {form}.")
    # The depot may stand anywhere, padded tasks nowhere.
    real = th.cat([th.ones_like(subsets.task_mask[:, :1]), subsets.task_mask], dim=1)
    visits = th.zeros_like(real, dtype=th.int64).scatter_add(1, nodes, th.ones_like(nodes))
    if (visits[:, 1:] > 1).any() or (visits[~real] > 0).any():
        raise ValueError("it visited a task twice, or one that task_mask marks as padding.")
    points = th.cat([subsets.depot[:, None], subsets.tasks], dim=1)
    path = points.gather(1, th.nn.functional.pad(nodes, (1, 1))[..., None].expand(-1, -1, 2))
    lengths = euclidean(path[:, 1:], path[:, :-1]).sum(1)
    excess = lengths > distance_limit(subsets.max_distance)
    if excess.any():
        longest, limit = lengths[excess][0].item(), subsets.max_distance[excess][0].item()
        raise ValueError(f"it planned a tour of length {longest:.4g}, where a UAV flies at most {limit:.4g}.")


def try_reward(given: Any, returns: Callable[[Instances], th.Tensor], source: InstanceGenerator) -> None:
    """
    Let a reward value schedules of two instances.

    :param given: What the environment was given
    :param returns: Plans schedules and values them
    :param source: Generator of the environment's instances
    :raises ValueError: If it fails, or does not return one number per instance
    """
    try:
        with undisturbed_random_state(), th.no_grad():
            returns(source(_N_TRIED, np.random.default_rng(0)))
    except Exception as error:
        raise _refusal("reward", given, error if isinstance(error, ValueError) else f"it failed with {error!r}.") from error

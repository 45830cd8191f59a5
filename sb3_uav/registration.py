"""Environment ids. Importing this module requires only gymnasium; the environments are imported when they are made."""

import difflib
import re
from typing import Any

import gymnasium as gym

PAPER_FLEETS = (4, 6)
PAPER_SIZES = (80, 100, 150, 200, 300, 500)
GENERALIZATION_SIZES = (600, 700, 800, 900, 1000, 1500)
# With the paper's D = 2.0, almost all of these few tasks could be visited, and there would be little to learn.
DEMO_FLEET, DEMO_SIZE, DEMO_MAX_DISTANCE = 3, 20, 1.5
# Training batches of mixed sizes, for one pair of networks that handles all of them.
UNIVERSAL_ID, UNIVERSAL_FLEET, UNIVERSAL_SIZE = "TaskAllocation-Universal-v0", 8, 500
# The same for the whole problem: any values, fleets and service costs.
WORLD_ID, WORLD_FLEET, WORLD_SIZE = "TaskAllocation-World-v0", 10, 500
# Of any size, by keyword arguments; the paper's smallest scenario without any.
ALLOCATION_ID, ROUTING_ID = "TaskAllocation-v0", "RoutePlanning-v0"

_ALLOCATION, _ROUTING = "allocation:TaskAllocationEnv", "routing:RoutePlanningEnv"
# Numbers are written in one way only, so that a scenario has one id.
_ALLOCATION_PATTERN = re.compile(r"TaskAllocation-U([1-9]\d*)-N([1-9]\d*)-v0")
_ROUTING_PATTERN = re.compile(r"RoutePlanning-N([1-9]\d*)-v0")


def allocation_id(n_uavs: int, n_tasks: int) -> str:
    return f"TaskAllocation-U{n_uavs}-N{n_tasks}-v0"


def routing_id(n_tasks: int) -> str:
    return f"RoutePlanning-N{n_tasks}-v0"


def register_envs() -> None:
    """
    Register the paper's scenarios (D = 2.0), the demo, the mixtures, and both levels without a size. Registering them again
    has no effect.
    """
    sizes = (*PAPER_SIZES, *GENERALIZATION_SIZES)
    for n_uavs in PAPER_FLEETS:
        for n_tasks in sizes:
            _register(allocation_id(n_uavs, n_tasks), _ALLOCATION, n_tasks, n_uavs=n_uavs)
    for n_tasks in sizes:
        _register(routing_id(n_tasks), _ROUTING, n_tasks)
    demo = {"max_distance": DEMO_MAX_DISTANCE}
    _register(allocation_id(DEMO_FLEET, DEMO_SIZE), _ALLOCATION, DEMO_SIZE, n_uavs=DEMO_FLEET, **demo)
    _register(routing_id(DEMO_SIZE), _ROUTING, DEMO_SIZE, **demo)
    universal = dict(n_uavs=UNIVERSAL_FLEET, distribution="mixture")
    _register(UNIVERSAL_ID, _ALLOCATION, UNIVERSAL_SIZE, **universal)
    _register(WORLD_ID, _ALLOCATION, WORLD_SIZE, n_uavs=WORLD_FLEET, distribution="world")
    _register(ALLOCATION_ID, _ALLOCATION, PAPER_SIZES[0], n_uavs=PAPER_FLEETS[0])
    _register(ROUTING_ID, _ROUTING, PAPER_SIZES[0])


def _register(env_id: str, entry_point: str, n_tasks: int, **kwargs: Any) -> None:
    if env_id not in gym.registry:
        gym.register(
            id=env_id,
            entry_point=f"sb3_uav.envs.{entry_point}",
            # No max_episode_steps: episodes end after at most n_tasks + 1 steps, and a limit would truncate longer ones when
            # the environment is made with another n_tasks.
            kwargs={"n_tasks": n_tasks, **kwargs},
        )


def size_of(env_id: str) -> tuple[int, int] | None:
    """
    :param env_id: Id of an environment
    :return: Number of UAVs and of tasks of an id of the pattern ``TaskAllocation-U{V}-N{N}-v0``; 1 and the number of tasks of
        ``RoutePlanning-N{N}-v0``; None for other ids
    """
    if match := _ALLOCATION_PATTERN.fullmatch(env_id):
        return int(match[1]), int(match[2])
    if match := _ROUTING_PATTERN.fullmatch(env_id):
        return 1, int(match[1])
    return None


def ensure_registered(env_id: str, argument: str = "--env") -> None:
    """
    Register the id of a scenario of any size, with the paper's maximum flight distance (D = 2.0).

    :param env_id: Id of an environment
    :param argument: What gave the id, named in the error
    :raises ValueError: If no environment has the id; the message lists what exists and the nearest ids
    """
    if env_id in gym.registry:
        return
    size = size_of(env_id)
    if size is None:
        ours = sorted(name for name in gym.registry if name.startswith(("TaskAllocation-", "RoutePlanning-")))
        nearest = difflib.get_close_matches(env_id, [*ours, *gym.registry], n=3, cutoff=0.6)
        guess = f"did you mean {' or '.join(dict.fromkeys(nearest))}? " if nearest else ""
        raise ValueError(
            f"{argument} is {env_id!r}, which no environment has; {guess}"
            "There are TaskAllocation-U{V}-N{N}-v0 for any V UAVs and N tasks (TaskAllocation-U4-N80-v0), "
            "RoutePlanning-N{N}-v0 for any N tasks (RoutePlanning-N80-v0), "
            f"{ALLOCATION_ID} and {ROUTING_ID} with --env-kwargs (n_tasks:40 n_uavs:3), {UNIVERSAL_ID}, {WORLD_ID}, and what "
            "--gym-packages registers."
        )
    n_uavs, n_tasks = size
    if env_id.startswith("TaskAllocation"):
        _register(env_id, _ALLOCATION, n_tasks, n_uavs=n_uavs)
    else:
        _register(env_id, _ROUTING, n_tasks)

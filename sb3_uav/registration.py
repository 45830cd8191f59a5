"""Environment ids. Importing this module requires only gymnasium; the environments are imported when they are made."""

from typing import Any

import gymnasium as gym

PAPER_FLEETS = (4, 6)
PAPER_SIZES = (80, 100, 150, 200, 300, 500)
GENERALIZATION_SIZES = (600, 700, 800, 900, 1000, 1500)
# With the paper's D = 2.0, almost all of these few tasks could be visited, and there would be little to learn.
DEMO_FLEET, DEMO_SIZE, DEMO_MAX_DISTANCE = 3, 20, 1.5
# Training batches of mixed sizes, for one pair of networks that handles all of them.
UNIVERSAL_ID, UNIVERSAL_FLEET, UNIVERSAL_SIZE = "TaskAllocation-Universal-v0", 8, 500


def allocation_id(n_uavs: int, n_tasks: int) -> str:
    return f"TaskAllocation-U{n_uavs}-N{n_tasks}-v0"


def routing_id(n_tasks: int) -> str:
    return f"RoutePlanning-N{n_tasks}-v0"


def register_envs() -> None:
    """Register the paper's scenarios (D = 2.0), the demo and the mixture. Registering them again has no effect."""
    sizes = (*PAPER_SIZES, *GENERALIZATION_SIZES)
    for n_uavs in PAPER_FLEETS:
        for n_tasks in sizes:
            _register(allocation_id(n_uavs, n_tasks), "allocation:TaskAllocationEnv", n_tasks, n_uavs=n_uavs)
    for n_tasks in sizes:
        _register(routing_id(n_tasks), "routing:RoutePlanningEnv", n_tasks)
    demo = {"max_distance": DEMO_MAX_DISTANCE}
    _register(allocation_id(DEMO_FLEET, DEMO_SIZE), "allocation:TaskAllocationEnv", DEMO_SIZE, n_uavs=DEMO_FLEET, **demo)
    _register(routing_id(DEMO_SIZE), "routing:RoutePlanningEnv", DEMO_SIZE, **demo)
    universal = dict(n_uavs=UNIVERSAL_FLEET, distribution="mixture")
    _register(UNIVERSAL_ID, "allocation:TaskAllocationEnv", UNIVERSAL_SIZE, **universal)


def _register(env_id: str, entry_point: str, n_tasks: int, **kwargs: Any) -> None:
    if env_id not in gym.registry:
        gym.register(
            id=env_id,
            entry_point=f"sb3_uav.envs.{entry_point}",
            # No max_episode_steps: episodes end after at most n_tasks + 1 steps, and a limit would truncate longer ones when
            # the environment is made with another n_tasks.
            kwargs={"n_tasks": n_tasks, **kwargs},
        )

"""``-i`` with a pair: when a run starts anew from weights that were trained before, and what changes in its YAML entry."""

from __future__ import annotations

import re
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_uav import pretrained
from sb3_uav.envs import RoutePlanningEnv
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.policies.loading import StoredPolicy, read_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.any_size import fits
from sb3_uav.training import ITSCallback, PretrainedRouterCallback
from sb3_uav.training.its import ROUTER_FILE
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, STATE_FILE
from sb3_uav.zoo.checkpoints import find_checkpoint, find_router
from sb3_uav.zoo.tuning import problem_env_class


class Weights(NamedTuple):
    """
    What a new run starts from.

    :param zip_file: Zip of one of our policies
    :param router: Zip of the allocator's router; None for a router's zip, and if there is none
    """

    zip_file: Path
    router: Path | None


def zip_of_pair(name: str, env_id: str | None) -> Path | None:
    """
    :param name: What ``-i`` was given
    :param env_id: Id of the environment
    :return: The zip of the pair of this name for that environment; None if there is a file of this name, or no such pair
    """
    if name not in pretrained.names() or Path(name).is_file():
        return None
    env_class = problem_env_class(env_id) if env_id is not None and env_id in gym.registry else None
    is_routing = env_class is not None and issubclass(env_class, RoutePlanningEnv)
    return pretrained.files(name)[1 if is_routing else 0]


def weights_to_start_from(
    trained_agent: Path,
    algorithm: type[BaseAlgorithm],
    observation_space: spaces.Space,
    action_space: spaces.Space,
    callbacks: Any,
) -> Weights | None:
    """
    Decide whether ``-i`` resumes a run or starts a new one.

    A run is resumed on an environment of the size that the zip was saved on, by the same algorithm, and with ``ITSCallback``
    from its checkpoint. The pairs that come with the package always start a new one.

    :param trained_agent: What ``-i`` was given
    :param algorithm: The algorithm of ``--algo``
    :param observation_space: Observation space of the environment
    :param action_space: Its action space
    :param callbacks: The ``callback`` of the YAML entry
    :return: The weights of the new run; None if rl_zoo3 is to resume it, or to say what is wrong with the zip
    :raises FileNotFoundError: If a router is needed and there is none near the zip
    :raises ValueError: If the zip is that of the other level, or bound to another number of UAVs
    """
    try:
        stored = read_policy(trained_agent)
    except ValueError:
        return None
    if not fits(stored, observation_space, action_space):
        return None
    has_its = callback_arguments(callbacks, ITSCallback) is not None
    is_allocator = issubclass(stored.policy_class, AllocatorPolicy)
    same = _sizes(stored) in (None, _sizes_of(observation_space, action_space)) and _family(algorithm) == _family_of(stored)
    shipped = any(trained_agent.resolve() == file for name in pretrained.names() for file in pretrained.files(name))
    if same and not shipped and (not has_its or find_checkpoint(trained_agent) is not None):
        return None
    router = find_router(trained_agent) if is_allocator else None
    if has_its and router is None and _needs_router(callbacks):
        beside, below = trained_agent.parent, trained_agent.parent / CHECKPOINT_FOLDER
        raise FileNotFoundError(
            f"-i {trained_agent}: neither {beside} nor {below} holds {STATE_FILE}, which names its router, and there is no "
            f"{ROUTER_FILE} beside it to start a new run with; put the router's zip there under this name."
        )
    return Weights(trained_agent, router)


def start_from(weights: Weights, hyperparams: dict[str, Any]) -> dict[str, Any]:
    """
    The YAML entry of a run that starts from these weights: ``ITSCallback`` goes on with the router, without warm start and
    pre-training; without ``ITSCallback`` the router gives the rewards.

    :param weights: The weights
    :param hyperparams: The entry, which stays as it is
    :return: The entry to use
    """
    changed = dict(hyperparams)
    if weights.router is None:
        return changed
    given = changed.get("callback")
    callbacks = deepcopy(given if isinstance(given, list) else [given] if given else [])
    router = str(weights.router)
    its = callback_arguments(callbacks, ITSCallback)
    if its is None:
        if callback_arguments(callbacks, PretrainedRouterCallback) is None:
            # First, because others may evaluate before the first update.
            callbacks.insert(0, {f"sb3_uav.training.{PretrainedRouterCallback.__name__}": {"router": router}})
    elif _needs_router(callbacks):
        settings = {key: value for key, value in its["router"].items() if key not in ("policy", "policy_kwargs")}
        its |= {"router": {"zip": router, **settings}, "n_pretraining_epochs": 0}
        its.pop("warm_start", None)
    return {**changed, "callback": callbacks}


def callback_arguments(callbacks: Any, cls: type) -> dict[str, Any] | None:
    """
    :param callbacks: The ``callback`` of a YAML entry
    :param cls: The class of a callback
    :return: Its arguments in the entry, which can be changed in place; None if it is not there
    """
    for entry in callbacks if isinstance(callbacks, list) else [callbacks]:
        name = next(iter(entry)) if isinstance(entry, dict) and entry else entry
        if str(name).rpartition(".")[2] == cls.__name__:
            return entry[name] if isinstance(entry, dict) and isinstance(entry[name], dict) else {}
    return None


def _needs_router(callbacks: Any) -> bool:
    """Whether the ``ITSCallback`` of an entry would train a router from scratch."""
    router = (callback_arguments(callbacks, ITSCallback) or {}).get("router")
    return isinstance(router, dict) and not router.keys() & {"zip", "pretrained"}


def _sizes(stored: StoredPolicy) -> tuple[int, int] | None:
    """
    :param stored: A stored policy
    :return: Numbers of tasks and of actions of the environment that the zip was saved on, read from the text that SB3 writes
        beside its pickles; None if there is none
    """
    observed, acted = (stored.attributes.get(name) for name in ("observation_space", "action_space"))
    if not isinstance(observed, dict) or not isinstance(acted, dict):
        return None
    n_tasks = re.search(r"task_mask'[:,] MultiBinary\((\d+)\)", str(observed.get("spaces")))
    n_actions = re.fullmatch(r"\d+", str(acted.get("n")))
    return None if n_tasks is None or n_actions is None else (int(n_tasks[1]), int(n_actions[0]))


def _sizes_of(observation_space: spaces.Space, action_space: spaces.Space) -> tuple[int, int]:
    assert isinstance(observation_space, spaces.Dict) and isinstance(action_space, spaces.Discrete)
    (n_tasks,) = observation_space["task_mask"].shape or ()
    return n_tasks, int(action_space.n)


def _family(algorithm: type[BaseAlgorithm]) -> str:
    """Which algorithms can read each other's zips."""
    return "reinforce" if issubclass(algorithm, REINFORCE) else "ppo" if issubclass(algorithm, PPO | MaskablePPO) else "other"


def _family_of(stored: StoredPolicy) -> str:
    attributes = stored.attributes
    return "reinforce" if "stream_seed" in attributes else "ppo" if "clip_range" in attributes else "other"

"""Whether one of our policies fits an environment of another size than the one it was trained on."""

from __future__ import annotations

import io
import pathlib
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_uav.envs.allocation import AllocationProblem
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.problem import Problem
from sb3_uav.envs.routing import RoutingProblem
from sb3_uav.policies import EpisodicPolicy, RouterPolicy
from sb3_uav.policies.loading import StoredPolicy, read_policy

SelfT = TypeVar("SelfT", bound="AnySizeAlgorithm")


def problem_of_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> Problem | None:
    """
    :param observation_space: Observation space of an environment or of a zip
    :param action_space: Its action space
    :return: A problem of ours that has exactly these spaces, of either level and of any size; None if there is none
    """
    if not isinstance(observation_space, spaces.Dict) or not isinstance(action_space, spaces.Discrete):
        return None
    mask = observation_space.spaces.get("task_mask")
    if mask is None or len(mask.shape or ()) != 1:
        return None
    n_tasks = mask.shape[0]  # type: ignore[index]
    # A router's environment has as many actions as nodes, which is then no number of UAVs.
    allocation = AllocationProblem(UniformGenerator(n_tasks, int(action_space.n)))
    problems: tuple[Problem, ...] = (allocation, RoutingProblem(UniformGenerator(n_tasks)))
    fitting = [p for p in problems if p.observation_space == observation_space and p.action_space == action_space]
    return fitting[0] if fitting else None


def environment_name(policy_class: type[EpisodicPolicy]) -> str:
    """:return: What an id of the environments of this policy begins with"""
    return policy_class.extractor_class.environment


def fits(stored: StoredPolicy, observation_space: spaces.Space, action_space: spaces.Space) -> bool:
    """
    :param stored: One of our policies
    :param observation_space: Observation space of an environment
    :param action_space: Its action space
    :return: Whether it is an environment of ours, which the policy then serves whatever its size
    :raises ValueError: If it is one of the other level, or the network is bound to another number of UAVs
    """
    problem = problem_of_spaces(observation_space, action_space)
    if problem is None:
        return False
    is_router = issubclass(stored.policy_class, RouterPolicy)
    if is_router is not isinstance(problem, RoutingProblem):
        needed = environment_name(stored.policy_class)
        found = "TaskAllocation" if is_router else "RoutePlanning"
        raise ValueError(
            f"{stored.file}: holds {stored.policy_class.__name__}, which needs a {needed} environment, but this one is a "
            f"{found} environment; give the zip of the {'allocator' if is_router else 'router'}, or a {needed} environment."
        )
    if not is_router and stored.n_uavs not in (None, problem.generator.n_uavs):
        raise ValueError(
            f"{stored.file}: its network is bound to the {stored.n_uavs} UAVs that it was trained for, as that of preset "
            f"'paper' is, but the environment has {problem.generator.n_uavs}; make one with n_uavs={stored.n_uavs}, or take "
            "an allocator of preset 'default', which serves any fleet."
        )
    return True


def own_spaces(path: str | pathlib.Path | io.BufferedIOBase, env: GymEnv) -> dict[str, spaces.Space]:
    """
    What makes SB3's ``load`` accept an environment of another size, as in
    ``PPO.load(path, env, custom_objects=own_spaces(path, env))``.

    SB3 compares the spaces of the zip with those of the environment. For one of our policies on one of our environments of
    its level, whatever their sizes, these are the environment's; else there are none, so that SB3's check remains as it is.
    ``REINFORCE.load`` does this by itself.

    :param path: The zip; a file object is left to SB3
    :param env: The environment
    :return: ``custom_objects`` for ``load``
    :raises ValueError: If the environment is of the other level, or the network is bound to another number of UAVs
    """
    if not isinstance(path, str | pathlib.Path):
        return {}
    try:
        stored = read_policy(path)
    except (ValueError, OSError):
        # Not ours, or not intact: SB3 loads the first and knows what to say of the second.
        return {}
    policy_class = stored.attributes.get("policy_class")
    module = str(policy_class.get("__module__")) if isinstance(policy_class, dict) else ""
    # One of our extractors in a stock policy, whose layers on top may be bound to a size.
    is_stock = module.startswith(("stable_baselines3.", "sb3_contrib."))
    if is_stock or not fits(stored, env.observation_space, env.action_space):
        return {}
    return {"observation_space": env.observation_space, "action_space": env.action_space}


class AnySizeAlgorithm(OnPolicyAlgorithm):
    """An on-policy algorithm whose ``load`` takes our policies to environments of any size."""

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L634
    @classmethod
    def load(
        cls: type[SelfT],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfT:
        """
        SB3's ``load``, for environments of any size: the spaces of the zip give way to those of ``env`` if it holds one of our
        policies, and ``env`` is one of our environments of its level. Everything else is SB3's: the file is unpickled, so load
        only zips that you trust (:func:`sb3_uav.reinforce.transfer.load` reads others), and settings, counters of steps and
        epochs and the optimizer continue from where they were.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on
        :param device: Device on which the code should run.
        :param custom_objects: Dictionary of objects to replace upon loading.
        :param print_system_info: Whether to print system info from the saved model and the current system info
        :param force_reset: Force call to ``reset()`` before training
        :param kwargs: extra arguments to change the model when loading
        :return: new model instance with loaded parameters
        :raises ValueError: If the environment is a foreign one, as SB3 says; if it is of the other level, or has another
            number of UAVs than the network is bound to
        """
        given = {**({} if env is None else own_spaces(path, env)), **(custom_objects or {})}
        return super().load(path, env, device, given or None, print_system_info, force_reset, **kwargs)

"""Trained agents of a log folder: their zips, the router of each, and the environment that replays them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import ALGOS, create_test_env, get_model_path
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import NotOurPolicyError, load_policy
from sb3_uav.registration import ensure_registered
from sb3_uav.reinforce.algorithms import resolve_algorithm
from sb3_uav.training import ITSCallback
from sb3_uav.zoo.checkpoints import find_router
from sb3_uav.zoo.experiment import make_batched_vec_env
from sb3_uav.zoo.fine_tuning import callback_arguments
from sb3_uav.zoo.saved import saved_callbacks, saved_env_kwargs
from sb3_uav.zoo.trust import require_plain_run

# That of ``ITSCallback`` where an entry names none.
_ROUTER_ALGORITHM = "reinforce"


class Agent(NamedTuple):
    """
    A trained agent.

    :param model: Its zip
    :param router: Zip of the router that gives its rewards; None if the run has none
    :param run_folder: Folder of its run
    :param algo: rl_zoo3's name of its algorithm
    """

    model: Path
    router: Path | None
    run_folder: Path
    algo: str


def agent_parser(with_help: bool = True) -> argparse.ArgumentParser:
    """
    :param with_help: Whether to take ``--help``, as a flag like the others
    :return: A parser of the arguments by which rl_zoo3's commands choose an agent, with our defaults
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="reinforce", help="algorithm (default: %(default)s)")
    parser.add_argument("--env", default="CartPole-v1", help="environment ID")
    parser.add_argument("-f", "--folder", default="logs", help="log folder (default: %(default)s)")
    parser.add_argument("--exp-id", default=0, type=int, help="number of the run (default: 0, the last one)")
    parser.add_argument("--load-best", action="store_true", help="the best model of the run, not the last one")
    parser.add_argument("--load-checkpoint", type=int, metavar="STEPS", help="the checkpoint after so many steps")
    parser.add_argument("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments")
    if with_help:
        parser.add_argument("-h", "--help", action="store_true")
    return parser


def find_agent(chosen: argparse.Namespace, trust: bool) -> Agent:
    """
    :param chosen: Arguments of :func:`agent_parser`
    :param trust: Whether the run may hold more than plain data, which is then unpickled
    :return: The agent
    :raises ValueError: If there is no such environment or agent, or it is not to be trusted
    """
    for module in chosen.gym_packages:
        import_module(module)
    ensure_registered(chosen.env)
    which = (chosen.load_best, chosen.load_checkpoint, chosen.load_last_checkpoint)
    try:
        _, model, run_folder = get_model_path(chosen.exp_id, chosen.folder, chosen.algo, EnvironmentName(chosen.env), *which)
    except AssertionError as error:
        # rl_zoo3 raises it for a missing folder.
        raise ValueError(str(error)) from error
    require_plain_run(Path(run_folder), EnvironmentName(chosen.env), trust, chosen.gym_packages)
    return Agent(Path(model), find_router(Path(model)), Path(run_folder), chosen.algo)


def episode_length(agent: Agent, env_id: str) -> int | None:
    """
    :param agent: A trained agent
    :param env_id: Id of its environment
    :return: Steps of its longest episodes, which all of an allocator's are; None if that is not known
    """
    given = saved_env_kwargs(agent.run_folder, EnvironmentName(env_id))
    n_tasks = {**gym.spec(env_id).kwargs, **given}.get("n_tasks")
    return n_tasks if isinstance(n_tasks, int) else None


def environment_of(agent: Agent) -> Callable[..., VecEnv]:
    """
    :param agent: A trained agent
    :return: ``rl_zoo3.utils.create_test_env``, passing the router and the allocator's order of tasks to the environment
    """
    return partial(_create_test_env, agent)


def _create_test_env(agent: Agent, env_id: str, **kwargs: Any) -> VecEnv:
    # Some of rl_zoo3's commands know the arguments of the command line only, not those of the YAML:
    # https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/record_video.py#L75
    of_yaml = (kwargs.get("hyperparams") or {}).get("env_kwargs") or {}
    kwargs["env_kwargs"] = {**of_yaml, **(kwargs.get("env_kwargs") or {})}
    kwargs["vec_env_cls"] = make_batched_vec_env
    env: VecEnv = create_test_env(env_id, **kwargs)
    if env.has_attr("set_task_order"):
        allocator: Any
        try:
            allocator = load_policy(agent.model, "cpu", AllocatorPolicy)
        except NotOurPolicyError:
            # The user's own code, or a stock policy, which cannot be had without unpickling.
            allocator = load_model(agent.algo, agent.model, "cpu").policy
        # Stock policies define no order.
        if isinstance(allocator, AllocatorPolicy):
            env.env_method("set_task_order", allocator.env_order)
    if agent.router is not None and env.has_attr("set_router"):
        router: Any
        try:
            router = load_policy(agent.router, expected=RouterPolicy)
        except NotOurPolicyError:
            router = load_model(_router_algorithm(agent.run_folder, EnvironmentName(env_id)), agent.router).policy
        env.env_method("set_router", router.plan)
        print(f"Rewards come from the router {agent.router}")
    return env


def load_model(algo: str, zip_file: Path, device: str = "auto") -> BaseAlgorithm:
    """
    Load an agent as SB3 does, which runs any code in its zip unless :func:`sb3_uav.zoo.trust.reading` prevents it.

    :param algo: rl_zoo3's name of its algorithm, or a dotted path
    :param zip_file: Its zip
    :param device: Its device
    :return: The agent, to be played only
    """
    # As rl_zoo3's commands do: https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/enjoy.py#L190
    unused = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    algorithm = ALGOS[algo] if algo in ALGOS else resolve_algorithm(algo)
    return algorithm.load(zip_file, device=device, custom_objects=unused)


def _router_algorithm(run_folder: Path, env_name: str) -> str:
    """:return: Name or dotted path of the algorithm of the router that a run has trained"""
    settings = (callback_arguments(saved_callbacks(run_folder, env_name), ITSCallback) or {}).get("router")
    return str(settings.get("algo", _ROUTER_ALGORITHM)) if isinstance(settings, dict) else _ROUTER_ALGORITHM


def without_flag(arguments: Sequence[str], flag: str) -> tuple[list[str], bool]:
    """
    :param arguments: Command line arguments
    :param flag: A flag of ours that rl_zoo3 does not know
    :return: The other arguments, and whether the flag was among them
    """
    return [argument for argument in arguments if argument != flag], flag in arguments


def without_packages(arguments: Sequence[str]) -> list[str]:
    """
    :param arguments: Command line arguments
    :return: Those besides ``--gym-packages``
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--gym-packages", nargs="+")
    return parser.parse_known_args(arguments)[1]

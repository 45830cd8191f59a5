"""What all runs of a comparison share: the problem, the validation set, the router and the settings of earlier runs."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import torch as th

from sb3_uav.common.files import file_hash, write_atomically
from sb3_uav.common.random_streams import SHARED_SEED
from sb3_uav.envs import Instances
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.registration import ensure_registered
from sb3_uav.studies.compare.fixed_router import pretrain_router
from sb3_uav.studies.compare.settings import Settings
from sb3_uav.studies.compare.variants import router_settings
from sb3_uav.training.fixed_set_returns import draw_fixed_set, fingerprint

_SETTINGS_FILE = "settings.json"
VALIDATION_FILE = "validation.npz"
ROUTER_FILE = "router.zip"


def make_problem(env_id: str) -> Any:
    """
    :param env_id: Id of an environment
    :return: The problem behind it
    :raises ValueError: If there is none, or it is not one of ours
    """
    ensure_registered(env_id)
    environment = gym.make(env_id).unwrapped
    if not isinstance(environment, ProblemEnv):
        raise ValueError(f"--env {env_id}: is not an environment of sb3_uav.")
    return environment.problem


def make_validation_set(settings: Settings, problem: Any) -> None:
    """
    Put the validation set into the folder, unless it is there.

    :param settings: Settings of the comparison
    :param problem: The problem whose instances are drawn
    """

    path = settings.out / VALIDATION_FILE
    if settings.instances is not None:
        instances = Instances.load(settings.instances)
    else:
        instances = draw_fixed_set(problem, settings.n_instances, SHARED_SEED)
    if not path.is_file():
        instances.save(path)
    elif fingerprint(Instances.load(path), settings.samples) != fingerprint(instances, settings.samples):
        raise ValueError(f"{path} holds another validation set; choose another --out, or the validation set of before.")


def make_router(settings: Settings, problem: Any) -> None:
    """
    Put the router of all rewards into the folder, unless it is there; train it if none is given.

    :param settings: Settings of the comparison
    :param problem: The allocation problem
    """

    path = settings.out / ROUTER_FILE
    note = path.with_suffix(".txt")
    if settings.router is not None:
        load_policy(settings.router, "cpu", RouterPolicy)
        if path.is_file() and path.read_bytes() != settings.router.read_bytes():
            raise ValueError(
                f"{path} is another router than {settings.router}; choose another --out, or the --router of before."
            )
        write_atomically(path, settings.router.read_bytes())
        write_atomically(note, f"{settings.router.name}, given by --router")
        return
    if path.is_file() and note.is_file():
        load_policy(path, "cpu", RouterPolicy)
        return

    print(f"Training the router on {settings.router_subsets:,} subsets ...", flush=True)
    th.set_num_threads(settings.num_threads)
    recipe = router_settings(settings.env)
    done = pretrain_router(problem.generator, recipe, settings.router_subsets, path, SHARED_SEED, settings.device)
    write_atomically(note, done)


def check_settings(settings: Settings, needs_router: bool) -> None:
    """
    Check that earlier runs in the folder have the same settings.

    :param settings: Settings of the comparison
    :param needs_router: Whether the common router gives the rewards
    :raises ValueError: If they have other settings
    """

    now = {
        "env": settings.env,
        "n_timesteps": settings.n_timesteps,
        "eval_freq": settings.eval_freq,
        "samples": settings.samples,
        "its": settings.its,
        "num_threads": settings.num_threads,
        "device": settings.device,
        "router": file_hash(settings.out / ROUTER_FILE) if needs_router else None,
    }
    path = settings.out / _SETTINGS_FILE
    # A folder without runs restricts nothing.
    if path.is_file() and any((settings.out / "runs").glob("*/seed_*")):
        for key, before in json.loads(path.read_text()).items():
            if now[key] != before:
                raise ValueError(f"{path}: {key} was {before} in earlier runs and is {now[key]} now; choose another --out.")
    write_atomically(path, json.dumps(now, indent=1))

"""
Trained pairs that come with the package, each in a folder of its own beside its model card.

``allocator.zip`` and ``router.zip`` are ordinary SB3 zips without the state of their optimizers. To predict or to go on
learning with one of them, on an environment of any size::

    from sb3_uav import pretrained

    model = pretrained.load("universal", level="allocator", env=env)
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
    from stable_baselines3.common.type_aliases import GymEnv

__all__ = ["files", "load", "names", "pair_files", "router_file"]

DEFAULT_PAIR = "universal"
ALLOCATOR_FILE, ROUTER_FILE = "allocator.zip", "router.zip"


def names() -> list[str]:
    """:return: Names of all pairs"""
    return sorted(file.parent.name for file in Path(__file__).parent.glob(f"*/{ALLOCATOR_FILE}"))


def files(name: str = DEFAULT_PAIR) -> tuple[Path, Path]:
    """
    :param name: Name of a pair
    :return: The zips of its allocator and of its router
    :raises ValueError: If there is no such pair
    """
    if name not in names():
        raise ValueError(f"There is no trained pair {name!r}; choose one of {names()}.")
    folder = Path(__file__).parent / name
    return folder / ALLOCATOR_FILE, folder / ROUTER_FILE


def pair_files(allocator: str | None = None, router: str | None = None) -> tuple[Path, Path]:
    """
    :param allocator: A zip, or the name of a pair; the default pair when None
    :param router: A zip; that of the pair when None
    :return: The zips of allocator and router
    :raises ValueError: If one of them is a zip and the other is not given
    """
    if allocator is None or allocator in names():
        found = files(allocator or DEFAULT_PAIR)
        if router is None:
            return found
        if allocator is not None:
            return found[0], Path(router)
    if allocator is None or router is None:
        missing, given = ("allocator", router) if allocator is None else ("router", allocator)
        raise ValueError(
            f"{given} is one zip of a pair, and its {missing} is missing: give both, or the name of a pair, one of {names()}."
        )
    return Path(allocator), Path(router)


def router_file(source: str | os.PathLike[str]) -> Path:
    """
    :param source: Name of a pair, or the zip of a router; ``.zip`` is appended if there is no such file
    :return: The router's zip
    :raises FileNotFoundError: If it is neither
    """
    if str(source) in names():
        return files(str(source))[1]
    path = Path(source)
    for found in (path, path.with_name(f"{path.name}.zip")):
        if found.is_file():
            return found
    raise FileNotFoundError(
        f"router: {path}: no such file; give the zip of a router that was trained before, or one of {names()}."
    )


def load(
    name: str = DEFAULT_PAIR,
    level: str = "allocator",
    env: GymEnv | str | None = None,
    algorithm: str | type[OnPolicyAlgorithm] = "reinforce",
    router: str | os.PathLike[str] | None = None,
    **kwargs: Any,
) -> Any:
    """
    One of the networks of a pair as an SB3 algorithm, which predicts and learns on an environment of any size.

    The environment of an allocator gets the pair's router for its rewards and presents the tasks in the allocator's order,
    from its next ``reset`` on. The settings are those for fine-tuning, see
    :func:`~sb3_uav.reinforce.transfer.fine_tuning_settings`: a learning rate of 1e-4, for ``REINFORCE`` 8 samples per
    instance with their mean as the baseline, for PPO rollouts of whole episodes without discount. Any argument of the
    algorithm replaces them. Counters start from 0, and the optimizer is fresh.

    :param name: Name of a pair
    :param level: ``"allocator"`` for a ``TaskAllocation`` environment, or ``"router"`` for a ``RoutePlanning`` one
    :param env: The environment (if registered in Gym, can be str)
    :param algorithm: ``"reinforce"``, ``"ppo"``, ``"ppo_mask"``, ``"a2c"``, or the class or dotted path of another on-policy
        algorithm
    :param router: Zip of another router for the rewards, or the name of its pair, with ``level="allocator"``
    :param kwargs: Arguments of the algorithm, and ``policy_kwargs`` that replace those of the zip
    :return: A new model of that algorithm
    :raises FileNotFoundError: If there is no such zip
    :raises ValueError: If there is no such pair or level, or the environment is missing or none of ours of that level
    """
    from stable_baselines3.common.base_class import maybe_make_env

    from sb3_uav.policies import RouterPolicy
    from sb3_uav.policies.loading import load_policy
    from sb3_uav.reinforce import transfer

    if level not in ("allocator", "router"):
        raise ValueError(f"level is {level!r}; choose 'allocator' or 'router'.")
    if router is not None and level == "router":
        raise ValueError(f"router is {str(router)!r}, but only the rewards of an allocator come from a router; leave it out.")
    allocator_zip, router_zip = files(name)
    if router is not None:
        # Before the model is made, as a name may be misspelled.
        router_zip = router_file(router)
    made: Any = maybe_make_env(env, 0)  # type: ignore[arg-type]
    if made is None:
        raise ValueError("env is missing; give the environment to predict or to learn on, of any size.")
    path = allocator_zip if level == "allocator" else router_zip
    # What cannot be learned on is refused before settings are looked up for it.
    transfer.require_fit(path, made)
    model = transfer.load(path, made, algorithm, **{**transfer.fine_tuning_settings(algorithm, made), **kwargs})
    if level == "allocator":
        planner = load_policy(router_zip, model.device, RouterPolicy)
        model.env.env_method("set_router", planner.plan)
    return model

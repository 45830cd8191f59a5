"""Which entry of a YAML an environment uses, and what of it depends on the number of tasks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from sb3_uav.registration import ALLOCATION_ID, ROUTING_ID, size_of


def find_entry(entries: Mapping[Any, Any], env_id: str, env_kwargs: Mapping[str, Any] | None = None) -> str | None:
    """
    :param entries: The entries of a YAML
    :param env_id: Id of a registered environment
    :param env_kwargs: Arguments of the environment
    :return: Its own entry; else, of an environment of ours of any size, that of the nearest size; else that of
        ``TaskAllocation-v0`` or ``RoutePlanning-v0``; None if there is none of these
    """
    generic = _level(env_id)
    if env_id in entries or generic is None:
        return env_id if env_id in entries else None
    # A size that is no number ends the command when the environment is made, which names the argument.
    size = _size(env_id, env_kwargs or {}) or _size(env_id, {})
    sizes = {str(name): size_of(str(name)) for name in entries if _level(str(name)) == generic}
    distances = {name: _distance(size, other) for name, other in sizes.items() if size is not None and other is not None}
    if distances:
        return min(distances, key=lambda name: distances[name])
    return generic if generic in entries else None


def scaled_values(
    entry: Mapping[str, Any], name: str, env_id: str, env_kwargs: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """
    Adapt an allocator's entry to another number of tasks, which is the length of its episodes.

    :param entry: The entry
    :param name: Its name
    :param env_id: Id of the environment that uses it
    :param env_kwargs: Arguments of the environment that replace those of the entry
    :return: The values that differ: ``n_timesteps`` for as many episodes, ``n_steps`` and ``batch_size`` for whole ones
    """
    if _level(env_id) != ALLOCATION_ID:
        return {}
    own = entry.get("env_kwargs")
    own = own if isinstance(own, dict) else {}
    before, after = _size(name, own), _size(env_id, env_kwargs or own)
    if before is None or after is None or before[1] == after[1]:
        return {}
    old, new = before[1], after[1]
    values = {}
    if _is_number(entry.get("n_timesteps")):
        values["n_timesteps"] = math.ceil(entry["n_timesteps"] * new / old)
    for key in ("n_steps", "batch_size"):
        if _is_number(entry.get(key)) and entry[key] % old == 0:
            values[key] = int(entry[key]) // old * new
    return values


def _level(env_id: str) -> str | None:
    """:return: The id without a size of an environment of ours of any size; None for other ids"""
    if env_id in (ALLOCATION_ID, ROUTING_ID):
        return env_id
    if size_of(env_id) is None:
        return None
    return ALLOCATION_ID if env_id.startswith("TaskAllocation") else ROUTING_ID


def _size(env_id: str, env_kwargs: Mapping[str, Any]) -> tuple[int, int] | None:
    """:return: Number of UAVs and of tasks that the environment is made with; None if they are no whole numbers"""
    registered = gym.registry[env_id].kwargs if env_id in gym.registry else {}
    size = size_of(env_id) or (1, 0)
    found = {"n_uavs": size[0], "n_tasks": size[1], **registered, **env_kwargs}
    n_uavs, n_tasks = found["n_uavs"], found["n_tasks"]
    whole = all(isinstance(value, int) and not isinstance(value, bool) and value >= 1 for value in (n_uavs, n_tasks))
    return (n_uavs, n_tasks) if whole else None


def _distance(size: tuple[int, int], other: tuple[int, int]) -> float:
    """How far apart two sizes are, each number by its ratio."""
    return sum(abs(math.log(a / b)) for a, b in zip(size, other, strict=True))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)

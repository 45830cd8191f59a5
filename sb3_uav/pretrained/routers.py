"""Trained routers as functions, for the environments of allocators."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from sb3_uav.common.files import file_hash
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.envs.routing import Router
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import files, names


def load_router(source: str) -> Router:
    """
    :param source: Name of a pair of this package, or the zip of any SB3 algorithm with a ``RouterPolicy``
    :return: Its greedy planner; the same object for the same file, so that environments with it are recognized as equal
    :raises FileNotFoundError: If it is neither
    :raises ValueError: If the zip is damaged or holds another policy
    """
    if source not in names() and not source.endswith(".zip"):
        raise FileNotFoundError(f"there is no trained pair of this name; there are {', '.join(names())}")
    path = files(source)[1] if source in names() else Path(source)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    return _load(path.resolve(), file_hash(path)).plan


@lru_cache(maxsize=4)
def _load(path: Path, digest: str) -> RouterPolicy:
    """:param digest: Hash of the file, so that one that has changed is loaded again"""
    with undisturbed_random_state():
        return load_policy(path, expected=RouterPolicy)

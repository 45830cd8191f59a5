"""Trained routers as functions, for the environments of allocators."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from sb3_uav.common.files import file_hash
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.envs.routing import Router
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import router_file


def load_router(source: str) -> Router:
    """
    :param source: Name of a pair of this package, or the zip of any SB3 algorithm with a ``RouterPolicy``
    :return: Its greedy planner; the same object for the same file, so that environments with it are recognized as equal
    :raises FileNotFoundError: If it is neither
    :raises ValueError: If the zip is damaged or holds another policy
    """
    path = router_file(source)
    return _load(path.resolve(), file_hash(path)).plan


@lru_cache(maxsize=4)
def _load(path: Path, digest: str) -> RouterPolicy:
    """:param digest: Hash of the file, so that one that has changed is loaded again"""
    with undisturbed_random_state():
        return load_policy(path, expected=RouterPolicy)

"""The ``.npz`` files of instances, as plain arrays."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_uav.common.files import temporary_name
from sb3_uav.common.npz import read_npz
from sb3_uav.envs.array_input import advice_on

_NEEDED = {"depot", "tasks", "max_distance", "n_uavs"}


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """
    :param path: The file to write, under a temporary name first; ``.npz`` is appended when missing
    :param arrays: Its arrays
    """
    path = path if path.suffix == ".npz" else path.with_name(path.name + ".npz")
    with temporary_name(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)


def read_arrays(path: Path, known: Sequence[str]) -> dict[str, np.ndarray]:
    """
    :param path: The file
    :param known: Names of the arrays that it may hold
    :return: Its arrays
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If it is not an intact ``.npz``, lacks an array or holds an unknown one
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such instance file; give the path of an .npz written by Instances.save.")
    arrays = read_npz(path, "write it again")
    check_array_names(arrays, known, str(path))
    return arrays


def check_array_names(arrays: Collection[str], known: Sequence[str], source: str) -> None:
    """
    :param arrays: Names of the arrays of a file
    :param known: Names of the arrays that it may hold
    :param source: Name of the file, for errors
    :raises ValueError: If an array is missing or unknown
    """
    unknown = [name for name in arrays if name not in known]
    if unknown:
        raise ValueError(f"{source}: unknown array '{unknown[0]}'; {advice_on(unknown[0], known)}.")
    missing = _NEEDED - set(arrays)
    if missing:
        raise ValueError(f"{source}: arrays {sorted(missing)} are missing; found {sorted(arrays)}.")

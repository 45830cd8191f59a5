"""Helpers for the tests of instances: valid and invalid arrays, and a bitwise comparison."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_uav.envs import Instances


def assert_equal(a: Instances, b: Instances) -> None:
    """Bitwise."""
    assert a.n_uavs == b.n_uavs
    assert a.present_fields() == b.present_fields()
    for name in a.present_fields():
        assert getattr(a, name).dtype == getattr(b, name).dtype
        assert th.equal(getattr(a, name), getattr(b, name)), name


def arrays(**changes: Any) -> dict[str, Any]:
    """Valid arguments of ``from_arrays`` for 2 instances of 3 tasks, some of them replaced."""
    rng = np.random.default_rng(0)
    valid = {
        "depot": rng.random((2, 2)),
        "tasks": rng.random((2, 3, 2)),
        "values": rng.random((2, 3)),
        "max_distance": np.array([1.0, 2.0]),
        "n_uavs": np.array([4, 4]),
        "task_mask": np.array([[True, True, False], [True, True, True]]),
    }
    return {**valid, **changes}


def poked(name: str, index: tuple[int, ...], value: float) -> dict[str, Any]:
    """Valid arrays with one number replaced."""
    array = np.array(arrays()[name], dtype=np.float64)
    array[index] = value
    return {name: array}

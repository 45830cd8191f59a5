"""Environments in programs that change torch's default dtype or device."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch as th
from env_helpers import LEVELS, batched_env, both_levels, legal_actions, make, play, rendered, reset
from instance_helpers import arrays, assert_equal

from sb3_uav.envs import ClusteredGenerator, Instances, MixtureGenerator, UniformGenerator
from sb3_uav.envs.generators import training_batch


@pytest.fixture(params=["float64", "float16", "meta"])
def changed_default(request: pytest.FixtureRequest) -> Iterator[None]:
    """Another default dtype, or the device "meta", which stands in for "cuda"."""
    if request.param == "meta":
        th.set_default_device("meta")
    else:
        th.set_default_dtype(getattr(th, request.param))
    yield
    th.set_default_device(None)
    th.set_default_dtype(th.float32)


def run(level: str) -> list[object]:
    """Observations, rewards and the final picture of an episode, and rewards of a BatchedVecEnv."""
    env = make(level, n_tasks=5, render_mode="rgb_array")
    observations, rewards = play(env, np.random.default_rng(0), seed=3)
    shown = [{key: value.tolist() for key, value in observation.items()} for observation in observations]
    dtypes = [{key: value.dtype for key, value in observation.items()} for observation in observations]
    vec_env = batched_env(level, 3, n_tasks=5)
    vec_env.seed(0)
    reset(vec_env)
    rng = np.random.default_rng(0)
    steps = [vec_env.step(legal_actions(vec_env, rng))[1].tolist() for _ in range(8)]
    return [shown, dtypes, rewards, rendered(env).tolist(), steps]


EXPECTED = {level: run(level) for level in LEVELS}


@both_levels
@pytest.mark.usefixtures("changed_default")
def test_environments_do_not_depend_on_torchs_defaults(level: str) -> None:
    """The same observations, rewards and pictures as with float32 on the CPU."""
    assert run(level) == EXPECTED[level]


@pytest.mark.usefixtures("changed_default")
def test_instances_do_not_depend_on_torchs_defaults(tmp_path: Path) -> None:
    """Generated, made from arrays, indexed and read from files: float64 on the CPU."""
    made = Instances.from_arrays(**{**arrays(), "values": None, "task_mask": None})
    made.save(tmp_path / "made.npz")
    drawn = [generator(2, np.random.default_rng(0)) for generator in (UniformGenerator(4), ClusteredGenerator(4))]
    mixed = training_batch(MixtureGenerator(50), 4, np.random.default_rng(0))
    for instances in (made, *drawn, mixed, made[[1, 0]], made[::-1], made[[]], made.near_origin()):
        assert instances.device.type == "cpu" and instances.values.dtype == instances.tasks.dtype == th.float64
    loaded = Instances.load(tmp_path / "made.npz")
    assert loaded.device.type == "cpu"
    assert_equal(loaded, made)

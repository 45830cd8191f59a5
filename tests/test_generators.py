"""Generators of instances."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from instance_helpers import assert_equal

from sb3_uav.envs import ClusteredGenerator, FixedGenerator, InstanceGenerator, Instances, UniformGenerator
from sb3_uav.envs.generators import make_generator
from sb3_uav.envs.instances import _TENSOR_FIELDS

DRAWERS = [
    UniformGenerator(n_tasks=7, n_uavs=3, max_distance=1.5),
    ClusteredGenerator(n_tasks=7, n_uavs=3, max_distance=1.5, n_clusters=2),
    FixedGenerator(UniformGenerator(n_tasks=7, n_uavs=3, max_distance=1.5)(20, np.random.default_rng(5))),
]


@pytest.mark.parametrize("generator", DRAWERS, ids=lambda generator: type(generator).__name__)
class TestGenerators:
    def test_shapes_and_ranges(self, generator: InstanceGenerator) -> None:
        drawn = generator(200, np.random.default_rng(0))
        assert (len(drawn), drawn.n_tasks, drawn.n_uavs) == (200, 7, 3) == (200, generator.n_tasks, generator.n_uavs)
        drawn.validate()
        assert {getattr(drawn, name).dtype for name in _TENSOR_FIELDS[:4]} == {th.float64}
        for points in (drawn.depot, drawn.tasks):
            assert points.min() >= 0 and points.max() <= 1
        assert (drawn.values == 1).all() and (drawn.max_distance == 1.5).all() and drawn.task_mask.all()

    def test_same_random_state_gives_the_same_instances(self, generator: InstanceGenerator) -> None:
        """A call in between, with another random generator, has no effect."""
        first = generator(3, np.random.default_rng(7))
        generator(5, np.random.default_rng(8))
        assert_equal(first, generator(3, np.random.default_rng(7)))

    def test_streams_differ(self, generator: InstanceGenerator) -> None:
        rng = np.random.default_rng(7)
        first, next_one, other = generator(3, rng), generator(3, rng), generator(3, np.random.default_rng(8))
        assert not th.equal(first.tasks, next_one.tasks) and not th.equal(first.tasks, other.tasks)

    def test_leaves_numpys_and_torchs_global_generators_alone(self, generator: InstanceGenerator) -> None:
        np_state, th_state = repr(np.random.get_state()), th.get_rng_state()
        generator(3, np.random.default_rng(7))
        assert np_state == repr(np.random.get_state()) and th.equal(th_state, th.get_rng_state())


def test_uniform_generator_fills_the_unit_square() -> None:
    """Mean 1/2 and variance 1/12 of each coordinate of 20000 points, depots like tasks."""
    drawn = UniformGenerator(n_tasks=9)(2000, np.random.default_rng(0))
    points = th.cat([drawn.depot[:, None], drawn.tasks], dim=1)
    for axis in range(2):
        assert points[..., axis].mean().item() == pytest.approx(0.5, abs=0.01)
        assert points[..., axis].var().item() == pytest.approx(1 / 12, abs=0.002)
    assert drawn.depot.mean().item() == pytest.approx(0.5, abs=0.02)


def test_clustered_generator_clusters() -> None:
    """With spread 0 there are at most as many places as clusters, and neighbors are closer than in the uniform case."""
    drawn = ClusteredGenerator(n_tasks=30, n_clusters=3, spread=0.0)(4, np.random.default_rng(0))
    assert all(len(th.unique(tasks, dim=0)) <= 3 for tasks in drawn.tasks)

    def nearest(generator: InstanceGenerator) -> float:
        tasks = generator(50, np.random.default_rng(0)).tasks
        return (th.cdist(tasks, tasks) + 9 * th.eye(40)).min(-1).values.mean().item()

    assert nearest(ClusteredGenerator(n_tasks=40)) < 0.8 * nearest(UniformGenerator(n_tasks=40))


def test_fixed_generator_draws_whole_rows() -> None:
    """Every drawn instance is one of the given ones, and all of them are drawn eventually."""
    given_ones = UniformGenerator(n_tasks=4)(5, np.random.default_rng(0))
    drawn = FixedGenerator(given_ones)(100, np.random.default_rng(1))
    same = (drawn.tasks[:, None] == given_ones.tasks).flatten(2).all(-1) & (drawn.depot[:, None] == given_ones.depot).all(-1)
    assert (same.sum(1) == 1).all() and same.any(0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_tasks": 0}, "n_tasks is 0"),
        ({"n_uavs": 0}, "n_uavs is 0"),
        ({"max_distance": 0.0}, r"max_distance is 0\.0"),
        ({"max_distance": float("nan")}, "max_distance is nan"),
        ({"max_distance": float("inf")}, "max_distance is inf"),
    ],
)
@pytest.mark.parametrize("generator", [UniformGenerator, ClusteredGenerator])
def test_generators_refuse_bad_sizes(generator: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generator(**{"n_tasks": 5, "n_uavs": 2, "max_distance": 2.0, **changes})


@pytest.mark.parametrize("changes", [{"n_clusters": 0}, {"spread": -0.1}, {"spread": float("nan")}])
def test_clustered_generator_refuses_bad_clusters(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="n_clusters must be >= 1 and spread >= 0, found"):
        ClusteredGenerator(n_tasks=5, **changes)


def test_make_generator(tmp_path: Path, small: Instances) -> None:
    assert make_generator(6, 2, 3.0) == UniformGenerator(6, 2, 3.0)
    assert make_generator(6, 2, distribution="clustered") == ClusteredGenerator(6, 2)
    small.save(tmp_path / "small.npz")
    for source in (small, tmp_path / "small.npz", str(tmp_path / "small.npz")):
        fixed = make_generator(99, 99, instances=source)
        assert isinstance(fixed, FixedGenerator)
        assert_equal(fixed.instances, small)
    with pytest.raises(
        ValueError, match=r"distribution is 'gaussian'; choose one of \['clustered', 'mixture', 'uniform', 'world'\]"
    ):
        make_generator(6, 2, distribution="gaussian")

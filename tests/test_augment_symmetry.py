"""Mirror images, quarter turns, other places and other units: augmentation finds the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import seeds, whole_batches
from driver_helpers import make_policy
from hypothesis import given, settings
from hypothesis import strategies as st
from solver_helpers import objectives

from sb3_uav.envs import ClusteredGenerator, Instances, UniformGenerator, WorldGenerator
from sb3_uav.envs.symmetries import N_SYMMETRIES, combine, reflect, standard_pose
from sb3_uav.solvers import DLDRL, make_solver

# So many that there are sampled views beside the greedy ones, and more tours for the best allocations.
SAMPLES = 48


def change(instances: Instances, function: Callable[[th.Tensor], th.Tensor], scale: float = 1.0) -> Instances:
    """The same instances with all points moved, and all lengths scaled."""
    service = instances.service
    return replace(
        instances.map_points(function),
        depot=function(instances.depot),
        max_distance=scale * instances.max_distance,
        service=None if service is None else scale * service,
    )


CHANGES: dict[str, Callable[[Instances], Instances]] = {
    "mirrored": lambda instances: change(instances, lambda points: points * th.tensor([-1.0, 1.0])),
    "upside down": lambda instances: change(instances, lambda points: 1.0 - points),
    "a quarter turn": lambda instances: change(instances, lambda points: points.flip(-1) * th.tensor([-1.0, 1.0])),
    "transposed": lambda instances: change(instances, lambda points: points.flip(-1)),
    "moved": lambda instances: change(instances, lambda points: points + th.tensor([2.5, -7.25])),
    "in meters": lambda instances: change(instances, lambda points: 750.0 * points, 750.0),
}


def whole(n_tasks: int, n_uavs: int, n: int) -> Instances:
    return WorldGenerator(n_tasks, n_uavs, whole_share=1.0, paper_share=0.0)(n, np.random.default_rng(n_tasks))


def check(solver: DLDRL, instances: Instances) -> None:
    expected = objectives(solver, instances)
    for name, function in CHANGES.items():
        assert objectives(solver, function(instances)) == pytest.approx(expected, rel=1e-9), name


@pytest.mark.slow
def test_augmentation_of_small_networks() -> None:
    """They have learned nothing, so that every sample is as good as the next, and other random numbers would show."""
    allocator, router = (make_policy(level, "whole", 9, 3) for level in ("allocator", "router"))
    solver = DLDRL(allocator, router, "augment", SAMPLES)  # type: ignore[arg-type]
    check(solver, whole(20, 3, 2))
    check(solver, UniformGenerator(20, 3)(2, np.random.default_rng(1)))


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["universal", "world"])
def test_augmentation_of_shipped_pairs(pair: str) -> None:
    solver: Any = make_solver(f"dl-drl:allocator={pair},decode=augment,samples={SAMPLES}")
    check(solver, ClusteredGenerator(30, 3, 1.5)(1, np.random.default_rng(2)))
    if pair == "world":
        check(solver, whole(30, 3, 1))


@pytest.mark.parametrize("pair", ["universal", "world"])
def test_greedy_of_shipped_pairs_does_not_depend_on_any_order(pair: str) -> None:
    solver: Any = make_solver(f"dl-drl:allocator={pair}")
    instances = whole(30, 3, 3) if pair == "world" else ClusteredGenerator(30, 3)(3, np.random.default_rng(0))
    expected = objectives(solver, instances)
    tasks = th.from_numpy(np.random.default_rng(1).permutation(30)).expand(len(instances), -1)
    assert objectives(solver, instances.reorder(tasks)) == pytest.approx(expected, rel=1e-9)
    if instances.start is not None and instances.end is not None and instances.max_distance.dim() == 2:
        own = {name: getattr(instances, name)[:, [2, 0, 1]] for name in ("start", "end", "max_distance")}
        assert objectives(solver, replace(instances, **own)) == pytest.approx(expected, rel=1e-9)


def test_two_symmetries_are_one() -> None:
    instances = UniformGenerator(4, 2)(1, np.random.default_rng(0))
    for first in range(N_SYMMETRIES):
        for then in range(N_SYMMETRIES):
            both = reflect(reflect(instances, first), then)
            th.testing.assert_close(reflect(instances, combine(first, then)).tasks, both.tasks)


@settings(max_examples=60)
@given(whole_batches(), st.integers(0, N_SYMMETRIES - 1), seeds)
def test_any_instance_has_a_pose(instances: Instances, symmetry: int, seed: int) -> None:
    """Whatever its coordinates are; and where they are of about 1, mirror images have the same."""
    assert all(0 <= pose < N_SYMMETRIES for pose in standard_pose(instances))
    near = whole(5, 2, 3) if seed % 2 else UniformGenerator(5, 2)(3, np.random.default_rng(seed))
    poses = standard_pose(near)
    assert standard_pose(near.pad(8)) == poses
    for row, (pose, other) in enumerate(zip(poses, standard_pose(reflect(near, symmetry)), strict=True)):
        assert combine(symmetry, other) == pose
        th.testing.assert_close(reflect(reflect(near[row], symmetry), other).tasks, reflect(near[row], pose).tasks)


def test_values_decide_where_places_do_not() -> None:
    """A square around the depot looks alike from everywhere, but for what its corners are worth."""
    corners = [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
    square = Instances.from_arrays([0.0, 0.0], corners, [1.0, 2.0, 3.0, 5.0], 9.0, 2)
    pictures = set()
    for symmetry in range(N_SYMMETRIES):
        seen = reflect(square, symmetry)
        standing = reflect(seen, standard_pose(seen)[0])
        rows = th.cat([standing.tasks[0], standing.values[0, :, None]], dim=1).tolist()
        pictures.add(tuple(sorted(map(tuple, rows))))
    assert len(pictures) == 1

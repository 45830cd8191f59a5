"""Solvers far from the origin, under other defaults of torch, and on batches without instances."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch as th
from classical_helpers import HAS_PYVRP, Ticks
from solver_helpers import make_kmeans_am, make_pair, routes

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.evaluation import evaluate
from sb3_uav.solvers import Solver, make_solver

SPECS = ["kmeans-nearest", "kmeans-vnd", "random-nearest", "greedy-insertion", "ortools", "milp"]
SPECS += ["pyvrp:time_limit=0.05"] if HAS_PYVRP else []
NETWORKS = ["kmeans-am", "greedy", "sampling", "augment", "repair"]


def make(spec: str) -> Solver:
    if spec == "kmeans-am":
        return make_kmeans_am()
    if spec == "repair":
        return make_pair(2, decode="sampling", samples=3, repair=True)
    return make_pair(2, decode=spec, samples=8) if spec in NETWORKS else make_solver(spec)


def dyadic(offset: float = 0.0, n_tasks: int = 6) -> Instances:
    """Two instances whose coordinates are multiples of 1 / 1024, so that float64 moves them without rounding errors."""
    points = np.random.default_rng(3).integers(0, 1024, (2, n_tasks + 1, 2)) / 1024 + offset
    return Instances.from_arrays(points[:, 0], points[:, 1:], None, 1.5, 2)


@pytest.mark.parametrize("offset", [1e6, -3e8])
@pytest.mark.parametrize("spec", [*SPECS, *NETWORKS])
def test_far_from_the_origin_nothing_changes(spec: str, offset: float, ticks: Ticks) -> None:
    solver = make(spec)
    ticks.looks = 0
    expected = routes(solver, dyadic(), 1)
    ticks.looks = 0
    assert routes(solver, dyadic(offset), 1) == expected


@contextmanager
def other_defaults(kind: str) -> Iterator[None]:
    if kind == "float64":
        th.set_default_dtype(th.float64)
    else:
        th.set_default_device("meta")
    try:
        yield
    finally:
        th.set_default_dtype(th.float32)
        th.set_default_device(None)


@pytest.mark.parametrize("kind", ["float64", "device"])
@pytest.mark.parametrize("spec", [*SPECS, *NETWORKS])
def test_other_defaults_of_torch_change_nothing(spec: str, kind: str, ticks: Ticks) -> None:
    """Of the type of numbers, and of the device: on "meta" everything that forgets to name its own fails."""
    batch, solver = dyadic(), make(spec)
    ticks.looks = 0
    expected = routes(solver, batch, 1)
    with other_defaults(kind):
        ticks.looks = 0
        assert routes(solver, batch, 1) == expected


@pytest.mark.parametrize("kind", ["float64", "device"])
def test_the_pair_of_the_package_under_other_defaults_of_torch(kind: str) -> None:
    batch = dyadic()
    expected = routes(make_solver("dl-drl", device="cpu"), batch)
    with other_defaults(kind):
        assert routes(make_solver("dl-drl", device="cpu"), batch) == expected


@pytest.mark.parametrize("spec", [*SPECS, *NETWORKS])
def test_no_instances_give_no_results(spec: str) -> None:
    assert make(spec).solve(UniformGenerator(5, 2)(2, np.random.default_rng(0))[:0]) == []


def test_an_evaluation_without_instances_says_so(tmp_path: Path) -> None:
    empty = UniformGenerator(5, 2)(2, np.random.default_rng(0))[:0]
    with pytest.raises(ValueError, match="The set 'b' holds no instances; leave it out"):
        evaluate([make("kmeans-nearest")], {"a": dyadic(), "b": empty}, tmp_path / "out")
    assert not (tmp_path / "out").exists()

"""What general-purpose solvers see of an instance: integer distances and prizes."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from conftest import instance_batches, seeds
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances, check_schedule
from sb3_uav.envs.reduction import FINE_RESOLUTION, RESOLUTION, ReducedInstance


@settings(max_examples=50)
@given(instance_batches(max_batch=1), st.integers(1, 10**6), st.integers(1, 62))
def test_prizes(instance: Instances, finest: int, bits: int) -> None:
    """Any prize outweighs every distance, larger values have at least as large prizes, and sums stay in bounds."""
    reduced = ReducedInstance.of(instance)
    assume(reduced.n_tasks > 0)
    prizes = reduced.integer_prizes(finest, 2**bits)
    smallest = reduced.n_uavs * RESOLUTION + 1
    assert prizes.min() >= smallest and (prizes % smallest == 0).all()
    assert sum(prizes.tolist()) <= max(2**bits, reduced.n_tasks * smallest)
    by_value = prizes[np.argsort(reduced.values, kind="stable")]
    assert (np.diff(by_value) >= 0).all()


@pytest.mark.parametrize(
    "values, ratios",
    [
        ([3, 3, 3], [1, 1, 1]),
        ([0.1, 0.1, 0.1], [1, 1, 1]),
        ([2, 4, 10], [1, 2, 5]),
        # Of two small tasks and a great one of the same value, the shorter tour must win.
        ([0.5, 1.5, 1.0], [1, 3, 2]),
        ([0.1, 0.3, 0.7], [1, 3, 7]),
        ([0.2, 0.3, 0.5], [2, 3, 5]),
        # Too fine: rounded, but never to nothing.
        ([1, 1000.4, 2000], [1, 500, 1000]),
        ([1e-9, 1e30, 5e29], [1, 1000, 500]),
    ],
)
def test_prizes_in_exact_proportion(values: list[float], ratios: list[int]) -> None:
    instance = Instances.from_arrays([0.0, 0.0], [[0.1, 0.0]] * 3, values, 2.0, 2)
    prizes = ReducedInstance.of(instance).integer_prizes(1000, 2**60)
    assert prizes.tolist() == [ratio * (2 * RESOLUTION + 1) for ratio in ratios]


@settings(max_examples=50)
@given(instance_batches(max_batch=1), st.data())
def test_integer_tours_are_feasible(instance: Instances, data: st.DataObject) -> None:
    """A closed tour that is short enough in distances rounded up passes the checker; rounded down, no feasible one is lost."""
    reduced = ReducedInstance.of(instance)
    assume(reduced.n_tasks > 0)
    route = data.draw(st.permutations(range(1, reduced.n_tasks + 1)))[: data.draw(st.integers(1, reduced.n_tasks))]
    fine, coarse = (
        sum(int(distances[a, b]) for a, b in pairwise([0, *route, 0]))
        for distances in (reduced.fine_distances(), reduced.coarse_distances())
    )
    if fine <= FINE_RESOLUTION:
        schedule = reduced.schedule([route])
        check_schedule(instance, 0, schedule)
        assert reduced.routes(schedule) == [list(route)]
    assert coarse <= RESOLUTION or reduced.tour_length(route) > 1
    rounding = reduced.arc_costs() - reduced.coarse_distances()
    assert ((rounding == 0) | (rounding == 1)).all()


@settings(max_examples=30)
@given(seeds, st.integers(2, 12))
def test_tours_that_are_just_too_long(seed: int, n_tasks: int) -> None:
    """Rounding up never makes an infeasible tour feasible, and none infeasible that has exactly the longest length."""
    points = np.random.default_rng(seed).random((n_tasks + 1, 2))
    stops = [*range(n_tasks + 1), 0]
    length = sum(math.dist(points[a], points[b]) for a, b in pairwise(stops))
    for factor, feasible in ((1 - 1e-8, False), (1.0, True)):
        distances = ReducedInstance.of(Instances.from_arrays(points[0], points[1:], None, length * factor, 1)).fine_distances()
        assert (sum(int(distances[a, b]) for a, b in pairwise(stops)) <= FINE_RESOLUTION) == feasible

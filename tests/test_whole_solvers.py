"""The solvers on the whole problem: exact where they claim it, feasible everywhere, or a clear refusal."""

from __future__ import annotations

import pytest
from brute_force import best_score
from classical_helpers import ALL
from conftest import whole_batches
from hypothesis import given, settings

from sb3_uav.envs import Instances, Schedule, check_schedule
from sb3_uav.solvers import make_solver

pytestmark = pytest.mark.usefixtures("ticks")

CLASSICAL = (*ALL, "kmeans-nearest", "random-nearest")


def score(instances: Instances, row: int, schedule: Schedule) -> tuple[int, float]:
    """What the checker says: how many tasks are served that must be, and the total value."""
    report = check_schedule(instances, row, schedule)
    must = 0 if instances.must_serve is None else int((instances.must_serve & instances.task_mask)[row].sum())
    return must - len(report.unserved), report.objective


@settings(max_examples=60)
@given(whole_batches(max_tasks=5, max_batch=1))
def test_milp_is_optimal(instance: Instances) -> None:
    """Brute force = MILP = its bound >= every other solver."""
    n_must, value = best_score(instance)
    (result,) = make_solver("milp").solve(instance)
    found = score(instance, 0, result.schedule)
    assert found[0] == n_must and found[1] == pytest.approx(value, rel=1e-7)
    if instance.must_serve is None:
        assert result.bound == pytest.approx(value, rel=1e-6) and result.bound is not None and result.bound >= found[1]
    for spec in CLASSICAL:
        other = score(instance, 0, make_solver(spec).solve(instance)[0].schedule)
        assert other <= (n_must, value * (1 + 1e-12)), spec

"""The whole problem: starts, ends and distances of each UAV, service costs, tasks that must be served."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import random_legal, seeds, whole_batches
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instance_helpers import arrays, assert_equal

from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.routing import RoutingDynamics, collected_value, nearest_feasible
from sb3_uav.envs.schedule import InfeasibleScheduleError
from sb3_uav.envs.symmetries import N_SYMMETRIES, reflect
from sb3_uav.solvers import make_solver
from sb3_uav.solvers.counting_tasks import CountingTasks


def line(**changes: Any) -> Instances:
    """One UAV at 0 on a line of tasks at 1, 2 and 3, with 10 to fly."""
    fields: dict[str, Any] = {
        "depot": [0.0, 0.0],
        "tasks": [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]],
        "max_distance": 10.0,
        "n_uavs": 1,
    }
    return Instances.from_arrays(**{**fields, **changes})


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(instances=whole_batches())
def test_npz_round_trip_is_exact(instances: Instances, tmp_path: Path) -> None:
    instances.save(tmp_path / "whole.npz")
    assert_equal(Instances.load(tmp_path / "whole.npz"), instances)


@settings(max_examples=100)
@given(instances=whole_batches(), seed=seeds, n_samples=st.integers(1, 3))
def test_the_checker_accepts_what_the_dynamics_allow(instances: Instances, seed: int, n_samples: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (len(instances), n_samples, instances.n_tasks)
    planned = plan_tours(instances, th.from_numpy(rng.integers(instances.n_uavs, size=shape)), nearest_feasible)
    for sample in range(n_samples):
        for row, schedule in enumerate(schedules(planned.tours[:, sample])):
            report = check_schedule(instances, row, schedule)
            must = [] if instances.must_serve is None else instances.must_serve[row].nonzero()[:, 0].tolist()
            visited = {task for route in schedule.routes for task in route}
            assert report.unserved == tuple(task for task in must if instances.task_mask[row, task] and task not in visited)
            found = float(planned.value[row, sample])
            prizes = instances.prizes[row]
            assert found == pytest.approx(sum(float(prizes[task]) for task in visited), rel=1e-9)
            if not must:
                assert found == pytest.approx(report.objective, rel=1e-9)


@settings(max_examples=60)
@given(instances=whole_batches(), seed=seeds)
def test_traveled_is_the_length_of_the_tour(instances: Instances, seed: int) -> None:
    """Whatever legal actions are played, and to the distance at which the checker refuses."""
    single = instances.with_fleet(1)
    dynamics, rng = RoutingDynamics(single), np.random.default_rng(seed)
    state, actions = dynamics.reset(), []
    while not state.done.all():
        actions.append(random_legal(state.action_mask, rng))
        state, _ = dynamics.step(state, actions[-1])
    tours = th.stack(actions, dim=-1)
    for row in range(len(single)):
        route = [node - 1 for node in tours[row, 0].tolist() if node > 0]
        report = check_schedule(single, row, Schedule([route]))
        if route:
            assert float(state.traveled[row, 0]) == pytest.approx(report.length, rel=1e-9, abs=1e-300)
    assert (collected_value(single, tours) >= 0).all()


@settings(max_examples=40)
@given(parts=st.lists(whole_batches(max_batch=2), min_size=2, max_size=3))
def test_joined_batches_keep_every_row(parts: list[Instances]) -> None:
    n_uavs = min(part.n_uavs for part in parts)
    parts = [part.with_fleet(n_uavs) for part in parts]
    joined, row = Instances.concatenate(parts), 0
    for part in parts:
        for i in range(len(part)):
            for name in ("uav_start", "uav_end", "uav_distance", "depot"):
                assert th.equal(getattr(joined, name)[row], getattr(part, name)[i]), name
            for name in ("service_cost", "prizes", "values", "task_mask"):
                assert th.equal(getattr(joined, name)[row, : part.n_tasks], getattr(part, name)[i]), name
            row += 1


@pytest.mark.parametrize("symmetry", range(N_SYMMETRIES))
def test_symmetries_move_starts_and_ends(symmetry: int) -> None:
    rng = np.random.default_rng(0)
    given_points: dict[str, Any] = {name: rng.random((3, 2, 2)) for name in ("start", "end")}
    plain = UniformGenerator(5, n_uavs=2)(3, rng)
    whole = Instances.from_arrays(plain.depot, plain.tasks, None, 2.0, 2, **given_points)
    moved = reflect(whole, symmetry)
    for name in ("uav_start", "uav_end"):
        old, new = ((getattr(x, name)[:, :, None] - x.tasks[:, None]).norm(dim=-1) for x in (whole, moved))
        assert th.allclose(old, new)


def test_defaults_are_left_out() -> None:
    plain = arrays()
    n_uavs, depot = 4, plain["depot"]
    repeated = {
        "start": np.repeat(depot[:, None], n_uavs, 1),
        "end": np.repeat(depot[:, None], n_uavs, 1),
        "max_distance": np.repeat(plain["max_distance"][:, None], n_uavs, 1),
        "service": np.zeros((2, 3)),
        "must_serve": np.zeros((2, 3), bool),
    }
    spelled_out = Instances.from_arrays(**{**plain, **repeated})
    assert spelled_out.is_plain
    assert spelled_out.digest() == Instances.from_arrays(**plain).digest()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": np.zeros((2, 3, 2))}, r"'start' has shape \(2, 3, 2\), expected \(2, 4, 2\), one point per UAV"),
        ({"end": np.full((2, 4, 2), np.nan)}, r"'end' holds nan at index \(0, 0, 0\)"),
        ({"max_distance": np.ones((2, 3))}, r"expected \(2,\), or \(2, 4\) for one number per UAV"),
        ({"max_distance": [[1, 1, -1, 1], [1, 1, 1, 2]]}, "'max_distance' is -1.0 for UAV 2 of instance 0"),
        ({"max_distance": [[0, 0, 0, 0], [1, 1, 1, 2]]}, "'max_distance' is 0.0 in instance 0"),
        ({"service": -np.eye(2, 3)}, r"'service' holds -1.0 at index \(0, 0\); service costs must be >= 0"),
        ({"service": np.ones((2, 4))}, r"Instances.service has shape \(2, 4\), expected \(2, 3\)"),
        ({"must_serve": np.full((2, 3), 2)}, "'must_serve' holds values other than True and False"),
    ],
)
def test_bad_fields_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Instances.from_arrays(**arrays(**changes))


def test_lengths_by_hand() -> None:
    """From 0 over 1 and 3 to an end at 4, with a service cost of 2 at 3: 4 to fly and 2 to hover."""
    instance = line(start=[[0.0, 0.0]], end=[[4.0, 0.0]], service=[0.0, 0.0, 2.0], max_distance=6.0)
    assert check_schedule(instance, 0, Schedule([[0, 2]])).lengths == (6.0,)
    with pytest.raises(InfeasibleScheduleError, match=r"flies 8\.0+, which is 2 over its maximum of 6"):
        check_schedule(instance, 0, Schedule([[2, 1]]))


def test_each_uav_has_its_own_distance() -> None:
    instance = line(n_uavs=2, max_distance=[2.0, 6.0])
    check_schedule(instance, 0, Schedule([[0], [2]]))
    with pytest.raises(InfeasibleScheduleError, match="UAV 0 flies 6"):
        check_schedule(instance, 0, Schedule([[2], [0]]))
    assert instance.reachable_by_uav()[0].tolist() == [[True, False, False], [True, True, True]]


def test_a_uav_that_cannot_reach_its_end_stays() -> None:
    instance = line(end=[[20.0, 0.0]])
    assert not instance.reachable().any()
    assert check_schedule(instance, 0, Schedule([[]])).lengths == (0.0,)
    with pytest.raises(InfeasibleScheduleError):
        check_schedule(instance, 0, Schedule([[0]]))
    assert nearest_feasible(instance).tolist() == [[0]]


def test_what_must_be_served_outweighs_everything() -> None:
    instance = line(values=[5.0, 1e9, 0.0], must_serve=[False, False, True])
    assert instance.prizes[0, 2] > instance.prizes[0, :2].sum()
    report = check_schedule(instance, 0, Schedule([[0, 1]]))
    assert (report.objective, report.unserved) == (5.0 + 1e9, (2,))
    counting = CountingTasks.of(instance).instances
    assert counting.must_serve is None
    assert th.equal(counting.values, instance.prizes)


def test_solvers_that_know_only_the_paper_refuse_the_rest() -> None:
    whole = line(start=[[1.0, 1.0]], service=[1.0, 0.0, 0.0])
    for spec in ("random-nearest", "kmeans-nearest"):
        result = make_solver(spec).solve(whole)[0]
        check_schedule(whole, 0, result.schedule)

"""Orders and symmetries of instances: they change the presentation of an instance, not the instance."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch as th
from conftest import instance_batches
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.envs import Instances, TaskAllocationEnv, UniformGenerator
from sb3_uav.envs.sweep import sweep_order
from sb3_uav.envs.symmetries import N_SYMMETRIES, reflect, turn


def angles(instances: Instances, row: int) -> list[float]:
    """Polar angles of the real tasks of a row, in plain Python."""
    x, y = instances.depot[row].tolist()
    points = instances.tasks[row][instances.task_mask[row]].tolist()
    return [math.atan2(b - y, a - x) for a, b in points]


@given(instances=instance_batches(), gap=st.integers(0, 9), clockwise=st.booleans())
def test_sweep_is_a_permutation_that_turns_once(instances: Instances, gap: int, clockwise: bool) -> None:
    order = sweep_order(instances, gap, clockwise)
    swept = instances.reorder(order)
    for row in range(len(instances)):
        n_real = int(instances.task_mask[row].sum())
        assert sorted(order[row, :n_real].tolist()) == list(range(n_real))
        assert order[row, n_real:].tolist() == list(range(n_real, instances.n_tasks))
        assert th.equal(swept.tasks[row], instances.tasks[row][order[row]])
        assert th.equal(swept.values[row], instances.values[row][order[row]])
        sign = -1.0 if clockwise else 1.0
        turned = [sign * angle for angle in angles(swept, row)]
        assert sum(b < a for a, b in itertools.pairwise(turned)) <= 1


def test_sweep_starts_after_the_widest_gap() -> None:
    """Tasks at 10, 100, 130 and 200 degrees: gaps of 170, 90, 70 and 30."""
    degrees = np.array([130.0, 10.0, 200.0, 100.0])
    points = np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], axis=-1)
    instances = Instances.from_arrays(np.zeros(2), points)
    assert sweep_order(instances).tolist() == [[1, 3, 0, 2]]
    assert sweep_order(instances, gap=1).tolist() == [[3, 0, 2, 1]]
    assert sweep_order(instances, gap=4).tolist() == sweep_order(instances).tolist()
    assert sweep_order(instances, clockwise=True).tolist() == [[2, 0, 3, 1]]


def test_symmetries_keep_all_distances_and_differ() -> None:
    instances = UniformGenerator(6, 2)(3, np.random.default_rng(0))
    views = [reflect(instances, symmetry) for symmetry in range(N_SYMMETRIES)]
    for view in views:
        th.testing.assert_close(view.home_distance(), instances.home_distance())
        th.testing.assert_close(th.cdist(view.tasks, view.tasks), th.cdist(instances.tasks, instances.tasks))
    shown = {tuple(np.round(view.tasks.flatten().numpy(), 9)) for view in views}
    assert len(shown) == N_SYMMETRIES and th.equal(views[0].tasks, instances.tasks)


def test_environment_shows_tasks_in_sweep_order() -> None:
    instances = UniformGenerator(9, 2)(1, np.random.default_rng(3))
    plain, swept = TaskAllocationEnv(9, 2), TaskAllocationEnv(9, 2, task_order="sweep")
    order = sweep_order(instances)[0].numpy()
    observations = [env.reset(options={"instance": instances})[0] for env in (plain, swept)]
    tasks = [observation["tasks"].reshape(-1, 2) for observation in observations]
    assert (tasks[0][order] == tasks[1]).all() and (tasks[0] != tasks[1]).any()
    plain.set_task_order("sweep")
    assert (plain.reset(options={"instance": instances})[0]["tasks"] == observations[1]["tasks"]).all()
    with pytest.raises(ValueError, match="task_order is 'random'; choose one of"):
        TaskAllocationEnv(task_order="random")


@given(instances=instance_batches(), angle=st.floats(-7.0, 7.0))
def test_turning_keeps_all_distances(instances: Instances, angle: float) -> None:
    turned = turn(instances, th.full((len(instances),), angle, dtype=th.float64))
    for row in range(len(instances)):
        before, after = (th.cat([x.depot[row, None], x.tasks[row]]) for x in (instances, turned))
        th.testing.assert_close(th.cdist(after, after), th.cdist(before, before), rtol=1e-6, atol=1e-6)
    offset = instances.tasks - instances.depot[:, None]
    expected = offset[..., 0] * math.cos(angle) - offset[..., 1] * math.sin(angle)
    th.testing.assert_close((turned.tasks - turned.depot[:, None])[..., 0], expected, rtol=1e-6, atol=1e-6)


def test_uavs_that_cannot_fly_do_not_move_the_center() -> None:
    """Wherever a grounded UAV has to arrive; if none can fly, all count."""
    tasks = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]
    orders = []
    for far in (5.0, 500.0):
        ends = [[0.1, 0.1], [far, far / 2]]
        orders.append(sweep_order(Instances.from_arrays([0.0, 0.0], tasks, max_distance=[4.0, 1.0], n_uavs=2, end=ends)))
    alone = sweep_order(Instances.from_arrays([0.0, 0.0], tasks, max_distance=4.0, n_uavs=1, end=[[0.1, 0.1]]))
    assert th.equal(orders[0], orders[1]) and th.equal(orders[0], alone)
    grounded = Instances.from_arrays([0.0, 0.0], tasks, max_distance=1.0, n_uavs=1, end=[[9.0, 9.0]])
    assert sorted(sweep_order(grounded)[0].tolist()) == [0, 1, 2, 3]

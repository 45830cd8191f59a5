"""Instances: validation and batches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from instance_helpers import arrays, assert_equal, poked

from sb3_uav.envs import Instances, RoutePlanningEnv, Schedule, UniformGenerator, check_schedule, nearest_feasible, plan_tours
from sb3_uav.envs.instances import _TENSOR_FIELDS
from sb3_uav.training.fixed_set_returns import fingerprint

# Validation


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (poked("depot", (1, 0), np.nan), r"field 'depot' holds nan at index \(1, 0\); every number must be finite"),
        (poked("tasks", (0, 2, 1), np.inf), r"field 'tasks' holds inf at index \(0, 2, 1\)"),
        (poked("tasks", (0, 2, 1), 1e39), r"field 'tasks' holds 1e\+39 at index .* finite in float32"),
        (poked("values", (1, 1), -np.inf), r"field 'values' holds -inf at index \(1, 1\)"),
        (poked("values", (1, 1), -0.5), r"field 'values' holds -0\.5 at index \(1, 1\); task values must be >= 0"),
        (poked("max_distance", (1,), np.nan), r"field 'max_distance' holds nan at index \(1,\)"),
        ({"values": np.full((2, 3), 3e38)}, r"field 'values' adds up to 6e\+38 in instance 0; .* finite in float32"),
        (poked("max_distance", (1,), 0.0), r"field 'max_distance' is 0\.0 in instance 1; .* must be > 0"),
        (poked("max_distance", (0,), -2.0), r"field 'max_distance' is -2\.0 in instance 0"),
        (poked("max_distance", (0,), 1e-60), r"field 'max_distance' is 1e-60 in instance 0; .* must be > 0"),
        ({"n_uavs": 0}, "field 'n_uavs' is 0, but a fleet has a whole number of UAVs, at least 1"),
        ({"n_uavs": 2.5}, r"field 'n_uavs' is 2\.5, but a fleet has a whole number"),
        ({"n_uavs": np.nan}, "field 'n_uavs' is nan, but a fleet has a whole number"),
        ({"n_uavs": [4, 6]}, "field 'n_uavs' mixes 4, 6; store each fleet size in a separate file"),
        ({"n_uavs": [4, 4, 4]}, r"field 'n_uavs' has shape \(3,\), expected \(2,\)"),
        ({"n_uavs": None}, "field 'n_uavs' must be an array of real numbers, found None"),
        ({"task_mask": [[False, True, True], [True, True, True]]}, "marks a real task after a padded one; put the padding at"),
        ({"task_mask": [[1, 2, 0], [1, 1, 1]]}, "field 'task_mask' holds values other than True and False"),
        ({"task_mask": np.ones((2, 4))}, r"task_mask has shape \(2, 4\), expected \(2, 3\)"),
        ({"depot": np.zeros((3, 2))}, r"depot has shape \(3, 2\), expected \(2, 2\)"),
        ({"depot": np.zeros(2)}, r"depot has shape \(2,\), expected \(2, 2\)"),
        ({"depot": None}, "field 'depot' must be an array of real numbers, found None"),
        ({"tasks": np.zeros((2, 3))}, r"field 'tasks' has shape \(2, 3\), expected \(batch, n_tasks, 2\)"),
        ({"tasks": np.zeros((2, 3, 3))}, r"field 'tasks' has shape \(2, 3, 3\), expected \(batch, n_tasks, 2\)"),
        ({"tasks": np.zeros((2, 0, 2))}, r"field 'tasks' has shape \(2, 0, 2\); give at least one instance with one task"),
        ({"tasks": np.zeros((0, 3, 2))}, r"field 'tasks' has shape \(0, 3, 2\); give at least one instance with one task"),
        ({"tasks": [[[0, 1], [0]]]}, "field 'tasks' must be an array of real numbers: "),
        ({"tasks": [[["a", "b"]]]}, "field 'tasks' must be an array of real numbers, found"),
        ({"tasks": 1j * np.ones((2, 3, 2))}, "field 'tasks' must be an array of real numbers, found"),
        ({"values": np.ones((2, 4))}, r"values has shape \(2, 4\), expected \(2, 3\)"),
        ({"values": {}}, "field 'values' must be an array of real numbers, found {}"),
        ({"max_distance": np.ones(3)}, r"field 'max_distance' has shape \(3,\), expected \(2,\)"),
        ({"max_distance": "far"}, "field 'max_distance' must be an array of real numbers, found 'far'"),
    ],
)
def test_bad_arrays_are_refused(changes: dict[str, Any], message: str) -> None:
    """The message names the source, the field, and what was found."""
    Instances.from_arrays(**arrays())
    with pytest.raises(ValueError, match=f"^today's plan: .*{message}"):
        Instances.from_arrays(**arrays(**changes), source="today's plan")


def test_from_arrays_fills_in_the_rest() -> None:
    """One instance without a batch dimension, numbers for all rows, unit values, integers and lists."""
    one = Instances.from_arrays(depot=[0, 0], tasks=[[1, 2], [3, 4]])
    assert (len(one), one.n_tasks, one.n_uavs) == (1, 2, 4)
    assert one.tasks.tolist() == [[[1.0, 2.0], [3.0, 4.0]]] and one.values.tolist() == [[1.0, 1.0]]
    assert one.max_distance.tolist() == [2.0] and one.task_mask.all() and one.tasks.dtype == th.float64
    padded = Instances.from_arrays([0, 0], [[1, 2], [3, 4]], values=[5, 0], task_mask=[1, 0], n_uavs=np.array([3]))
    assert padded.values.tolist() == [[5.0, 0.0]] and padded.task_mask.tolist() == [[True, False]] and padded.n_uavs == 3
    many = Instances.from_arrays(np.zeros((2, 2)), np.zeros((2, 3, 2)), max_distance=5)
    assert many.max_distance.tolist() == [5.0, 5.0]


@pytest.mark.parametrize("name", ["depot", "tasks", "values", "max_distance", "task_mask"])
def test_masked_arrays_are_refused(name: str) -> None:
    """A masked entry is not a number; an array without masked entries is accepted."""
    masked = np.ma.array(arrays()[name])
    assert_equal(Instances.from_arrays(**arrays(**{name: masked})), Instances.from_arrays(**arrays()))
    masked[1] = np.ma.masked
    for given_array in (masked, list(masked)):
        with pytest.raises(
            ValueError, match=rf"field '{name}' has masked entries, the first at index \(1,.*; fill them or leave"
        ):
            Instances.from_arrays(**arrays(**{name: given_array}))


@pytest.mark.parametrize("dtype", [th.float64, th.float32, th.bfloat16])
def test_tensors_with_gradients_are_taken_as_numbers(dtype: th.dtype) -> None:
    """Without their graph, in float64, and as a copy."""
    tasks = th.tensor([[0.5, 0.25], [1.0, 2.0]], dtype=dtype, requires_grad=True)
    instances = Instances.from_arrays(th.zeros(2), tasks, max_distance=th.tensor(5.0, requires_grad=True))
    assert instances.tasks.tolist() == [tasks.tolist()] and instances.tasks.dtype == th.float64
    assert not instances.tasks.requires_grad and instances.max_distance.tolist() == [5.0]
    with pytest.raises(ValueError, match="field 'depot' must be an array of real numbers: "):
        Instances.from_arrays([tasks[0, 0], tasks[0, 1]], tasks)


def test_instances_with_gradients_are_saved(small: Instances, tmp_path: Path) -> None:
    replace(small, tasks=small.tasks.clone().requires_grad_()).save(tmp_path / "small.npz")
    assert_equal(Instances.load(tmp_path / "small.npz"), small)
    assert replace(small, tasks=small.tasks.clone().requires_grad_()).digest() == small.digest()


def test_from_arrays_copies() -> None:
    """Later writes to the arrays do not change the instances, and vice versa."""
    given_arrays = arrays()
    before = {name: np.copy(array) for name, array in given_arrays.items()}
    instances = Instances.from_arrays(**given_arrays)
    for name in _TENSOR_FIELDS:
        getattr(instances, name).zero_()
        assert np.array_equal(given_arrays[name], before[name]), name


def test_validate_refuses_other_dtypes(small: Instances) -> None:
    with pytest.raises(ValueError, match=r"field 'depot' has dtype torch\.float32; feasibility is decided in float64"):
        replace(small, depot=small.depot.float()).validate()
    with pytest.raises(ValueError, match=r"field 'task_mask' has dtype torch\.int8; it must be bool"):
        replace(small, task_mask=small.task_mask.to(th.int8)).validate()
    with pytest.raises(ValueError, match="field 'n_uavs' is 0, but a fleet needs at least 1 UAV"):
        replace(small, n_uavs=0).validate()


def test_constructor_refuses_shapes_that_do_not_fit(small: Instances) -> None:
    for name in ("depot", "values", "max_distance", "task_mask"):
        with pytest.raises(ValueError, match=rf"Instances\.{name} has shape \(2,.*expected \(3,.*check the array"):
            replace(small, **{name: getattr(small, name)[:2]})


# Batches


def test_rows(small: Instances) -> None:
    for index in (1, np.int64(1), -2):
        row = small[index]
        assert len(row) == 1 and th.equal(row.tasks[0], small.tasks[1]) and row.n_uavs == 2
    assert_equal(small[-1], small[2:])
    for indices in ([2, 0], np.array([2, 0]), th.tensor([2, 0])):
        assert_equal(small[indices], Instances.concatenate([small[2], small[0]]))
    assert_equal(small[th.tensor([True, False, True])], small[[0, 2]])
    assert_equal(small[np.array([True, False, True])], small[[0, 2]])


@pytest.mark.parametrize(
    "one", [th.tensor(1), th.tensor(-2), np.array(1), th.tensor(1, dtype=th.uint8), np.uint16(1), th.tensor([0, 1])[1]]
)
def test_a_number_without_dimensions_selects_a_batch_of_one(one: Any, small: Instances) -> None:
    assert_equal(small[one], small[1:2])


def test_rows_in_the_order_of_a_permutation(small: Instances) -> None:
    """``for k in torch.randperm(n)``, as in training loops."""
    order = th.randperm(3, generator=th.Generator().manual_seed(0))
    rows = [small[k] for k in order]
    assert [len(row) for row in rows] == [1, 1, 1]
    assert_equal(Instances.concatenate(rows), small[order])


def test_slices_may_run_backwards(small: Instances) -> None:
    assert_equal(small[::-1], small[[2, 1, 0]])
    assert_equal(small[:0:-1], small[[2, 1]])
    assert_equal(small[th.tensor([2, 0], dtype=th.uint8)], small[[2, 0]])


@pytest.mark.parametrize("nothing", [[], (), np.array([]), th.tensor([]), slice(0, 0), th.zeros(3, dtype=th.bool), range(0)])
def test_an_empty_selection_is_an_empty_batch(nothing: Any, small: Instances, tmp_path: Path) -> None:
    """It works where an empty result makes sense, and raises a clear error elsewhere."""
    empty = small[nothing]
    empty.validate()
    assert (len(empty), empty.n_tasks, empty.n_uavs) == (0, 5, 2) and list(empty) == []  # type: ignore[call-overload]
    assert_equal(Instances.concatenate([empty, small, empty]), small)
    assert len(empty.pad(7).trim(3).near_origin()) == 0 and empty.reachable().shape == (0, 5)
    assert nearest_feasible(empty).shape == (0, 1)
    assert plan_tours(empty, th.zeros(0, 2, 5, dtype=th.int64), nearest_feasible).tours.shape == (0, 2, 2, 1)
    assert empty.digest() != small.digest()
    with pytest.raises(ValueError, match=r"empty\.npz: there are no instances to save; a file holds at least one"):
        empty.save(tmp_path / "empty.npz")
    with pytest.raises(IndexError, match="instance 0 of a batch of 0"):
        check_schedule(empty, 0, Schedule([]))
    with pytest.raises(IndexError, match="instance 0 of a batch of 0"):
        empty[0]
    with pytest.raises(ValueError, match="There are no instances to draw from; give at least one"):
        RoutePlanningEnv(instances=empty)
    assert not (tmp_path / "empty.npz").exists()


def test_joining_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="There are no instances to join; give at least one batch"):
        Instances.concatenate([])


@pytest.mark.parametrize("bad", [True, 1.0, [0.0, 1.0], [[0, 1]], [True, False], th.tensor(True), np.zeros((1, 1), dtype=int)])
def test_other_indices_are_refused(bad: Any, small: Instances) -> None:
    with pytest.raises(IndexError, match="is not a selection of instances; use row numbers, or 3 bools"):
        small[bad]


def test_iteration_ends(small: Instances) -> None:
    """``for`` over instances gives each row as a batch of one."""
    rows = [row for row, _ in zip(small, range(10), strict=False)]  # type: ignore[call-overload]
    assert len(rows) == 3
    assert_equal(Instances.concatenate(rows), small)
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"instance {index} of a batch of 3"):
            small[index]


def test_pad_and_trim(small: Instances) -> None:
    padded = small.pad(8)
    padded.validate()
    assert padded.tasks.shape == (3, 8, 2) and padded.task_mask.sum(1).tolist() == [5, 5, 5]
    assert (padded.values[:, 5:] == 0).all() and th.equal(padded.tasks[:, 6], small.depot)
    assert_equal(padded.trim(5), small)
    assert small.pad(5) is small and small.pad(2) is small
    assert_equal(small.trim(2).pad(2), small.trim(2))
    assert small.trim(2).tasks.shape == (3, 2, 2) and th.equal(small.trim(2).tasks, small.tasks[:, :2])


@settings(max_examples=30)
@given(seed=seeds, sizes=st.lists(st.tuples(st.integers(1, 4), st.integers(1, 6)), min_size=1, max_size=4))
def test_concatenate_pads_to_the_largest(seed: int, sizes: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(seed)
    parts = [UniformGenerator(n_tasks, 3)(batch_size, rng) for batch_size, n_tasks in sizes]
    joined = Instances.concatenate(parts)
    joined.validate()
    assert len(joined) == sum(batch_size for batch_size, _ in sizes)
    start = 0
    for part in parts:
        rows = joined[start : start + len(part)]
        assert_equal(rows.trim(part.n_tasks), part)
        assert not rows.task_mask[:, part.n_tasks :].any()
        start += len(part)


def test_concatenate_refuses_different_fleets(small: Instances) -> None:
    with pytest.raises(ValueError, match=r"Cannot join instances with different n_uavs: \[2, 4\]"):
        Instances.concatenate([small, UniformGenerator(5, 4)(1, np.random.default_rng(0))])


def test_to(small: Instances) -> None:
    assert small.to("cpu") is small and small.device == th.device("cpu")
    moved = small.to("meta")
    assert moved.device == th.device("meta") and {getattr(moved, name).device.type for name in _TENSOR_FIELDS} == {"meta"}


def test_reachable() -> None:
    """There and back within D, inclusive; padded tasks never are."""
    instances = Instances.from_arrays(
        depot=[0, 0], tasks=[[0.3, 0.4], [0.5, 0], [0.50001, 0], [0, 0]], max_distance=1.0, task_mask=[1, 1, 1, 0]
    )
    assert instances.reachable().tolist() == [[True, True, False, False]]
    assert instances.home_distance().tolist() == [pytest.approx([0.5, 0.5, 0.50001, 0.0])]


def test_digests_stay_as_result_files_store_them(small: Instances) -> None:
    """Result folders and zips store them: with other digests, runs could not be resumed."""
    padded = small.pad(6)
    assert padded.digest() == "5041946ddb479bdcd8c81de0fbcb11b71e74f3f94983f89d4d1538fee057d250"
    assert fingerprint(padded, 3) == "ebed545e3f447bcc"
    assert padded.digest() == padded[:].digest() != replace(padded, n_uavs=3).digest()
    for name in _TENSOR_FIELDS:
        changed = getattr(padded, name).clone()
        changed[0] = 1 - changed[0].to(changed.dtype) if changed.dtype != th.bool else ~changed[0]
        assert replace(padded, **{name: changed}).digest() != padded.digest()

"""Instances: generators, validation, files."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, seeds
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_uav.envs import ClusteredGenerator, FixedGenerator, InstanceGenerator, Instances, UniformGenerator
from sb3_uav.envs.generators import make_generator

FIELDS = ("depot", "tasks", "values", "max_distance", "task_mask")
DRAWERS = [
    UniformGenerator(n_tasks=7, n_uavs=3, max_distance=1.5),
    ClusteredGenerator(n_tasks=7, n_uavs=3, max_distance=1.5, n_clusters=2),
    FixedGenerator(UniformGenerator(n_tasks=7, n_uavs=3, max_distance=1.5)(20, np.random.default_rng(5))),
]
# Hypothesis may reuse one folder for all examples: every example writes its file anew.
SHARED_FOLDER = [HealthCheck.function_scoped_fixture]


def assert_equal(a: Instances, b: Instances) -> None:
    """Bit by bit."""
    assert a.n_uavs == b.n_uavs
    for name in FIELDS:
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


# Generators


@pytest.mark.parametrize("generator", DRAWERS, ids=lambda generator: type(generator).__name__)
class TestGenerators:
    def test_shapes_and_ranges(self, generator: InstanceGenerator) -> None:
        drawn = generator(200, np.random.default_rng(0))
        assert (len(drawn), drawn.n_tasks, drawn.n_uavs) == (200, 7, 3) == (200, generator.n_tasks, generator.n_uavs)
        drawn.validate()
        assert {getattr(drawn, name).dtype for name in FIELDS[:4]} == {th.float64}
        for points in (drawn.depot, drawn.tasks):
            assert points.min() >= 0 and points.max() <= 1
        assert (drawn.values == 1).all() and (drawn.max_distance == 1.5).all() and drawn.task_mask.all()

    def test_same_random_state_gives_the_same_instances(self, generator: InstanceGenerator) -> None:
        """A call in between, with another source, leaves no trace."""
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
    """With spread 0 there are no more places than clusters, and neighbours are nearer than in the uniform case."""
    drawn = ClusteredGenerator(n_tasks=30, n_clusters=3, spread=0.0)(4, np.random.default_rng(0))
    assert all(len(th.unique(tasks, dim=0)) <= 3 for tasks in drawn.tasks)

    def nearest(generator: InstanceGenerator) -> float:
        tasks = generator(50, np.random.default_rng(0)).tasks
        return (th.cdist(tasks, tasks) + 9 * th.eye(40)).min(-1).values.mean().item()

    assert nearest(ClusteredGenerator(n_tasks=40)) < 0.8 * nearest(UniformGenerator(n_tasks=40))


def test_fixed_generator_draws_whole_rows() -> None:
    """Every drawn instance is one of the given ones, and over many draws each of them comes up."""
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
    with pytest.raises(ValueError, match=r"distribution is 'gaussian'; choose one of \['clustered', 'mixture', 'uniform'\]"):
        make_generator(6, 2, distribution="gaussian")


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
        ({"n_uavs": [4, 6]}, "field 'n_uavs' mixes 4, 6; store each fleet size in a file of its own"),
        ({"n_uavs": [4, 4, 4]}, r"field 'n_uavs' has shape \(3,\), expected \(2,\)"),
        ({"n_uavs": None}, "field 'n_uavs' must be an array of real numbers, found None"),
        ({"task_mask": [[False, True, True], [True, True, True]]}, "marks a real task after a padded one; put the padding at"),
        ({"task_mask": [[1, 2, 0], [1, 1, 1]]}, "field 'task_mask' holds other things than True and False"),
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


def test_from_arrays_copies() -> None:
    """Writing into the arrays afterwards, or into the instances, reaches neither."""
    given_arrays = arrays()
    before = {name: np.copy(array) for name, array in given_arrays.items()}
    instances = Instances.from_arrays(**given_arrays)
    for name in FIELDS:
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


# Files


@settings(max_examples=30, suppress_health_check=SHARED_FOLDER)
@given(instances=instance_batches())
def test_npz_round_trip_is_exact(instances: Instances, tmp_path: Path) -> None:
    instances.save(tmp_path / "instances.npz")
    assert_equal(Instances.load(tmp_path / "instances.npz"), instances)


def test_file_contents(tmp_path: Path, small: Instances) -> None:
    """Plain float64 arrays under the documented names; no mask when nothing is padded."""
    small.save(tmp_path / "small.npz")
    with np.load(tmp_path / "small.npz", allow_pickle=False) as file:
        assert sorted(file.files) == ["depot", "max_distance", "n_uavs", "tasks", "values"]
        assert {file[name].dtype for name in ("depot", "max_distance", "tasks", "values")} == {np.dtype(np.float64)}
        assert file["n_uavs"].tolist() == [2, 2, 2]
    small.pad(6).save(tmp_path / "padded.npz")
    with np.load(tmp_path / "padded.npz", allow_pickle=False) as file:
        assert file["task_mask"].tolist() == [[True] * 5 + [False]] * 3


def test_save_appends_the_suffix(tmp_path: Path, small: Instances) -> None:
    small.save(tmp_path / "small")
    small.save(str(tmp_path / "small.v2"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small.npz", "small.v2.npz"]
    assert_equal(Instances.load(tmp_path / "small.v2.npz"), small)


def test_values_are_optional(tmp_path: Path) -> None:
    minimal = {name: arrays()[name] for name in ("depot", "tasks", "max_distance", "n_uavs")}
    np.savez(tmp_path / "minimal.npz", **minimal)
    assert_equal(Instances.load(tmp_path / "minimal.npz"), Instances.from_arrays(**minimal))


@pytest.mark.parametrize("name", ["depot", "tasks", "max_distance", "n_uavs"])
def test_missing_arrays_are_named(name: str, tmp_path: Path) -> None:
    kept = arrays()
    del kept[name]
    np.savez(tmp_path / "short.npz", **kept)
    with pytest.raises(ValueError, match=rf"short\.npz: arrays \['{name}'\] are missing; found"):
        Instances.load(tmp_path / "short.npz")


def test_bad_numbers_in_a_file_name_the_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "bad.npz", **arrays(**poked("tasks", (1, 2, 0), np.nan)))
    with pytest.raises(ValueError, match=r"bad\.npz: field 'tasks' holds nan at index \(1, 2, 0\)"):
        Instances.load(tmp_path / "bad.npz")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz: no such instance file; give the path of an \.npz"):
        Instances.load(tmp_path / "nowhere.npz")
    with pytest.raises(FileNotFoundError, match="no such instance file"):
        Instances.load(tmp_path)


class Boobytrap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("name", ["values", "notes"])
def test_pickles_are_refused_and_not_run(name: str, tmp_path: Path) -> None:
    """Neither in a field of ours nor in any other array of the file."""
    trap = np.array([Boobytrap(tmp_path / "sprung")], dtype=object)
    np.savez(tmp_path / "trap.npz", **arrays(**{name: trap}))
    with pytest.raises(ValueError, match=r"trap\.npz: not an intact \.npz of plain arrays \(Object arrays cannot be loaded"):
        Instances.load(tmp_path / "trap.npz")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("content", [b"", b"PK", b"not a zip file at all" * 100], ids=["empty", "stub", "text"])
def test_foreign_files_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "foreign.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"foreign\.npz: not an intact \.npz of plain arrays .*; write it again"):
        Instances.load(tmp_path / "foreign.npz")


def test_a_single_array_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "tasks.npy", np.zeros((2, 3, 2)))
    with pytest.raises(ValueError, match=r"tasks\.npy: not an intact \.npz of plain arrays"):
        Instances.load(tmp_path / "tasks.npy")


def test_truncated_files_are_refused(tmp_path: Path) -> None:
    """Whatever part is missing at the end."""
    path = tmp_path / "cut.npz"
    Instances.from_arrays(**arrays()).save(path)
    content = path.read_bytes()
    for size in range(0, len(content), 7):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match=r"cut\.npz: not an intact \.npz of plain arrays"):
            Instances.load(path)


@settings(max_examples=200, suppress_health_check=SHARED_FOLDER)
@given(position=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_damaged_files_are_refused_or_harmless(position: float, flip: int, tmp_path: Path) -> None:
    """One changed byte anywhere: a clear error, or, where zip keeps what nobody reads, the same numbers."""
    instances = Instances.from_arrays(**arrays())
    instances.save(tmp_path / "damaged.npz")
    content = bytearray((tmp_path / "damaged.npz").read_bytes())
    content[int(position * len(content))] ^= flip
    (tmp_path / "damaged.npz").write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = Instances.load(tmp_path / "damaged.npz")
        except ValueError as error:
            assert "damaged.npz: " in str(error)
        else:
            # zipfile does not count entries: one may hide in the comment of another, and optional arrays may so be missing.
            for name in ("depot", "tasks", "max_distance"):
                assert th.equal(getattr(found, name), getattr(instances, name))
            assert found.n_uavs == instances.n_uavs
            assert th.equal(found.values, instances.values) or (found.values == 1).all()
            assert th.equal(found.task_mask, instances.task_mask) or found.task_mask.all()


def test_failed_write_leaves_the_old_file(tmp_path: Path, small: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk runs full in the middle: the old file is whole, and no temporary file stays."""
    path = tmp_path / "plan.npz"
    small.save(path)

    def run_full(file: Path, **arrays: np.ndarray) -> None:
        Path(file).write_bytes(b"PK half a file")
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", run_full)
    with pytest.raises(OSError, match="No space left on device"):
        small[:1].save(path)
    assert os.listdir(tmp_path) == ["plan.npz"]
    assert_equal(Instances.load(path), small)


def test_save_replaces_the_file_at_once(tmp_path: Path, small: Instances) -> None:
    """Who has the old file open reads it to its end, and not a mixture."""
    path = tmp_path / "plan.npz"
    small.save(path)
    before = path.read_bytes()
    with path.open("rb") as reader:
        small[:1].save(path)
        assert reader.read() == before
    assert len(Instances.load(path)) == 1


def test_save_into_a_missing_folder(tmp_path: Path, small: Instances) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        small.save(tmp_path / "nowhere" / "plan.npz")


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
    assert moved.device == th.device("meta") and {getattr(moved, name).device.type for name in FIELDS} == {"meta"}


def test_reachable() -> None:
    """There and back within D, the border included; padded tasks never."""
    instances = Instances.from_arrays(
        depot=[0, 0], tasks=[[0.3, 0.4], [0.5, 0], [0.50001, 0], [0, 0]], max_distance=1.0, task_mask=[1, 1, 1, 0]
    )
    assert instances.reachable().tolist() == [[True, True, False, False]]
    assert instances.home_distance().tolist() == [pytest.approx([0.5, 0.5, 0.50001, 0.0])]

"""The ``.npz`` files of instances."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instance_helpers import arrays, assert_equal, poked

from sb3_uav.envs import Instances

# Hypothesis may reuse one folder for all examples, as every example overwrites the file.
SHARED_FOLDER = [HealthCheck.function_scoped_fixture]


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


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("prize", "values"),
        ("Prizes", "values"),
        ("value", "values"),
        ("reward", "values"),
        ("vales", "values"),
        ("D", "max_distance"),
        ("max-dist", "max_distance"),
        ("maxdistance", "max_distance"),
        ("num_uavs", "n_uavs"),
        ("mask", "task_mask"),
        ("customers", "tasks"),
        ("depots", "depot"),
        ("comment", None),
    ],
)
def test_unknown_arrays_are_refused_with_the_name_that_was_meant(name: str, meant: str | None, tmp_path: Path) -> None:
    """Before, values under another name were silently ignored."""
    np.savez(tmp_path / "plan.npz", **arrays(**{name: np.ones((2, 3))}))
    advice = f"did you mean '{meant}'" if meant else "remove it; the known ones are depot, tasks, values"
    with pytest.raises(ValueError, match=rf"plan\.npz: unknown array '{name}'; {advice}"):
        Instances.load(tmp_path / "plan.npz")


class Boobytrap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("name", ["values", "notes"])
def test_pickles_are_refused_and_not_run(name: str, tmp_path: Path) -> None:
    """Neither in a known array nor in any other."""
    trap = np.array([Boobytrap(tmp_path / "sprung")], dtype=object)
    np.savez(tmp_path / "trap.npz", **arrays(**{name: trap}))
    with pytest.raises(
        ValueError, match=rf"trap\.npz: not an intact \.npz of plain arrays \(array '{name}': Object arrays cannot be loaded"
    ):
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
    """For any number of missing bytes at the end."""
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
    """One changed byte anywhere: a clear error, or the same numbers if it is a byte that is not read."""
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
            # zipfile does not count entries: one may become part of another's comment, so optional arrays may be missing.
            for name in ("depot", "tasks", "max_distance"):
                assert th.equal(getattr(found, name), getattr(instances, name))
            assert found.n_uavs == instances.n_uavs
            assert th.equal(found.values, instances.values) or (found.values == 1).all()
            assert th.equal(found.task_mask, instances.task_mask) or found.task_mask.all()


def test_failed_write_leaves_the_old_file(tmp_path: Path, small: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the disk fills up during a write, the old file stays intact and no temporary file remains."""
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
    """A reader that has the old file open reads it to its end, without parts of the new one."""
    path = tmp_path / "plan.npz"
    small.save(path)
    before = path.read_bytes()
    with path.open("rb") as reader:
        small[:1].save(path)
        assert reader.read() == before
    assert len(Instances.load(path)) == 1


def test_save_creates_missing_folders(tmp_path: Path, small: Instances) -> None:
    small.save(tmp_path / "plans" / "today" / "plan.npz")
    assert_equal(Instances.load(tmp_path / "plans" / "today" / "plan.npz"), small)

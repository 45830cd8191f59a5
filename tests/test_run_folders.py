"""Folders of runs: one for each, said when they vanish, without leftovers; and disks that are full."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_uav.common.files import remove_leftovers, replaced_when_complete, temporary_name, write_atomically


def test_runs_that_start_at_once_get_folders_of_their_own(tmp_path: Path) -> None:
    """rl_zoo3 has given the same number to all of them."""
    pytest.importorskip("rl_zoo3")
    from sb3_uav.zoo.run_folders import make_run_folder

    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(make_run_folder, [tmp_path / "logs" / "TaskAllocation-v0_3"] * 8))
    assert sorted(path.name for path in made) == sorted(f"TaskAllocation-v0_{number}" for number in range(3, 11))
    assert all(path.is_dir() for path in made)


def test_leftovers_of_dead_writers_are_removed(tmp_path: Path) -> None:
    left, other, own = (tmp_path / name for name in ("router_1.zip.tmp.zip", "notes.tmp", "a.tmp.zip"))
    for path in (left, other, own):
        path.write_text("")
    with temporary_name(tmp_path / "model.zip") as being_written:
        being_written.write_text("half")
        remove_leftovers(tmp_path)
        assert not left.exists() and other.exists() and own.exists()
        being_written.write_text("whole")
    assert (tmp_path / "model.zip").read_text() == "whole"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tmp.zip", "model.zip", "notes.tmp"]
    remove_leftovers(tmp_path / "missing")


def fill_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a full disk: a file is made, but not written."""

    def write_bytes(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", write_bytes)


def test_a_full_disk_keeps_the_old_file_and_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "state.json"
    path.write_text("old")
    with monkeypatch.context() as patch:
        fill_disk(patch)
        with pytest.raises(OSError, match=r"No space left on device.*state.json") as raised:
            write_atomically(path, "new")
    assert raised.value.errno == errno.ENOSPC
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not os.access("/dev/full", os.W_OK), reason="has no /dev/full")
def test_a_full_disk_is_told_from_a_wrong_folder(tmp_path: Path) -> None:
    """The last bytes are written when the file is closed."""
    path = tmp_path / "results.csv"
    with pytest.raises(ValueError, match=r"results.csv: cannot be written .No space left on device"):
        with temporary_full(path) as file:
            file.write("line\n")
    assert not path.exists()


def temporary_full(path: Path) -> Any:
    path.with_name("results.csv.tmp.csv").symlink_to("/dev/full")
    return replaced_when_complete(path)


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit of sizes")
def test_zips_that_do_not_fit_leave_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import resource

    from reinforce_models import make_model

    from sb3_uav.common.saving import save_atomically

    model = make_model()
    path = tmp_path / "model.zip"
    path.write_bytes(b"old")
    former = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, former[1]))
    try:
        with pytest.raises(OSError, match=r"model\.zip"):
            save_atomically(model, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, former)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_a_vanished_run_folder_stops_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    from tiny_zoo import ENV, run, write_config

    from sb3_uav.training import its

    original = its.write_checkpoint

    def vanish(folder: Path, *arguments: Any, **options: Any) -> None:
        original(folder, *arguments, **options)
        shutil.rmtree(folder.parent)

    monkeypatch.setattr(its, "write_checkpoint", vanish)
    assert run(tmp_path, write_config(tmp_path), "--eval-freq", "-1") == 2
    assert f"has vanished during the training, which stops; start it again: '{tmp_path}" in capsys.readouterr().err
    assert not list(tmp_path.glob(f"logs/reinforce/{ENV}_1/{ENV}.zip"))


@pytest.mark.slow
def test_a_vanished_checkpoint_folder_is_not_made_again(tmp_path: Path) -> None:
    from its_runs import learn, make_allocator, make_its

    callback = make_its(save_path=str(tmp_path / "run"))
    allocator = make_allocator()
    callback_save = callback._save_checkpoint

    def vanish() -> None:
        callback_save()
        shutil.rmtree(tmp_path / "run")

    callback._save_checkpoint = vanish
    with pytest.raises(FileNotFoundError, match="folder of the checkpoints has vanished"):
        learn(allocator, callback)
    assert not (tmp_path / "run" / "its_checkpoint").exists()


def test_a_vanished_folder_of_an_evaluation_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sb3_uav.cli.main import main
    from sb3_uav.envs import UniformGenerator
    from sb3_uav.evaluation.folder import EvaluationFolder

    UniformGenerator(n_tasks=8, n_uavs=2)(3, np.random.default_rng(1)).save(tmp_path / "instances.npz")
    original = EvaluationFolder.add

    def vanish(folder: EvaluationFolder, *arguments: Any) -> None:
        original(folder, *arguments)
        shutil.rmtree(folder.folder, ignore_errors=True)

    monkeypatch.setattr(EvaluationFolder, "add", vanish)
    words = ["--instances", str(tmp_path / "instances.npz"), "--solvers", "kmeans-nearest", "--out", str(tmp_path / "out")]
    assert main(["evaluate", *words]) == 2
    assert str(tmp_path / "out" / "results.csv") in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

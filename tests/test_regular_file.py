"""Pipes, devices, folders and files larger than memory, in place of files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_uav.cli.main import main
from sb3_uav.common.json_text import read_json_file
from sb3_uav.common.npz import read_npz
from sb3_uav.common.regular_file import read_regular
from sb3_uav.envs import UniformGenerator
from sb3_uav.evaluation.merge import merge
from sb3_uav.evaluation.results import whole_lines
from sb3_uav.missions.plan_file import load_plan
from sb3_uav.missions.readers.status_csv import read_status
from sb3_uav.training.instance_sets import SizeTable
from sb3_uav.zoo.yaml_text import load_yaml

READERS: dict[str, Callable[[Path], Any]] = {
    "yaml": load_yaml,
    "npz": lambda path: read_npz(path, "copy it again"),
    "json": read_json_file,
    "plan": load_plan,
    "table of sizes": lambda path: SizeTable.load(path, []),
    "results": lambda path: list(whole_lines(path)),
    "status": read_status,
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("door", READERS)
def test_pipes_devices_and_folders_are_no_files(door: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to(os.devnull)
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "device", "folder"):
        with pytest.raises((ValueError, OSError), match=rf"{name}.*no regular file"):
            READERS[door](tmp_path / name)
    with pytest.raises((ValueError, OSError), match="absent"):
        READERS[door](tmp_path / "absent")


@pytest.mark.parametrize("door", READERS)
def test_files_larger_than_memory(door: str, tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        # Without a block on the disk.
        file.truncate(2**40)
    with pytest.raises((ValueError, OSError), match="large"):
        READERS[door](path)


def test_what_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"[1]\n")
    assert read_regular(path, 4) == b"[1]\n" and read_json_file(path) == [1]
    with pytest.raises(ValueError, match="4 bytes, more than the 3"):
        read_regular(path, 3)


def test_shards_of_strangers(tmp_path: Path) -> None:
    folders = [tmp_path / "1", tmp_path / "2"]
    for folder in folders:
        folder.mkdir()
        (folder / "results.csv").touch()
        (folder / "evaluation.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"evaluation\.json: does not describe an evaluation \(.*nested too deeply"):
        merge(folders, tmp_path / "out")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_an_evaluation_goes_on_from_no_pipe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    UniformGenerator(5, n_uavs=2)(1, np.random.default_rng(0)).save(tmp_path / "x.npz")
    arguments = ["evaluate", "--instances", str(tmp_path / "x.npz"), "--solvers", "kmeans-nearest", "--out", str(tmp_path)]
    assert main(arguments) == 0
    for name in ("results.csv", "schedules.jsonl", "evaluation.json"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        os.mkfifo(tmp_path / name)
        assert main(arguments) == 2
        assert f"{name}: this is no regular file" in capsys.readouterr().err
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes(content)
    assert main(arguments) == 0

"""``--shard`` and ``sb3-uav merge`` on the command line: what they write and print, and several processes by ``torchrun``."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from argparse import Namespace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch.distributed as dist
from benchmark_files import BEST_KNOWN, FILES
from evaluation_helpers import contents
from ranks import run_ranks

from sb3_uav.cli import main as cli
from sb3_uav.cli import shards
from sb3_uav.envs import UniformGenerator

pytest.importorskip("rich")
SOLVERS = ("--solvers", "greedy-insertion", "random-nearest")


def sb3_uav(*arguments: Any) -> int:
    return cli.main([*map(str, arguments)])


def without_seconds(out: str) -> str:
    """Tables without their column of times, which is the last one, and the width that it has."""
    lines = [line.split() for line in out.splitlines() if line.strip() and "──" not in line]
    return "\n".join(" ".join(words[:-1] if words[0].startswith(("greedy", "random")) else words) for words in lines)


def make_files(folder: Path) -> list[Path]:
    """Two sets: of two files, and of one."""
    for number, size in enumerate((3, 4)):
        UniformGenerator(8, n_uavs=2)(size, np.random.default_rng(number)).save(folder / "many" / f"{number}.npz")
    UniformGenerator(6, n_uavs=3)(2, np.random.default_rng(2)).save(folder / "few.npz")
    return [folder / "many", folder / "few.npz"]


def test_shards_of_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ("evaluate", "--instances", *make_files(tmp_path), *SOLVERS, "--out")
    assert sb3_uav(*command, tmp_path / "whole") == 0
    printed = capsys.readouterr().out
    for number in (1, 2, 3):
        assert sb3_uav(*command, tmp_path / f"{number}", "--shard", f"{number}/3") == 0
    capsys.readouterr()
    assert sb3_uav("merge", *(tmp_path / f"{number}" for number in (2, 3, 1)), "--out", tmp_path / "merged") == 0
    assert without_seconds(capsys.readouterr().out) == without_seconds(printed)
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")
    assert {path.name for path in (tmp_path / "merged").iterdir()} == {path.name for path in (tmp_path / "whole").iterdir()}
    # The way to have everything checked again.
    assert sb3_uav(*command, tmp_path / "merged") == 0
    assert "greedy-insertion on many: 7 instances, 7 of them done before" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("merge", "1", "--out", "out"), "on 5 of 7 instances of 'many', the first is instance 2; shard 2/3, 3/3 is missing"),
        (("merge", "1", "1", "--out", "out"), "overlaps with"),
        (("merge", "1", "--out", "1"), "is one of the folders to merge"),
        (("merge", "none", "--out", "out"), "none: holds no results.csv with evaluation.json"),
        (("evaluate", "--instances", "many", "few.npz", *SOLVERS, "--out", "out", "--shard", "4/3"), "The shard is '4/3'"),
        (("evaluate", "--instances", "many", "few.npz", *SOLVERS, "--out", "1"), "holds results of shard 1/3, not of all"),
    ],
)
def test_mistakes(
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    make_files(tmp_path)
    assert sb3_uav("evaluate", "--instances", "many", "few.npz", *SOLVERS, "--out", "1", "--shard", "1/3") == 0
    before = contents(tmp_path / "1")
    capsys.readouterr()
    assert sb3_uav(*arguments) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"sb3-uav {arguments[0]}: error: ") and message in last
    assert contents(tmp_path / "1") == before and not (tmp_path / "out").exists()


def test_shards_of_bench(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a benchmark adds is made for the whole of it."""
    shutil.copytree(FILES, tmp_path / "files")
    shutil.copy(BEST_KNOWN, tmp_path / "best.csv")
    command = ("bench", tmp_path / "files", "--best-known", tmp_path / "best.csv", "--only", "a1.*", "b1.*", *SOLVERS, "--out")
    assert sb3_uav(*command, tmp_path / "whole") == 0
    for number in (1, 2):
        assert sb3_uav(*command, tmp_path / f"{number}", "--shard", f"{number}/2") == 0
    parts = (tmp_path / "1", tmp_path / "2", "--out", tmp_path / "merged")
    assert sb3_uav("merge", *parts) == 0
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")
    assert (tmp_path / "merged/routes.jsonl").read_bytes() == (tmp_path / "whole/routes.jsonl").read_bytes()
    # Times are the last but three of the columns.
    gaps = [
        [line.split(",")[:14] for line in (tmp_path / of / "gaps.csv").read_text().splitlines()] for of in ("merged", "whole")
    ]
    assert gaps[0] == gaps[1] and len(gaps[0]) > 3
    assert (tmp_path / "merged/summary.md").exists()
    # The files have moved, and other ones are at their place.
    (tmp_path / "files").rename(tmp_path / "elsewhere")
    capsys.readouterr()
    assert sb3_uav("merge", *parts) == 2
    assert "files: no such folder" in capsys.readouterr().err
    assert sb3_uav("merge", *parts, "--benchmark", tmp_path / "elsewhere" / "a1.txt") == 2
    assert "no such folder" in capsys.readouterr().err
    assert sb3_uav("merge", *parts, "--benchmark", tmp_path / "elsewhere") == 0
    next((tmp_path / "elsewhere").rglob("a1.*")).unlink()
    capsys.readouterr()
    assert sb3_uav("merge", *parts, "--benchmark", tmp_path / "elsewhere") == 2
    assert "holds other instances than those that" in capsys.readouterr().err


@pytest.mark.slow
def test_processes_of_torchrun(tmp_path: Path) -> None:
    """Each evaluates its shard, and the first one joins them."""
    files = make_files(tmp_path)
    command = ["evaluate", "--instances", *map(str, files), *SOLVERS, "--out", str(tmp_path / "out")]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "sb3_uav"]
    paths = os.pathsep.join(filter(None, sys.path))
    environment = dict(os.environ, PYTHONPATH=paths, OMP_NUM_THREADS="1")
    done = subprocess.run([*launcher, *command], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("many: 7 instances") == 1
    assert sb3_uav(*command[:-1], tmp_path / "whole") == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert {path.name for path in (tmp_path / "out").iterdir() if path.is_dir()} == {"shard-1-of-2", "shard-2-of-2"}


def test_processes_wait_for_the_longest_shard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One may have nothing left to do when a run is resumed, and another one all of its shard."""
    waits: list[Any] = []
    make = dist.init_process_group

    def init(*args: Any, **kwargs: Any) -> None:
        waits.append(kwargs["timeout"])
        make(*args, **kwargs)

    monkeypatch.setattr(dist, "init_process_group", init)

    def run(_: int) -> Any:
        args = Namespace(shard=None, out=tmp_path)
        joined = shards.run_shard(args, lambda shard, out: str(shard), lambda folders, out: [path.name for path in folders])
        return joined, waits

    found = run_ranks(2, tmp_path / "ranks", run, connected=False)
    assert found == [(["shard-1-of-2", "shard-2-of-2"], [timedelta(days=365)]), (None, [timedelta(days=365)])]

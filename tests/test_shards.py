"""Evaluations in parts: what is merged is what one run writes, and what is not one evaluation is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_helpers import Choosy, Limited, Nearest, Stub, contents, figures, named, places, read_rows
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.evaluation.instance_sets import InstanceFiles, files_of
from sb3_uav.evaluation.merge import merge
from sb3_uav.evaluation.run import evaluate
from sb3_uav.evaluation.shard import Shard
from sb3_uav.solvers import Solver


@given(n_rows=st.integers(0, 50), count=st.integers(1, 60))
def test_shards_share_out_all_rows(n_rows: int, count: int) -> None:
    parts = [Shard(number, count).rows(n_rows) for number in range(1, count + 1)]
    assert [row for part in parts for row in part] == list(range(n_rows))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/0", "-1/3", "a/b", "1/2/3", "", "1.5/3"])
def test_shards_that_there_are_not(text: str) -> None:
    with pytest.raises(ValueError, match="give i/n with i from 1 to n"):
        Shard.parse(text)


def solvers(batch: Instances) -> list[Solver]:
    """Some that visit what the random numbers say, fail, refuse, are infeasible, or take a time limit."""
    return [Nearest(places(batch)[2:3]), Stub(), named("wrong", Stub([[0, 0]])), Limited(), named("choosy", Choosy())]


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_partition_merges_to_the_whole(data: st.DataObject, tmp_path: Path) -> None:
    """Bytes but for times: results, schedules, and the figures of the summary, in whatever order the folders are given."""
    sizes = data.draw(st.lists(st.integers(1, 6), min_size=1, max_size=3), label="sizes")
    count = data.draw(st.integers(1, 5), label="shards")
    order = data.draw(st.permutations(range(1, count + 1)), label="order")
    sets = {
        f"set {number}": UniformGenerator(4 + number, n_uavs=3 if number else 2)(size, np.random.default_rng(number))
        for number, size in enumerate(sizes)
    }
    shutil.rmtree(tmp_path)
    run: dict[str, Any] = dict(seed=3, time_limits=(1.0, 2.0))
    whole = evaluate(solvers(sets["set 0"]), sets, tmp_path / "whole", **run)
    for number in order:
        evaluate(solvers(sets["set 0"]), sets, tmp_path / str(number), shard=Shard(number, count), **run)
    merged = merge([tmp_path / str(number) for number in order], tmp_path / "merged")
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")
    assert [row[:-4] for row in figures(merged)] == [row[:-4] for row in figures(whole)]
    assert [(row.violations, row.failures) for row in merged] == [(row.violations, row.failures) for row in whole]
    # Then everything is there, and the checker accepts it.
    again = evaluate(solvers(sets["set 0"]), sets, tmp_path / "merged", resume=True, **run)
    assert figures(again) == figures(merged)


def shards(folder: Path, instances: Instances, count: int = 2, **changes: Any) -> list[Path]:
    for number in range(1, count + 1):
        evaluate([Stub(), Nearest()], {"a": instances}, folder / f"{number}", shard=Shard(number, count), **changes)
    return [folder / f"{number}" for number in range(1, count + 1)]


def test_a_shard_is_resumed(instances: Instances, tmp_path: Path) -> None:
    """And is no other shard, and not the whole."""
    with pytest.raises(KeyboardInterrupt):
        evaluate([Nearest(places(instances)[4:], KeyboardInterrupt())], {"a": instances}, tmp_path / "2", shard=Shard(2, 2))
    solver = Nearest()
    (row,) = evaluate([solver], {"a": instances}, tmp_path / "2", shard=Shard(2, 2), resume=True)
    assert solver.solved == places(instances)[4:] and row.n_instances == 3
    assert [row["instance"] for row in read_rows(tmp_path / "2")] == ["2", "3", "4"]
    assert json.loads((tmp_path / "2" / "summary.json").read_text())["shard"] == "2/2"
    for shard, found in ((Shard(1, 2), "shard 1/2"), (Shard(), "all instances")):
        with pytest.raises(ValueError, match=f"holds results of shard 2/2, not of {found}"):
            evaluate([Nearest()], {"a": instances}, tmp_path / "2", shard=shard, resume=True)


def test_shards_that_overlap_or_are_missing(instances: Instances, tmp_path: Path) -> None:
    one, two = shards(tmp_path, instances)
    with pytest.raises(ValueError, match=r"on 3 of 5 instances of 'a', the first is instance 2; shard 2/2 is missing"):
        merge([one], tmp_path / "out")
    shutil.copytree(two, tmp_path / "copy")
    with pytest.raises(ValueError, match=r"copy: overlaps with .*2: both hold 3 results of 'stub'.* first on instance 2"):
        merge([one, two, tmp_path / "copy"], tmp_path / "out")
    # Cut in another way: they overlap, and leave a gap.
    three = shards(tmp_path / "thirds", instances, 3)
    with pytest.raises(ValueError, match="overlaps with"):
        merge([one, *three[1:]], tmp_path / "out")
    lines = (two / "results.csv").read_text().splitlines(keepends=True)
    (two / "results.csv").write_text("".join(lines[:-1]))
    with pytest.raises(ValueError, match=r"no result of 'nearest' with seed 0 on 1 of 5 instances of 'a', .* instance 4; run"):
        merge([one, two], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda said: said["instances"][0].update(sha256="0" * 64), "sha256 of set 0 of the instances is '000"),
        (lambda said: said["instances"].append(said["instances"][0]), "number of sets of instances is 2 and not 1"),
        (lambda said: said["solvers"]["stub"]["settings"].update(k=3), "k of solver 'stub' is 3 and not None"),
        (lambda said: said["runs"][-1].update(seed=1), "seed is 1 and not 0"),
        (lambda said: said["runs"][-1].update(time_limits=[5.0]), r"time_limits is \[5.0\] and not \[None\]"),
        (lambda said: said["runs"][-1]["versions"].update(torch="0.1"), "version of torch is '0.1' and not"),
        (lambda said: said.update(format=7), "its format is 7"),
        (lambda said: said.update(runs=[]), "does not describe an evaluation"),
    ],
)
def test_shards_of_other_evaluations(change: Any, message: str, instances: Instances, tmp_path: Path) -> None:
    one, two = shards(tmp_path, instances)
    said = json.loads((two / "evaluation.json").read_text())
    change(said)
    (two / "evaluation.json").write_text(json.dumps(said))
    with pytest.raises(ValueError, match=message):
        merge([one, two], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_where_a_merge_may_write(instances: Instances, tmp_path: Path) -> None:
    parts = shards(tmp_path, instances)
    evaluate([Stub()], instances, tmp_path / "other")
    with pytest.raises(ValueError, match="other: holds results of an evaluation; choose another --out"):
        merge(parts, tmp_path / "other")
    with pytest.raises(ValueError, match="is one of the folders to merge"):
        merge(parts, parts[0])
    with pytest.raises(FileNotFoundError, match=r"holds no results\.csv"):
        merge([*parts, tmp_path / "none"], tmp_path / "out")
    merge(parts, tmp_path / "other", overwrite=True)
    # What a merge has written can be made again.
    merge(parts, tmp_path / "other")
    assert json.loads((tmp_path / "other" / "evaluation.json").read_text())["merged"] == ["1/2", "2/2"]


def test_a_set_in_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One row of the summary, rows counted through, and one file in memory at a time."""
    for number, size in enumerate((3, 1, 2)):
        UniformGenerator(5, n_uavs=2)(size, np.random.default_rng(number)).save(tmp_path / "set" / f"{number}.npz")
    loaded: list[str] = []
    load = Instances.load.__func__  # type: ignore[attr-defined]

    def noted(cls: type[Instances], path: Path) -> Instances:
        loaded.append(path.stem)
        return load(cls, path)

    monkeypatch.setattr(Instances, "load", classmethod(noted))
    sets = files_of([tmp_path / "set"])
    (row,) = evaluate([Nearest()], sets, tmp_path / "out")
    assert row.source == "set" and row.n_instances == 6
    assert [line["instance"] for line in read_rows(tmp_path / "out")] == [str(number) for number in range(6)]
    loaded.clear()
    evaluate([Nearest(), Stub()], {"set": InstanceFiles([tmp_path / "set" / f"{n}.npz" for n in range(3)])}, tmp_path / "2")
    assert loaded == ["0", "1", "2"] * 4
    # Of a shard, only the files with its rows are read to solve them.
    loaded.clear()
    evaluate([Nearest()], files_of([tmp_path / "set"]), tmp_path / "3", shard=Shard(1, 3))
    assert loaded == ["0", "1", "2"] * 2 + ["0"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"empty: holds no \.npz file"):
        files_of([tmp_path / "empty"])

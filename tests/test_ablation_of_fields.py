"""The ablation of fields: networks that do not see a field act as if it had its default, and all else is as it is."""

from __future__ import annotations

import csv
import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_uav.envs import Instances, UniformGenerator, check_schedule

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "any_fleet_any_value.py"
FIELDS = ("values", "service", "start", "end", "ranges")


@pytest.fixture(scope="module")
def benchmark() -> Any:
    specification = importlib.util.spec_from_file_location("any_fleet_any_value", SCRIPT)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def unlike(seed: int = 0) -> Instances:
    """Two instances in which every field differs from its default."""
    rng = np.random.default_rng(seed)
    plain = UniformGenerator(12, 2)(2, rng)
    return Instances.from_arrays(
        plain.depot,
        plain.tasks,
        values=rng.integers(1, 50, (2, 12)),
        max_distance=rng.uniform(1.0, 2.2, (2, 2)),
        n_uavs=2,
        start=rng.random((2, 2, 2)),
        end=rng.random((2, 2, 2)),
        service=0.2 * rng.random((2, 12)),
    )


def test_only_the_hidden_field_is_replaced(benchmark: Any) -> None:
    instances = unlike()
    names = dict(zip(FIELDS, ("values", "service_cost", "uav_start", "uav_end", "uav_distance"), strict=True))
    for field, hide in benchmark.HIDDEN.items():
        hidden = hide(instances)
        changed = {other for other, name in names.items() if (getattr(hidden, name) != getattr(instances, name)).any()}
        assert changed == ({field} if field in FIELDS else set(FIELDS))
        assert benchmark.tells(instances, hide).all() and not benchmark.tells(hidden, hide).any()
    assert benchmark.HIDDEN["all of these"](instances).is_plain


def test_networks_are_blind_to_what_is_hidden(benchmark: Any) -> None:
    """Probabilities do not change with the field, and only with it hidden."""
    instances = unlike()
    others = {
        "values": replace(instances, values=instances.values.flip(1)),
        "service": replace(instances, service=0.5 * th.as_tensor(instances.service)),
        "start": replace(instances, start=0.9 * th.as_tensor(instances.start)),
        "end": replace(instances, end=0.9 * th.as_tensor(instances.end)),
        "ranges": replace(instances, max_distance=instances.max_distance.flip(1)),
    }
    measuring = benchmark.Measuring("allocator=world", 1, 0)
    pair = measuring.blind("greedy", lambda seen: seen)
    for field, other in others.items():
        for hidden in (field, "nothing"):
            pair.allocator.hide = pair.router.hide = benchmark.HIDDEN.get(hidden, lambda seen: seen)
            nodes = [pair.allocator.encode_nodes(seen) for seen in (instances, other)]
            caches = [pair.allocator.encode(seen) for seen in (instances, other)]
            order = [pair.allocator.task_order(seen) for seen in (instances, other)]
            # As augmentation sees them.
            arranged = [pair.allocator.arranged_cache(nodes[0], order[0], seen) for seen in (instances, other)]
            for one, two in (caches, arranged):
                alike = [th.equal(a, b) for a, b in zip(one.geometry.world, two.geometry.world, strict=True)]
                assert all(alike) == (hidden != "nothing"), field
            assert th.equal(*nodes) == (hidden != "nothing"), field
            assert th.equal(*order) or hidden == "nothing"
            if field != "ranges":
                encoded = [pair.router.encode(seen).nodes for seen in (instances, other)]
                assert th.equal(*encoded) == (hidden != "nothing"), field


@pytest.mark.parametrize("decode", ["greedy", "augment"])
def test_blind_networks_keep_to_the_true_problem(benchmark: Any, decode: str) -> None:
    """All schedules are feasible, and where nothing is hidden they are the pair's own."""
    instances = unlike(1)
    measuring = benchmark.Measuring("allocator=world", 1, 0)
    pair = measuring.blind(decode, lambda seen: seen)
    pair.samples = 16
    for hide in benchmark.HIDDEN.values():
        pair.allocator.hide = pair.router.hide = hide
        for row, result in enumerate(pair.solve(instances)):
            check_schedule(instances, row, result.schedule)
    pair.allocator.hide = pair.router.hide = lambda seen: seen
    own = measuring.networks(f"decode={decode},samples=16")
    found = [[result.schedule for result in solver.solve(instances)] for solver in (pair, own)]
    assert found[0] == found[1]


@pytest.mark.slow
def test_the_command(
    benchmark: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(benchmark, "_ABLATED", ((2, 8),))
    out = tmp_path / "out.csv"
    benchmark.main(["--pair", "world", "--parts", "ablation", "--n-instances", "1", "--seed", "3", "--out", str(out)])
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["part"] for row in rows} == {"ablation"} and {row["n"] for row in rows} == {"2"}
    assert {row["solver"].split(",")[0] for row in rows} == {"decode=greedy", "decode=augment"}
    assert len(capsys.readouterr().out.splitlines()) == len(rows) > 0

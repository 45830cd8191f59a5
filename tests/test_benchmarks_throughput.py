"""The benchmark of both levels' training: what it measures, not how fast it is."""

import csv
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_uav.envs import UniformGenerator
from sb3_uav.envs.allocation import plan_tours
from sb3_uav.policies import RouterPolicy

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "training_throughput.py"
TINY = ["--n-tasks", "5", "--n-uavs", "2", "--batch-size", "4", "--epoch-batches", "1", "--seconds", "0.01", "--rounds", "2"]


@pytest.fixture(scope="module")
def benchmark():
    sys.path.insert(0, str(SCRIPT.parent))
    specification = importlib.util.spec_from_file_location("training_throughput", SCRIPT)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_competitors_and_episodes(benchmark, tmp_path, capsys):
    """Without RL4CO: ours in three ways, of which only the shipped one takes 8 samples of an instance."""
    benchmark.main([*TINY, "--out", str(tmp_path / "out.csv")])
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    samples = {
        (row["level"], row["competitor"], int(row["round"])): int(row["n_episodes"]) / int(row["n_instances"]) for row in rows
    }
    runs = [("allocator", "default"), ("allocator", "paper"), ("router", "default"), ("router", "paper"), ("router", "plain")]
    assert samples == {(*run, number): 8 if run[1] == "default" else 1 for run in runs for number in (1, 2)}
    assert all(int(row["n_instances"]) % 4 == 0 and float(row["seconds"]) >= 0.01 for row in rows)
    printed = capsys.readouterr().out
    assert printed.count("default / paper") == 2 and "rl4co-default" not in printed


def test_settings(benchmark):
    """The paper's way rolls its baseline out from the first instance on; the attention models differ in their shape only."""
    paper, plain = benchmark.settings_of("paper")["router"], benchmark.settings_of("plain")["router"]
    assert (paper["baseline"], paper["baseline_kwargs"], paper.get("n_samples", 1)) == ("rollout", {"warmup_epochs": 0}, 1)
    assert {**plain, "policy_kwargs": None} == {**paper, "policy_kwargs": None}
    expected = dict(embed_dim=128, n_layers=3, n_heads=8, ff_dim=512, normalization="batch")
    assert benchmark.router_shape("paper") == expected
    assert plain["policy_kwargs"] == {"preset": "paper", **benchmark.router_shape("default")}


def test_padded_subsets_get_the_same_tours(benchmark):
    """Padding costs time and nothing else."""
    router = RouterPolicy(*RouterPolicy.placeholder_spaces(None), lambda _: 0.0, embed_dim=8, n_heads=2, ff_dim=8)
    instances = UniformGenerator(12, 2)(4, np.random.default_rng(0))
    assignment = th.from_numpy(np.random.default_rng(1).integers(2, size=(4, 3, 12)))
    ours, padded = (plan_tours(instances, assignment, plan) for plan in (router.plan, benchmark.padded_plan(router)))
    assert th.equal(ours.value, padded.value)


def test_a_failing_rl4co_is_reported(benchmark, tmp_path):
    """Any Python that cannot import RL4CO."""
    broken = tmp_path / "python"
    broken.write_text(f"#!{sys.executable}\nraise SystemExit(3)\n")
    broken.chmod(0o755)
    with pytest.raises(RuntimeError, match=r"_rl4co_server.* ended with 3; see"):
        benchmark.main([*TINY, "--level", "router", "--rl4co", str(broken)])

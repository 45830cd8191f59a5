"""Evaluation on fixed instances of several sizes during training."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv, check_schedule
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import DLDRL
from sb3_uav.training import ITSCallback, SizeGridCallback

SMALL: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)
SIZES = [[2, 9, 4], [3, 12, 2]]


def train(folder: Path, freq: int = 2, n_samples: int | None = None) -> tuple[SizeGridCallback, Any]:
    env = BatchedVecEnv([lambda: TaskAllocationEnv(8, 2)] * 4)
    kwargs: dict[str, Any] = dict(learning_rate=1e-2, instances_per_epoch=8, seed=0, device="cpu", policy_kwargs=SMALL)
    model = REINFORCE(AllocatorPolicy, env, **kwargs)
    its = ITSCallback(
        dict(policy="RouterPolicy", n_envs=4, learning_rate=1e-2, policy_kwargs=SMALL),
        n_epochs=3,
        n_pretraining_epochs=1,
        save_path=str(folder),
    )
    fixed = SizeGridCallback(SIZES, max_distance=1.5, freq=freq, n_samples=n_samples)
    model.learn(10**9, callback=[its, fixed])
    return fixed, model


def test_best_pair_is_kept_and_is_as_good_as_recorded(tmp_path: Path) -> None:
    """By the solver and the independent checker, from the files alone."""
    fixed, _ = train(tmp_path)
    with (tmp_path / "size_grid.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    assert [row["updates"] for row in rows] == [0, 2, 4, 6]
    best = max(rows, key=lambda row: row["score"])
    pair = DLDRL(*(load_policy(tmp_path / f"best_{level}", "cpu") for level in ("allocator", "router")))  # type: ignore[arg-type]
    for name, part in fixed.parts.items():
        results = pair.solve(part)
        found = np.mean([check_schedule(part, row, result.schedule).objective for row, result in enumerate(results)])
        assert found == pytest.approx(best[name])
    assert best["score"] == pytest.approx(np.mean([np.log(best[name]) for name in fixed.parts]))


def test_best_of_several_samples_counts_if_wanted(tmp_path: Path) -> None:
    one, _ = train(tmp_path / "one", n_samples=1)
    many, _ = train(tmp_path / "many", n_samples=64)
    greedy, _ = train(tmp_path / "greedy")
    for name in one.parts:
        # The same training, whatever is evaluated.
        assert all(a[name] <= b[name] for a, b in zip(one.records, many.records, strict=True))
        assert many.records[-1][name] >= greedy.records[-1][name]
    assert sum(many.records[0].values()) > sum(one.records[0].values())
    before = dict(many.records[-1])
    assert many.evaluate() == before["score"]
    with pytest.raises(ValueError, match="n_samples is 0"):
        SizeGridCallback(n_samples=0)


def test_nowhere_to_keep_the_best_pair_is_said() -> None:
    env = BatchedVecEnv([lambda: TaskAllocationEnv(8, 2)] * 4)
    model = REINFORCE(AllocatorPolicy, env, instances_per_epoch=8, seed=0, device="cpu", policy_kwargs=SMALL)
    with pytest.warns(UserWarning, match="set save_path"):
        model.learn(64, callback=SizeGridCallback(SIZES))


def test_evaluation_does_not_disturb_training(tmp_path: Path) -> None:
    _, often = train(tmp_path / "often", 1)
    _, once = train(tmp_path / "once", 100)
    for name, value in often.policy.state_dict().items():
        assert th.equal(value, once.policy.state_dict()[name]), name


def test_errors_name_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="freq is 0"):
        SizeGridCallback(freq=0)
    model = REINFORCE("RouterPolicy", BatchedVecEnv([lambda: RoutePlanningEnv(5)] * 2), policy_kwargs=SMALL, device="cpu")
    with pytest.raises(ValueError, match="needs an AllocatorPolicy on a TaskAllocation environment"):
        model.learn_instances(4, SizeGridCallback(SIZES))


def test_a_resumed_run_keeps_the_best_pair_and_the_history(tmp_path: Path) -> None:
    """Also when it resumes in a folder of its own, as the zoo's runs do."""
    fixed, _ = train(tmp_path / "first")
    best = {name: (tmp_path / "first" / name).read_bytes() for name in ("best_allocator.zip", "best_router.zip")}
    checkpoint = tmp_path / "first" / "its_checkpoint"
    env = BatchedVecEnv([lambda: TaskAllocationEnv(8, 2)] * 4)
    model: Any = REINFORCE.load(checkpoint / "allocator_3.zip", env=env, device="cpu")
    router = dict(policy="RouterPolicy", n_envs=4, learning_rate=1e-2, policy_kwargs=SMALL)
    its = ITSCallback(
        router, n_epochs=4, n_pretraining_epochs=1, save_path=str(tmp_path / "second"), resume_from=str(checkpoint)
    )
    again = SizeGridCallback(SIZES, max_distance=1.5, freq=1)
    # Nothing that comes is as good as what has been.
    again.evaluate = lambda: -1.0  # type: ignore[method-assign]
    model.learn(10**9, callback=[its, again], reset_num_timesteps=False)
    assert again.records == fixed.records and again.best_score == pytest.approx(fixed.best_score)
    assert best == {name: (tmp_path / "second" / name).read_bytes() for name in best}

"""Local search on the whole problem, tasks that are dear, and schedules of the paper's problem that must stay as they are."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from brute_force import largest_value
from conftest import instance_batches, seeds, whole_batches
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import ClusteredGenerator, Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.envs.schedule import InfeasibleScheduleError
from sb3_uav.local_search import kernels
from sb3_uav.local_search.search import LocalSearch, improve, repair

GOLDEN: dict[str, list[str]] = json.loads(
    (Path(__file__).parent / "golden" / "local_search.json").read_text(encoding="utf-8")
)


def random_schedule(instance: Instances, seed: int) -> Schedule:
    """Tasks in random order, each appended to a random tour or left out, where the checker admits it."""
    rng = np.random.default_rng(seed)
    routes: list[list[int]] = [[] for _ in range(instance.n_uavs)]
    for task in rng.permutation(int(instance.task_mask[0].sum())).tolist():
        uav = int(rng.integers(len(routes)))
        routes[uav].append(task)
        try:
            check_schedule(instance, 0, Schedule(routes))
        except InfeasibleScheduleError:
            routes[uav].pop()
    return Schedule(routes)


def rank(instance: Instances, schedule: Schedule) -> tuple[float, float]:
    """Sum of prizes first, then length; the check comes with it."""
    report = check_schedule(replace(instance, values=instance.prizes, must_serve=None), 0, schedule)
    return report.objective, -report.length


# -------------------------------------------------------------------------------------------------------- the whole problem


@settings(max_examples=150)
@given(whole_batches(max_tasks=12), seeds)
def test_repair_of_anything(batch: Instances, seed: int) -> None:
    """Feasible, never worse, and a second repair changes nothing."""
    for row, empty in itertools.product(range(len(batch)), (True, False)):
        instance = batch[row]
        start = Schedule([]) if empty else random_schedule(instance, seed)
        for max_string in (0, 3):
            repaired = repair(instance, start, max_string=max_string)
            assert rank(instance, repaired) >= rank(instance, start)
            assert repair(instance, repaired, max_string=max_string) == repaired


@settings(max_examples=60)
@given(whole_batches(max_tasks=12), seeds)
def test_improvement_of_anything(batch: Instances, seed: int) -> None:
    """Feasible, never worse, and the seed decides."""
    for row, empty in itertools.product(range(len(batch)), (True, False)):
        instance = batch[row]
        start = Schedule([]) if empty else random_schedule(instance, seed)
        improved = improve(instance, start, seed=seed)
        assert rank(instance, improved) >= rank(instance, start)
        assert improve(instance, start, seed=seed) == improved

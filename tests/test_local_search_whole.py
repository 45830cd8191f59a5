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

GOLDEN: dict[str, list[str]] = json.loads((Path(__file__).parent / "golden" / "local_search.json").read_text(encoding="utf-8"))


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


def whole(n_tasks: int, n_uavs: int, seed: int, **changes: Any) -> Instances:
    """Every UAV has its own start, end and distance, every task its own value and service cost."""
    rng = np.random.default_rng(seed)
    fields: dict[str, Any] = {
        "depot": rng.random(2),
        "tasks": rng.random((n_tasks, 2)),
        "values": rng.integers(1, 10, n_tasks),
        "max_distance": rng.uniform(0.8, 2.0, n_uavs) if n_uavs > 1 else 1.5,
        "n_uavs": n_uavs,
        "start": rng.random((n_uavs, 2)),
        "end": rng.random((n_uavs, 2)),
        "service": 0.1 * rng.random(n_tasks),
    }
    return Instances.from_arrays(**{**fields, **changes})


@settings(max_examples=40)
@given(seeds, st.integers(2, 5), st.integers(0, 10), st.booleans())
def test_shortening_keeps_the_books(seed: int, n_uavs: int, n_near: int, one_depot: bool) -> None:
    """
    The moves of one and between tours visit the same tasks on a shorter way, what they say of lengths is true, limits are kept
    and every tour keeps its own terminals.
    """
    depot = np.tile(np.random.default_rng(seed).random(2), (n_uavs, 1))
    instance = whole(40, n_uavs, seed, **({"start": depot, "end": depot} if one_depot else {}))
    search = LocalSearch(instance)
    plan = search._load(random_schedule(instance, seed))
    n_tasks = len(search._tasks)
    terminals = plan.routes[:n_uavs, 0].copy(), plan.routes[np.arange(n_uavs), plan.tours["size"] + 1].copy()
    before, visited = plan.tours["length"].sum(), 1 + np.flatnonzero(plan.nodes["owner"][1 : n_tasks + 1] >= 0)
    plan.lists[kernels.QUEUE, : len(visited)] = visited
    plan.nodes["queued"][visited] = True
    changed = kernels.shorten(plan, len(visited), n_near)
    assert not plan.nodes["queued"][1 : n_tasks + 1].any()
    np.testing.assert_array_equal(1 + np.flatnonzero(plan.nodes["owner"][1 : n_tasks + 1] >= 0), visited)
    np.testing.assert_array_equal(plan.routes[:n_uavs, 0], terminals[0])
    np.testing.assert_array_equal(plan.routes[np.arange(n_uavs), plan.tours["size"] + 1], terminals[1])
    lengths, owners = plan.tours["length"].copy(), plan.nodes["owner"].copy()
    kernels.measure_all(plan)
    np.testing.assert_allclose(plan.tours["length"], lengths, atol=1e-12)
    flying = plan.tours["size"] > 0
    assert (plan.tours["length"] <= plan.tours["limit"])[flying].all()
    np.testing.assert_array_equal(plan.nodes["owner"], owners)
    assert (lengths.sum() < before - 1e-12) if changed else (lengths.sum() == before)
    report = check_schedule(instance, 0, search._unload(plan))
    np.testing.assert_allclose(np.array(report.lengths)[flying] / float(instance.unit[0]), lengths[flying], atol=1e-12)

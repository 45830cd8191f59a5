"""Instances of every kind: all kinds occur, ranges are tight and loose, and draws can be repeated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from instance_helpers import assert_equal

from sb3_uav.distributions.layouts import DEPOTS, LAYOUTS
from sb3_uav.distributions.task_values import VALUES
from sb3_uav.envs import Instances, TaskAllocationEnv, WorldGenerator, nearest_feasible
from sb3_uav.envs.compaction import compact
from sb3_uav.envs.world import SERVICES, SITES, _curve_length


def rng_of(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def served_share(instances: Instances) -> np.ndarray:
    """Part of the tasks that UAVs serve when each in turn always flies to the nearest feasible task, ``(batch,)``."""
    left = instances.task_mask
    for uav in range(instances.n_uavs):
        ends: Any = {
            name: None if (field := getattr(instances, name)) is None else field[:, uav : uav + 1] for name in ("start", "end")
        }
        single = replace(instances, n_uavs=1, max_distance=instances.uav_distance[:, uav].clone(), task_mask=left, **ends)
        visits = th.zeros(len(left), left.shape[1] + 1, dtype=th.bool).scatter(1, nearest_feasible(single), True)
        left = left & ~visits[:, 1:]
    return 1 - (left.sum(1) / instances.task_mask.sum(1)).numpy()


@settings(max_examples=60)
@given(seeds, st.integers(1, 40), st.integers(1, 10), st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0.3, 2.0, 1e4]))
def test_every_instance_is_valid_and_has_a_task_in_reach(
    seed: int, n_tasks: int, n_uavs: int, whole_share: float, max_distance: float
) -> None:
    generator = WorldGenerator(n_tasks, n_uavs, max_distance, min_tasks=5, whole_share=whole_share)
    drawn = generator(8, rng_of(seed))
    drawn.validate()
    assert (len(drawn), drawn.n_tasks, drawn.n_uavs) == (8, n_tasks, n_uavs) and drawn.task_mask.all()
    assert drawn.must_serve is None and drawn.reachable().any(1).all()
    assert (drawn.unit == max_distance).all() and th.allclose(drawn.values.mean(1), th.ones(8, dtype=th.float64))
    for batch in generator.batches(6, rng_of(seed), 3):
        batch.validate()
        assert len(batch) >= 2 and batch.n_tasks <= n_tasks and batch.n_uavs <= n_uavs and batch.task_mask[:, 0].all()
        assert whole_share > 0 or batch.is_plain


def test_all_kinds_occur_as_often_as_they_should() -> None:
    drawn, kinds = WorldGenerator(30, 4).draw(4000, rng_of())
    odds: dict[str, dict[str, float]] = {
        "layout": {name: odds for name, (_, odds) in LAYOUTS.items()},
        "depot": DEPOTS,
        "values": {name: odds for name, (_, odds) in VALUES.items()},
    }
    for name, expected in odds.items():
        found = getattr(kinds, name)[~kinds.paper]
        for kind, share in expected.items():
            assert (found == kind).mean() == pytest.approx(share / sum(expected.values()), abs=0.03), kind
    assert kinds.paper.mean() == pytest.approx(0.15, abs=0.02)
    assert {*kinds.site} == {*SITES} and {*kinds.service} == {*SERVICES}
    # The plain problem is the most frequent of all.
    assert 0.6 < (kinds.site == "one depot").mean() < 0.85 and 0.65 < (kinds.service == "none").mean() < 0.9

    def differs(points: th.Tensor) -> np.ndarray:
        return (points != drawn.depot[:, None]).any(-1).numpy()

    starts, ends = differs(drawn.uav_start), differs(drawn.uav_end)
    for site, (starts_away, ends_away) in {
        "one depot": (False, False),
        "open": (False, True),
        "in the air": (True, False),
    }.items():
        rows = kinds.site == site
        assert (starts[rows] == starts_away).all() and (ends[rows] == ends_away).all(), site
    several = kinds.site == "several depots"
    assert (drawn.uav_start == drawn.uav_end).all(-1).numpy()[several].all()
    assert not starts[several, 0].any() and starts[several, 1].all()
    spread = (drawn.uav_distance.amax(1) - drawn.uav_distance.amin(1)).numpy()
    assert (spread[kinds.unequal] > 0).all() and (spread[~kinds.unequal & (kinds.site == "one depot")] == 0).all()
    cost = drawn.service_cost.numpy()
    assert (cost[kinds.service == "none"] == 0).all() and (cost[kinds.service == "constant"] > 0).all()
    assert (np.ptp(cost[kinds.service == "constant"], axis=1) == 0).all()
    assert (np.ptp(cost[kinds.service == "varying"], axis=1) > 0).all()


def test_some_uavs_in_the_air_cannot_reach_the_depot() -> None:
    drawn, kinds = WorldGenerator(20, 5, whole_share=1.0).draw(1000, rng_of())
    way = (drawn.uav_start - drawn.uav_end).norm(dim=-1)
    grounded = (way > drawn.uav_distance).numpy()
    in_the_air = kinds.site == "in the air"
    assert not grounded[~in_the_air].any() and not grounded[:, 0].any()
    assert 0.01 < grounded[in_the_air].mean() < 0.05 and (drawn.uav_distance > 0).all()


@pytest.mark.parametrize(("n_tasks", "n_uavs"), [(20, 1), (40, 4), (100, 8)])
def test_ranges_are_tight_and_loose(n_tasks: int, n_uavs: int) -> None:
    """From a tenth of the tasks up to all of them, and about as many as the range was made for."""
    drawn, kinds = WorldGenerator(n_tasks, n_uavs).draw(200, rng_of())
    served = served_share(drawn)
    assert np.quantile(served, 0.03) < 0.25 and np.quantile(served, 0.8) > 0.8
    for low in np.arange(0.2, 1.0, 0.2):
        assert ((served >= low) & (served < low + 0.2)).mean() > 0.08
    made = ~kinds.paper
    assert np.corrcoef(served[made], kinds.share[made])[0, 1] > 0.8
    assert 0.8 < np.median(served[made] / np.minimum(kinds.share[made], 1)) < 1.3


def test_papers_rows_are_the_papers() -> None:
    drawn, kinds = WorldGenerator(60, 4, paper_share=1.0).draw(400, rng_of())
    assert kinds.paper.all() and drawn.is_plain and (drawn.values == 1).all() and (drawn.max_distance == 2).all()
    side = th.cat([drawn.depot[:, None], drawn.tasks], 1).amax((1, 2))
    exact = (side <= 1) & (side > 0.9)
    assert 0.4 < exact.double().mean() and side.max() > 1.4 and side.min() < 0.7
    assert drawn.depot.mean().item() == pytest.approx(0.5, abs=0.1)


def test_lattices_have_ties_and_strips_are_long() -> None:
    drawn, kinds = WorldGenerator(50, 2, paper_share=0.0).draw(600, rng_of())

    def n_distances(layout: str) -> float:
        tasks = drawn.tasks[th.from_numpy(kinds.layout == layout)]
        nearest = (th.cdist(tasks, tasks) + 1e9 * th.eye(50)).amin(-1) / drawn.unit[0]
        return float(np.mean([len(np.unique(row.numpy().round(7))) for row in nearest]))

    assert n_distances("lattice") < 5 < 30 < n_distances("uniform")

    def thickness(layout: str) -> th.Tensor:
        tasks = drawn.tasks[th.from_numpy(kinds.layout == layout)]
        spread = th.linalg.svdvals(tasks - tasks.mean(1, keepdim=True))
        return (spread[:, 1] / spread[:, 0]).median()

    assert thickness("strip") < 0.35 < 0.7 < thickness("uniform")


def test_sizes_of_training_batches_are_log_uniform() -> None:
    batches = list(WorldGenerator(320, 8, min_tasks=20).batches(32, rng_of(), 300))
    sizes, fleets = np.array([batch.n_tasks for batch in batches]), np.array([batch.n_uavs for batch in batches])
    # A range for few tasks leaves few in reach.
    assert sizes.max() > 250 and (sizes < 40).mean() < 0.5 and (sizes > 160).mean() > 0.1
    assert {*fleets} == set(range(1, 9)) and 0.07 < (fleets == 1).mean() < 0.18
    assert len(batches[int(sizes.argmax())]) < max(map(len, batches)) == 32
    assert 0.3 < np.mean([batch.is_plain for batch in batches]) < 0.7
    padded = [batch for batch in batches if not batch.task_mask.all()]
    assert 0.1 < len(padded) / len(batches) < 0.9
    assert all(batch.reachable()[batch.task_mask].all() for batch in padded)
    assert {batch.n_uavs for batch in WorldGenerator(100, 4, min_uavs=3).batches(4, rng_of(), 20)} == {3, 4}


def test_same_random_numbers_give_the_same_instances() -> None:
    generator = WorldGenerator(30, 4)
    first, batch = generator(5, rng_of(7)), generator.training_batch(8, rng_of(7))
    assert_equal(first, WorldGenerator(30, 4)(5, rng_of(7)))
    assert_equal(batch, next(generator.batches(8, rng_of(7))))
    assert first.digest() != generator(5, rng_of(8)).digest()


def test_a_yaml_can_name_it() -> None:
    env = TaskAllocationEnv(25, 3, distribution="world")
    assert env.problem.generator == WorldGenerator(25, 3, 2.0)
    other = TaskAllocationEnv(25, 3, generator={"sb3_uav.envs.WorldGenerator": {"whole_share": 0.0, "min_uavs": 2}})
    assert other.problem.generator == WorldGenerator(25, 3, 2.0, min_uavs=2, whole_share=0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_tasks": 0}, "n_tasks is 0"),
        ({"min_tasks": 0}, "min_tasks is 0; give at least 1"),
        ({"min_uavs": -1}, "min_uavs is -1"),
        ({"whole_share": 1.5}, "whole_share is 1.5; give a number from 0 to 1"),
        ({"paper_share": float("nan")}, "paper_share is nan"),
    ],
)
def test_bad_arguments_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldGenerator(**changes)


def test_the_curve_visits_near_points_one_after_the_other() -> None:
    """About a quarter longer than an optimal tour, 0.7124 times the root of number and area; only kept points count."""
    points = rng_of().random((20, 400, 2))
    everything = np.ones(points.shape[:2], bool)
    length = _curve_length(points, everything).mean()
    assert 1.15 < length / (0.7124 * 20) < 1.4
    half = np.arange(400) < 200
    assert _curve_length(points, np.broadcast_to(half, everything.shape)) == pytest.approx(
        _curve_length(points[:, :200], everything[:, :200]), rel=0.1
    )
    assert (_curve_length(points, np.arange(400) < np.ones((20, 1))) == 0).all()


@settings(max_examples=30)
@given(seeds)
def test_compaction_keeps_what_is_kept(seed: int) -> None:
    rng = rng_of(seed)
    drawn = WorldGenerator(9, 3, whole_share=1.0)(4, rng)
    kept = th.from_numpy(rng.random((4, 9)) < rng.random((4, 1)))
    compacted, index = compact(drawn, kept)
    compacted.validate()
    for row in range(4):
        (tasks,) = kept[row].nonzero(as_tuple=True)
        assert index[row, : len(tasks)].tolist() == tasks.tolist() and int(compacted.task_mask[row].sum()) == len(tasks)
        assert th.equal(compacted.tasks[row, : len(tasks)], drawn.tasks[row, tasks])
        assert th.equal(compacted.service_cost[row, : len(tasks)], drawn.service_cost[row, tasks])
        padded = ~compacted.task_mask[row]
        assert (compacted.service_cost[row, padded] == 0).all()


def test_compaction_leaves_padding_empty() -> None:
    """As padding that was never a task."""
    drawn = Instances.from_arrays([0, 0], [[1, 0], [2, 0], [3, 0]], service=[0.1, 0.2, 0.3], must_serve=[True, True, True])
    both = Instances.concatenate([drawn, drawn])
    compacted, _ = compact(both, th.tensor([[True, True, False], [True, False, False]]))
    assert compacted[1].digest() == drawn.trim(1).pad(2).digest()

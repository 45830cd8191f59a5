"""Repair and polish behind the networks: never worse, within the time, and named as what they are."""

from __future__ import annotations

import math
import re
import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches
from hypothesis import given, settings
from solver_helpers import make_pair, objectives, routes

from sb3_uav.common.optional import install_command
from sb3_uav.envs import Instances, Schedule, UniformGenerator, check_schedule
from sb3_uav.evaluation.run import evaluate
from sb3_uav.solvers import make_solver
from sb3_uav.solvers.counting_tasks import CountingTasks
from sb3_uav.solvers.decoding import Decoder
from sb3_uav.solvers.postprocess import Refinement, polish

pytest.importorskip("numba")
search = pytest.importorskip("sb3_uav.local_search.search")


@pytest.fixture(scope="module")
def instances() -> Instances:
    return UniformGenerator(30, n_uavs=3)(4, np.random.default_rng(5))


def test_repair_and_polish_find_more(instances: Instances) -> None:
    """Untrained networks leave much to be found, also by repairing several samples instead of one."""
    plain = objectives(make_pair(decode="sampling", samples=32), instances).sum()
    repaired = objectives(make_pair(decode="sampling", samples=32, repair=True), instances)
    assert plain < repaired.sum()
    # However little the polishing gets done in its time.
    polished = objectives(make_pair(decode="sampling", samples=32, repair=True, polish=0.1), instances)
    assert (polished >= repaired).all()


@settings(max_examples=15)
@given(instance_batches())
def test_refined_schedules_of_any_instance_are_feasible_and_not_worse(batch: Instances) -> None:
    plain = objectives(make_pair(batch.n_uavs, decode="sampling", samples=4), batch)
    repaired = objectives(make_pair(batch.n_uavs, decode="sampling", samples=4, repair=True), batch)
    polished = objectives(make_pair(batch.n_uavs, decode="sampling", samples=4, polish=0.004), batch)
    assert (repaired >= plain).all() and (polished >= plain).all()


@settings(max_examples=8)
@given(instance_batches(max_tasks=12))
def test_never_worse_than_repaired_insertion(batch: Instances) -> None:
    """Untrained networks are much worse; where there is no time at all, the insertion itself is still there."""
    pairs = [make_pair(batch.n_uavs, **options) for options in ({"repair": True}, {"polish": 0.001})]
    counting = CountingTasks.of(batch).instances
    repaired = [search.repaired_insertion(counting[row]) for row in range(len(batch))]
    inserted = [search.repaired_insertion(counting[row], 0.0) for row in range(len(batch))]
    for pair in pairs:
        for found, time_limit in ((repaired, None), (inserted, 1e-6)):
            results = pair.solve(batch, time_limit)
            for row, result in enumerate(results):
                least = check_schedule(counting, row, found[row]).objective
                assert check_schedule(batch, row, result.schedule).objective >= least * (1 - 1e-12)


def test_insertion_has_the_whole_time_limit(instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the networks run, which may need more than there is; what it finds is repaired and compared."""
    events: list[Any] = []
    insertion, blocks = search.repaired_insertion, Decoder.blocks

    def noting(instance: Instances, seconds: float) -> Schedule:
        events.append(seconds)
        return insertion(instance)

    def late(*args: Any, **kwargs: Any) -> Any:
        events.append("networks")
        clock.now = 200.0
        return blocks(*args, **kwargs)

    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(search, "repaired_insertion", noting)
    monkeypatch.setattr(Decoder, "blocks", late)
    for module in ("dl_drl", "postprocess"):
        fake = SimpleNamespace(perf_counter=lambda: clock.now)
        monkeypatch.setattr(f"sb3_uav.solvers.{module}.time", fake)
    found = objectives(make_pair(repair=True, time_limit=0.05), instances)
    assert events == [pytest.approx(0.05)] * 4 + ["networks"]
    least = [check_schedule(instances, row, insertion(instances[row])).objective for row in range(4)]
    assert (found >= np.array(least)).all()


def test_repair_is_repeatable(instances: Instances) -> None:
    pair = make_pair(decode="augment", samples=32, repair=True)
    assert routes(pair, instances, 1) == routes(pair, instances, 1)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_schedules_are_told_as_they_are_found(instances: Instances, batch_size: int) -> None:
    """Each under the row that it is of, whatever the batch; and being told changes nothing."""
    pair = make_pair(decode="augment", samples=32, repair=True, batch_size=batch_size)
    expected = [result.schedule for result in pair.solve(instances, seed=1)]
    told: dict[int, list[Schedule]] = {row: [] for row in range(len(instances))}
    pair.on_incumbent = lambda row, schedule: told[row].append(schedule)
    assert [result.schedule for result in pair.solve(instances, seed=1)] == expected
    for row, schedules in told.items():
        values = [check_schedule(instances, row, schedule).objective for schedule in schedules]
        assert len(values) >= 2 and schedules[-1] == expected[row] and max(values) == values[-1]


def test_who_is_told_may_end_the_search(instances: Instances) -> None:
    pair = make_pair(decode="augment", samples=32, repair=True)
    before = pair._report

    def stop(row: int, schedule: Schedule) -> None:
        raise InterruptedError("enough")

    pair.on_incumbent = stop
    with pytest.raises(InterruptedError, match="enough"):
        pair.solve(instances, seed=1)
    # Nothing of it is left on the solver.
    assert pair._report is before
    pair.on_incumbent = None
    assert routes(pair, instances, 1) == routes(make_pair(decode="augment", samples=32, repair=True), instances, 1)


def test_threads_change_nothing(instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = make_pair(decode="sampling", samples=16, repair=True)
    alone = routes(pair, instances)
    monkeypatch.setattr(th, "get_num_threads", lambda: 3)
    assert routes(pair, instances) == alone


def test_time_limit_limits_samples_and_polish(instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock that advances by each sample, and a little whenever it is read."""
    pair = make_pair(decode="sampling", samples=64, repair=True, polish=9.0)
    drawn: list[int] = []
    spent: list[float] = []
    look = Decoder.look

    def counting(*args: Any) -> Any:
        seen = look(*args)
        drawn.append(len(seen.assignment))
        clock.now += 0.05  # type: ignore[attr-defined]
        return seen

    def clock() -> float:
        clock.now += 1e-4  # type: ignore[attr-defined]
        return clock.now  # type: ignore[attr-defined]

    def noting(instance: Instances, schedule: Schedule, seconds: float, *_: Any) -> Schedule:
        spent.append(seconds)
        return schedule

    clock.now = 0.0  # type: ignore[attr-defined]
    monkeypatch.setattr(Decoder, "look", counting)
    monkeypatch.setattr("sb3_uav.solvers.postprocess.polish", noting)
    monkeypatch.setattr(time, "perf_counter", clock)
    pair.solve(instances, time_limit=0.5)
    some = sum(drawn)
    assert 0 < some < 64 * len(instances) and len(spent) == len(instances)
    # Two seconds for the four of them, less what the networks and the repair took.
    assert 0 < sum(spent) < 2.0
    drawn.clear()
    pair.solve(instances, time_limit=50.0)
    assert sum(drawn) == 64 * len(instances) and max(spent) == 9.0


def test_plain_networks_need_no_time_limit(instances: Instances) -> None:
    plain, limited = make_pair(decode="sampling", samples=8), make_pair(decode="sampling", samples=8, time_limit=30.0)
    assert not plain.uses_time_limit and limited.uses_time_limit
    assert make_pair(repair=True).uses_time_limit and make_pair(polish=0.1).uses_time_limit
    assert (objectives(limited, instances) >= objectives(make_pair(), instances)).all()
    with pytest.raises(ValueError, match=r"time_limit of .* is 0 seconds"):
        limited.solve(instances, time_limit=0.0)


def test_names_say_what_was_done(instances: Instances, tmp_path: Any) -> None:
    """Refined schedules stand in rows of their own."""
    solvers = [make_pair(), make_pair(repair=True), make_pair(decode="augment", samples=16, repair=True, polish=0.01)]
    names = ["DL-DRL (greedy)", "DL-DRL (greedy + repair)", "DL-DRL (augment 16 + repair + polish 0.01 s)"]
    assert [solver.name for solver in solvers] == names
    assert [row.solver for row in evaluate(solvers, instances[:2], tmp_path)] == names
    assert len({str(solver.settings()) for solver in solvers}) == 3


@pytest.mark.parametrize("seconds", [-1.0, math.inf, math.nan])
def test_wrong_polish(seconds: float) -> None:
    with pytest.raises(ValueError, match=f"polish is {seconds:g}; give a number of seconds"):
        Refinement(polish=seconds)


def test_without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    assert not Refinement().is_wanted
    with pytest.raises(ImportError, match=re.escape(install_command("solvers"))):
        Refinement(repair=True)


def test_polish_without_pyvrp(instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ruin and recreate alone, which ends with a repair of at least one round on any machine."""
    monkeypatch.setitem(sys.modules, "pyvrp", None)
    monkeypatch.setattr("sb3_uav.local_search.search._LAST_REPAIR_SECONDS", math.inf)
    assert check_schedule(instances, 0, polish(instances[0], Schedule([]), 0.05)).objective > 0


def test_options_of_the_command_line(instances: Instances) -> None:
    """``repair=1`` as well as ``repair=true``, and the pair that comes with the package."""
    assert make_solver("dl-drl:repair=1,polish=0.5").settings() == make_solver("dl-drl:repair=true,polish=0.5").settings()
    assert make_solver("dl-drl:repair=0").settings() == make_solver("dl-drl").settings()
    assert objectives(make_solver("dl-drl"), instances).min() > 0


def test_every_instance_has_its_share_of_the_time(instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    given_seconds: list[float] = []

    def noting(instance: Instances, candidates: Any, seconds: float) -> Schedule:
        given_seconds.append(seconds)
        return candidates[0]

    monkeypatch.setattr("sb3_uav.local_search.search.repair_best", noting)
    monkeypatch.setattr("sb3_uav.solvers.postprocess.time", SimpleNamespace(perf_counter=lambda: 100.0))
    Refinement(repair=True)(instances, [[Schedule([])]] * len(instances), deadline=108.0)
    assert given_seconds == [2.0] * 4

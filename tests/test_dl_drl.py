"""The trained pair as a solver: greedy decoding, sampling, augmentation, shortlists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from solver_helpers import MANY, make_pair, make_policy, objectives, routes

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy, memory
from sb3_uav.solvers import DLDRL, decoding
from sb3_uav.solvers.seen_instances import View
from sb3_uav.solvers.shortlists import Block, Shortlists


@pytest.fixture(scope="module")
def instances() -> Instances:
    """All tasks are in reach, so that solvers see the instances as they are."""
    batch = UniformGenerator(20, n_uavs=3)(12, np.random.default_rng(0))
    return batch[batch.reachable().all(1)][:9]


def test_greedy_is_the_policies_own_plan(instances: Instances) -> None:
    """The solver does what allocator and router do by hand, whatever the batch."""
    pair = make_pair()
    found = routes(pair, instances)
    for row, schedule in enumerate(found):
        order = pair.allocator.task_order(instances[row])
        assignment = pair.allocator.decode_episodes(instances[row].reorder(order))[0, 0].tolist()
        assert len(schedule) == 3 and order[0].tolist() != sorted(order[0].tolist())
        for uav, route in enumerate(schedule):
            mine = [task for task, owner in zip(order[0].tolist(), assignment, strict=True) if owner == uav]
            assert set(route) <= set(mine)
            if mine:
                subset = Instances.from_arrays(instances.depot[row], instances.tasks[row, mine])
                tour = [mine[node - 1] for node in pair.router.plan(subset)[0].tolist() if node > 0]
                assert list(route) == tour


@pytest.mark.parametrize("batch_size", [1, 4, 100])
@pytest.mark.parametrize("decode", decoding.DECODINGS)
def test_batch_size_changes_only_the_timing(decode: str, batch_size: int, instances: Instances) -> None:
    pair = make_pair(decode=decode, samples=5)
    batched = make_pair(decode=decode, samples=5, batch_size=batch_size)
    results = batched.solve(instances, seed=2)
    assert [result.schedule for result in results] == [result.schedule for result in pair.solve(instances, seed=2)]
    sizes = {1: [1] * 9, 4: [4] * 8 + [1], 100: [9] * 9}[batch_size]
    assert [result.batch_size for result in results] == sizes
    assert all(result.seconds > 0 for result in results)


def test_memory_bounds_the_batch(instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """With hardly any memory, instances are solved one by one, and nothing else changes."""
    pair = make_pair(decode="sampling", samples=3)
    roomy = pair.solve(instances, seed=0)
    monkeypatch.setattr(memory, "_CPU_MEMORY", 1)
    tight = pair.solve(instances, seed=0)
    assert [result.batch_size for result in tight] == [1] * 9
    assert [result.schedule for result in tight] == [result.schedule for result in roomy]
    monkeypatch.undo()
    router = make_policy(RouterPolicy, embed_dim=128, n_heads=8)
    assert 1 <= router.rows_that_fit(1501) < router.rows_that_fit(81) < 10_000


def test_more_samples_are_never_worse(instances: Instances) -> None:
    """Fewer samples are a part of more samples, so the best of them can only grow."""
    samples = (1, 2, 10, decoding.SAMPLE_BLOCK, decoding.SAMPLE_BLOCK + 1, 150)
    best = np.stack([objectives(make_pair(decode="sampling", samples=n), instances, 7) for n in samples])
    assert (np.diff(best, axis=0) >= 0).all()
    assert best[-1].sum() > best[0].sum()


@pytest.mark.parametrize("samples", [1, 3, decoding.SAMPLE_BLOCK + 2])
def test_as_many_samples_as_asked_for(samples: int, instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """The router plans one tour per sample and UAV."""
    pair = make_pair(decode="sampling", samples=samples)
    planned: list[int] = []
    plan = pair.router.plan

    def counting_plan(subsets: Instances) -> th.Tensor:
        planned.append(len(subsets))
        return plan(subsets)

    monkeypatch.setattr(pair.router, "plan", counting_plan)
    pair.solve(instances)
    assert sum(planned) == samples * 9 * 3


@pytest.mark.parametrize("sweep", [True, False])
def test_samples_begin_at_several_gaps(sweep: bool, instances: Instances, monkeypatch: pytest.MonkeyPatch) -> None:
    """An allocator that sweeps sees an instance in several orders; one that does not, as it is given."""
    pair = DLDRL(make_policy(AllocatorPolicy, 3, sweep=sweep), make_policy(RouterPolicy), decode="sampling", samples=9)
    seen: list[th.Tensor] = []
    decode = pair.allocator.decode_episodes

    def noting(shown: Instances, *args: Any) -> th.Tensor:
        seen.append(shown.tasks)
        return decode(shown, *args)

    monkeypatch.setattr(pair.allocator, "decode_episodes", noting)
    pair.solve(instances)
    assert len(seen) == len(instances)
    for i, tasks in enumerate(seen):
        orders = [pair.allocator.task_order(instances[i], variant) for variant in range(len(tasks))]
        assert th.equal(tasks, th.cat([instances[i].reorder(order).tasks for order in orders]))
        different = {tuple(order.flatten().tolist()) for order in orders}
        assert len(different) == decoding._N_SWEEPS == 8 if sweep else len(orders) == 1


def test_sampling_follows_the_seed(instances: Instances) -> None:
    pair = make_pair(decode="sampling", samples=2)
    th.manual_seed(1)
    first = routes(pair, instances, 5)
    th.manual_seed(2)
    assert first == routes(pair, instances, 5)
    assert first != routes(pair, instances, 6)


def test_untrained_networks(instances: Instances) -> None:
    """Same architecture, other parameters, which follow from the seed alone; the global random state is not touched."""
    pair = make_pair(decode="sampling", samples=4)
    state = th.get_rng_state()
    fresh, again, other = pair.untrained(1), pair.untrained(1), pair.untrained(2)
    assert th.equal(state, th.get_rng_state())
    assert fresh.name == "DL-DRL untrained 1 (sampling 4)" and pair.name == "DL-DRL (sampling 4)"
    for level in ("allocator", "router"):
        trained = getattr(pair, level).state_dict()
        initial = getattr(fresh, level).state_dict()
        assert {name: value.shape for name, value in trained.items()} == {name: v.shape for name, v in initial.items()}
        name = "features_extractor.encoder.embed_depot.weight"
        assert not th.equal(trained[name], initial[name])
        assert th.equal(initial[name], getattr(again, level).state_dict()[name])
        assert not th.equal(initial[name], getattr(other, level).state_dict()[name])
    assert objectives(fresh, instances).min() > 0


def test_untrained_keeps_every_setting() -> None:
    pair = DLDRL(
        make_policy(AllocatorPolicy, 5, preset="paper", net_arch=[4], activation_fn=th.nn.ReLU), make_policy(RouterPolicy)
    )
    fresh = pair.untrained()
    assert str(fresh.allocator) == str(pair.allocator) and fresh.allocator.n_uavs == 5
    assert fresh.name == "DL-DRL untrained (greedy)"


def test_policies_left_in_training_mode(instances: Instances) -> None:
    """BatchNorm must not see the instances that are evaluated."""
    pair = DLDRL(make_policy(AllocatorPolicy, 3, preset="paper"), make_policy(RouterPolicy, preset="paper"))
    before = {name: buffer.clone() for name, buffer in pair.allocator.named_buffers()}
    assert len(before) > 0
    expected = routes(pair, instances)
    pair.allocator.set_training_mode(True)
    pair.router.set_training_mode(True)
    assert routes(pair, instances) == expected
    assert all(th.equal(before[name], buffer) for name, buffer in pair.allocator.named_buffers())


def test_wrong_fleet(instances: Instances) -> None:
    """Only an allocator with a scorer for each UAV is bound to a fleet."""
    bound = DLDRL(make_policy(AllocatorPolicy, 4, preset="paper"), make_policy(RouterPolicy))
    with pytest.raises(ValueError, match="trained for 4 UAVs, the instances have 3; use an allocator trained for 3"):
        bound.solve(instances)
    assert objectives(make_pair(4), instances).min() > 0


def test_augmentation_is_never_worse_than_greedy(instances: Instances) -> None:
    """One view is the instance itself, and the first tour of each subset the greedy one."""
    greedy = objectives(make_pair(), instances)
    augmented = objectives(make_pair(decode="augment", samples=128), instances)
    assert (augmented >= greedy).all() and augmented.sum() > greedy.sum()


@pytest.mark.parametrize("samples", [1, 8, 50, 300])
def test_augmentation_plans_no_more_tours_than_asked_for(
    samples: int, instances: Instances, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = make_pair(decode="augment", samples=samples)
    planned: list[int] = []
    plan = pair.router.plan

    def counting_plan(
        subsets: Instances, max_rows: int | None = None, n_tours: int = 1, generator: th.Generator | None = None
    ) -> th.Tensor:
        planned.append(len(subsets) * n_tours)
        return plan(subsets, max_rows, n_tours, generator)

    monkeypatch.setattr(pair.router, "plan", counting_plan)
    pair.solve(instances)
    assert sum(planned) == samples * 9 * 3


@pytest.mark.parametrize("pose", range(8))
def test_views_of_augmentation(pose: int) -> None:
    """First all symmetries in both directions from the widest gap, then the same from the next gap."""
    views = [decoding._view_of(number, pose) for number in range(3 * decoding._N_VIEWS)]
    assert len(set(views)) == len(views) and views[0] == View(pose, 0)
    for turn in range(3):
        of_turn = views[turn * decoding._N_VIEWS : (turn + 1) * decoding._N_VIEWS]
        assert {view.symmetry for view in of_turn} == set(range(8)) and {view.sweep // 2 for view in of_turn} == {turn}


def test_more_tours_are_tried_for_the_best_allocations_of_augmentation(
    instances: Instances, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the last block, and they are not worse than the greedy tours of the same allocations, if seen in the same view."""
    monkeypatch.setattr(decoding, "_N_VIEWS", 1)
    pair = make_pair(decode="augment", samples=MANY)
    n_tours = MANY // 4 // decoding._N_REVISITED
    *first, last = decoding.Decoder(pair.allocator, pair.router, "augment", MANY).blocks(
        instances, range(len(instances)), 0, hurry=False
    )
    assert last.value.shape == (len(instances), decoding._N_REVISITED)
    values = th.cat([block.value for block in first], dim=1)
    assert values.shape[1] == MANY - decoding._N_REVISITED * n_tours
    best = values.sort(dim=1, descending=True).values[:, : decoding._N_REVISITED]
    assert (last.value >= best - 1e-9).all() and last.value.sum() > best.sum()


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(decode="beam"), "decode is 'beam'; choose one of"),
        (dict(decode="sampling", samples=0), "samples is 0; give at least 1"),
        (dict(batch_size=0), "batch_size is 0; give at least 1"),
    ],
)
def test_arguments_of_dl_drl(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_pair(**kwargs)


def test_shortlists_keep_the_best_and_the_first_of_equal_ones() -> None:
    lists = Shortlists(1, 2)
    tours = th.tensor([[[[0, -1]], [[1, -1]], [[1, -1]], [[2, 3]]]])
    lists.add(Block(th.tensor([[1.0, 1.0, 1.0, 2.0]]), tours))
    first = [schedule.routes for schedule in lists.schedules()[0]]
    assert first == [((2, 3),), ((0,),)]
    lists.add(Block(th.tensor([[1.0, 0.5]]), th.tensor([[[[4]], [[5]]]])))
    assert [schedule.routes for schedule in lists.schedules()[0]] == first
    lists.add(Block(th.tensor([[3.0]]), th.tensor([[[[6]]]])))
    assert [schedule.routes for schedule in lists.schedules()[0]] == [((6,),), ((2, 3),)]


def test_shortlists_hold_different_schedules() -> None:
    lists = Shortlists(1, 3)
    copies = th.zeros(1, 9, 1, 1, dtype=th.int64)
    lists.add(Block(th.full((1, 10), 2.0), th.cat([copies, copies[:, :1] + 1], dim=1)))
    assert [schedule.routes for schedule in lists.schedules()[0]] == [((0,),), ((1,),)]

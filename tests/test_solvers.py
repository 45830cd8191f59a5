"""Solvers: what they return is feasible, follows from the seed, and is as good as it must be."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches
from hypothesis import given, settings

from sb3_uav.envs import ClusteredGenerator, InstanceGenerator, Instances, UniformGenerator, check_schedule
from sb3_uav.policies import AllocatorPolicy, RouterPolicy, memory
from sb3_uav.solvers import DLDRL, SOLVERS, KMeansAM, Solver, dl_drl, make_solver
from sb3_uav.solvers.heuristics import KMeansNearest, kmeans
from sb3_uav.solvers.network_solver import parameters_hash

TINY = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)
HEURISTICS = ("kmeans-nearest", "random-nearest")
# So many samples that augmentation keeps some back.
MANY = 40


def make_policy(policy_class: Any, n_uavs: int | None = None, **kwargs: Any) -> Any:
    th.manual_seed(0)
    policy = policy_class(*policy_class.placeholder_spaces(n_uavs), lambda _: 1e-3, **{**TINY, **kwargs})
    policy.set_training_mode(False)
    return policy


def make_pair(n_uavs: int = 3, **kwargs: Any) -> DLDRL:
    return DLDRL(make_policy(AllocatorPolicy, n_uavs), make_policy(RouterPolicy), **kwargs)


def make_kmeans_am(**kwargs: Any) -> KMeansAM:
    return KMeansAM(make_policy(RouterPolicy), **kwargs)


def objectives(solver: Solver, instances: Instances, seed: int = 0) -> np.ndarray:
    results = solver.solve(instances, seed=seed)
    assert len(results) == len(instances)
    return np.array([check_schedule(instances, row, result.schedule).objective for row, result in enumerate(results)])


def routes(solver: Solver, instances: Instances, seed: int = 0) -> list[tuple[tuple[int, ...], ...]]:
    return [result.schedule.routes for result in solver.solve(instances, seed=seed)]


@pytest.fixture(scope="module")
def instances() -> Instances:
    return UniformGenerator(20, n_uavs=3)(9, np.random.default_rng(0))


# ------------------------------------------------------------------------------------------------------------- all solvers


@settings(max_examples=40)
@given(instance_batches())
def test_schedules_of_any_instance_are_feasible(batch: Instances) -> None:
    """Of any instance that is allowed; and as every task has a UAV, some task is visited if any can be reached."""
    reachable = batch.reachable().any(1).tolist()
    pair = make_pair(batch.n_uavs, decode="sampling", samples=3)
    augmented = make_pair(batch.n_uavs, decode="augment", samples=MANY)
    pairs = (pair, augmented, make_pair(batch.n_uavs), make_kmeans_am())
    for solver in (*map(make_solver, HEURISTICS), *pairs):
        objectives(solver, batch)
        visited = [result.schedule.n_visited > 0 for result in solver.solve(batch)]
        assert visited == reachable, solver.name


@pytest.mark.parametrize("spec", [*HEURISTICS, "kmeans-am", "sampling", "augment"])
def test_the_seed_decides(spec: str, instances: Instances) -> None:
    """Same seed, same schedules; the row of an instance, not the batch it comes in, decides what happens to it."""
    networks: dict[str, Solver] = {"kmeans-am": make_kmeans_am(), "sampling": make_pair(decode="sampling", samples=3)}
    networks["augment"] = make_pair(decode="augment", samples=MANY)
    solver = networks[spec] if spec in networks else make_solver(spec)
    for rows in ([5, 2], [0], []):
        expected = [(row, routes(solver, instances, 3)[row]) for row in rows]
        found = [(row, result.schedule.routes) for row, result in solver.solve_rows(instances, rows, seed=3)]
        assert found == expected
    assert routes(solver, instances, 3) == routes(solver, instances, 3)
    assert routes(solver, instances[:4], 3) == routes(solver, instances, 3)[:4]
    assert routes(make_solver("random-nearest"), instances, 3) != routes(make_solver("random-nearest"), instances, 4)


def test_padding_changes_nothing(instances: Instances) -> None:
    for solver in (*map(make_solver, HEURISTICS), make_pair(), make_kmeans_am()):
        assert routes(solver, instances.pad(31)) == routes(solver, instances), solver.name


# -------------------------------------------------------------------------------------------------------------- heuristics


def test_kmeans_finds_separate_clusters() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(4, size=60)
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])[truth] + rng.normal(0, 0.02, (60, 2))
    labels = kmeans(points * 1e-150, 4, rng)
    assert len({(a, b) for a, b in zip(truth.tolist(), labels.tolist(), strict=True)}) == 4
    assert len(set(labels.tolist())) == 4


@pytest.mark.parametrize("n_points, n_clusters", [(1, 1), (1, 4), (3, 5), (6, 2)])
def test_kmeans_of_coincident_points(n_points: int, n_clusters: int) -> None:
    labels = kmeans(np.full((n_points, 2), 0.3), n_clusters, np.random.default_rng(0))
    assert set(labels.tolist()) == {0}


def test_kmeans_gives_every_point_its_own_cluster_if_it_can() -> None:
    points = np.random.default_rng(1).random((5, 2))
    assert sorted(kmeans(points, 5, np.random.default_rng(0)).tolist()) == [0, 1, 2, 3, 4]


def test_kmeans_centres_are_nearest() -> None:
    """At the end no point is nearer to another cluster's centre, and more restarts never give a larger inertia."""
    points = np.random.default_rng(2).random((80, 2))

    def inertia(labels: np.ndarray) -> float:
        return sum(np.square(points[labels == k] - points[labels == k].mean(0)).sum() for k in set(labels.tolist()))

    few, many = kmeans(points, 6, np.random.default_rng(0), 1), kmeans(points, 6, np.random.default_rng(0), 30)
    assert inertia(many) <= inertia(few)
    centres = np.stack([points[many == k].mean(0) for k in range(6)])
    np.testing.assert_array_equal(np.square(points[:, None] - centres).sum(-1).argmin(1), many)


@pytest.mark.parametrize("generator", [UniformGenerator(80), ClusteredGenerator(80)])
def test_kmeans_beats_a_random_split(generator: InstanceGenerator) -> None:
    batch = generator(30, np.random.default_rng(5))
    gain = objectives(make_solver("kmeans-nearest"), batch) - objectives(make_solver("random-nearest"), batch)
    assert gain.mean() > 10 and (gain > 0).mean() > 0.9


# ------------------------------------------------------------------------------------------------------------------ DL-DRL


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
@pytest.mark.parametrize("decode", dl_drl.DECODINGS)
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
    monkeypatch.setattr(memory, "CPU_MEMORY", 1)
    tight = pair.solve(instances, seed=0)
    assert [result.batch_size for result in tight] == [1] * 9
    assert [result.schedule for result in tight] == [result.schedule for result in roomy]
    monkeypatch.undo()
    router = make_policy(RouterPolicy, embed_dim=128, n_heads=8)
    assert 1 <= router.rows_that_fit(1501) < router.rows_that_fit(81) < 10_000


def test_more_samples_are_never_worse(instances: Instances) -> None:
    """Fewer samples are a part of more samples, so the best of them can only grow."""
    samples = (1, 2, 10, dl_drl.SAMPLE_BLOCK, dl_drl.SAMPLE_BLOCK + 1, 150)
    best = np.stack([objectives(make_pair(decode="sampling", samples=n), instances, 7) for n in samples])
    assert (np.diff(best, axis=0) >= 0).all()
    assert best[-1].sum() > best[0].sum()


@pytest.mark.parametrize("samples", [1, 3, dl_drl.SAMPLE_BLOCK + 2])
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
        assert len(different) == dl_drl.N_SWEEPS == 8 if sweep else len(orders) == 1


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
    """The first view is the instance itself, and the first tour of each subset the greedy one."""
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


def test_views_of_augmentation() -> None:
    """First all symmetries in both directions from the widest gap, then the same from the next gap."""
    views = [dl_drl.view_of(number) for number in range(3 * dl_drl.N_VIEWS)]
    assert len(set(views)) == len(views)
    for turn in range(3):
        of_turn = views[turn * dl_drl.N_VIEWS : (turn + 1) * dl_drl.N_VIEWS]
        assert {view.symmetry for view in of_turn} == set(range(8)) and {view.sweep // 2 for view in of_turn} == {turn}


def test_more_tours_are_tried_for_the_best_allocations_of_augmentation(
    instances: Instances, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the last block, and they are not worse than the greedy tours of the same allocations, if seen in the same view."""
    monkeypatch.setattr(dl_drl, "N_VIEWS", 1)
    pair = make_pair(decode="augment", samples=MANY)
    n_tours = MANY // 4 // dl_drl.N_REVISITED
    *first, last = pair._blocks(instances, range(len(instances)), 0, hurry=False)
    assert last.value.shape == (len(instances), dl_drl.N_REVISITED)
    values = th.cat([block.value for block in first], dim=1)
    assert values.shape[1] == MANY - dl_drl.N_REVISITED * n_tours
    best = values.sort(dim=1, descending=True).values[:, : dl_drl.N_REVISITED]
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


# -------------------------------------------------------------------------------------------------------------- K-means+AM


def test_kmeans_am_routes_the_clusters_of_kmeans(instances: Instances) -> None:
    """Every tour is the router's own plan for one cluster, and the clusters are those of kmeans-nearest."""
    solver = make_kmeans_am(batch_size=4)
    for row, schedule in enumerate(routes(solver, instances, 7)):
        clusters = kmeans(instances.tasks[row].numpy(), 3, np.random.default_rng([7, row]))
        for uav, route in enumerate(schedule):
            mine = np.nonzero(clusters == uav)[0].tolist()
            subset = Instances.from_arrays(instances.depot[row], instances.tasks[row, mine])
            assert list(route) == [mine[node - 1] for node in solver.router.plan(subset)[0].tolist() if node > 0]
    assert [result.batch_size for result in solver.solve(instances)] == [4] * 8 + [1]


def test_any_fleet_suits_kmeans_am() -> None:
    batch = Instances.concatenate([UniformGenerator(n, n_uavs=7)(2, np.random.default_rng(n)) for n in (1, 5, 12)])
    assert (objectives(make_kmeans_am(), batch) > 0).any()


def test_wrong_arguments_of_kmeans_am() -> None:
    with pytest.raises(ValueError, match="restarts of kmeans-am is 0; K-means needs at least 1 start"):
        make_kmeans_am(restarts=0)
    with pytest.raises(ValueError, match="batch_size is 0; give at least 1"):
        make_kmeans_am(batch_size=0)


# ---------------------------------------------------------------------------------------------------------------- settings


def test_settings_tell_solvers_apart() -> None:
    """What may change the schedules is in the settings; the batch size, the name and the device are not."""
    pair = make_pair()
    assert pair.settings() == make_pair(batch_size=3, name="other").settings() == make_pair(samples=3).settings()
    sampling = [make_pair(decode="sampling", samples=samples) for samples in (3, 128)]
    kmeans_am = make_kmeans_am()
    different: list[Solver] = [pair, make_pair(4), *sampling, pair.untrained(), kmeans_am, make_kmeans_am(restarts=3)]
    every = [solver.settings() for solver in different]
    assert all(first != second for i, first in enumerate(every) for second in every[:i])
    assert kmeans_am.settings()["router"] == parameters_hash(pair.router) == pair.settings()["router"]
    with th.no_grad():
        next(pair.router.parameters()).view(-1)[0] += 1e-6
    assert parameters_hash(pair.router) != kmeans_am.settings()["router"]
    assert make_solver("kmeans-nearest:restarts=3").settings() == {"spec": "kmeans-nearest:restarts=3"}


# ---------------------------------------------------------------------------------------------------------------- registry


def test_options() -> None:
    solver = make_solver("kmeans-nearest:restarts=3")
    assert isinstance(solver, KMeansNearest) and solver.restarts == 3
    assert solver.name == "kmeans-nearest:restarts=3"
    assert make_solver("kmeans-nearest").name == "kmeans-nearest"
    named = make_solver("kmeans-nearest:name=K-means,restarts=4")
    assert isinstance(named, KMeansNearest) and named.name == "K-means" and named.restarts == 4


def test_defaults_are_for_solvers_that_have_them() -> None:
    solver = make_solver("kmeans-nearest", restarts=3, device="cpu")
    assert isinstance(solver, KMeansNearest) and solver.restarts == 3
    solver = make_solver("kmeans-nearest:restarts=2", restarts=3)
    assert isinstance(solver, KMeansNearest) and solver.restarts == 2


@pytest.mark.parametrize(
    "spec, message",
    [
        ("kmeans", r"Unknown solver 'kmeans'; choose one of \['dl-drl', 'dl-drl-i', .*'kmeans-am'"),
        ("kmeans-nearest:k=3", r"has no option 'k=3'; its options are: name=<str>, restarts=<int>"),
        ("kmeans-nearest:restarts", r"has no option 'restarts'"),
        ("random-nearest:restarts=2", r"has no option 'restarts=2'; its options are: name=<str>\."),
        ("kmeans-nearest:restarts=two", r"'restarts=two' of solver 'kmeans-nearest' must be of type int"),
        ("kmeans-nearest:restarts=__import__('os')", "must be of type int"),
        ("kmeans-nearest:restarts=1,restarts=2", "given the option 'restarts' twice"),
        ("kmeans-nearest:restarts=0", "at least 1 start"),
        (
            "dl-drl:allocator=a.zip",
            r"a\.zip is one zip of a pair, and its router is missing: give both, or the name of a pair",
        ),
        ("dl-drl:router=r.zip", r"r\.zip is one zip of a pair, and its allocator is missing"),
        ("dl-drl:polish=-1", "polish is -1; give a number of seconds"),
        ("dl-drl:time_limit=0", "time_limit of DL-DRL .greedy. is 0 seconds"),
        ("dl-drl-i:allocator=a.zip,router=r.zip,batch_size=few", "must be of type int"),
        ("kmeans-am:restarts=2", "'kmeans-am' needs the option router=<str>"),
    ],
)
def test_wrong_options(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_solver(spec)


class Typed:
    """A solver with an option of every type."""

    def __init__(self, number: float = 1.0, flag: bool = False, text: str = "") -> None:
        self.options = dict(number=number, flag=flag, text=text)


def test_typed_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOLVERS, "typed", f"{__name__}:Typed")
    solver: Any = make_solver("typed:number=1e-3,flag=true,text=a=b")
    # As JSON, because there True is not 1.
    assert json.dumps(solver.options) == json.dumps(dict(number=1e-3, flag=True, text="a=b"))
    with pytest.raises(ValueError, match="'flag=yes' of solver 'typed' must be true or false, or 1 or 0"):
        make_solver("typed:flag=yes")

"""The transitions of route planning, as properties of random instances of every kind, checked against plain Python."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, layouts, play_randomly, random_legal, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import (
    InfeasibleScheduleError,
    Instances,
    RoutingProblem,
    Schedule,
    UniformGenerator,
    check_schedule,
    collected_value,
    nearest_feasible,
)
from sb3_uav.envs.routing import DEPOT, RoutingDynamics, RoutingState

# Ways of adding up the legs of a tour, whose results differ in the last bits.
SUMS: dict[str, Callable[[list[float]], float]] = {
    "forward": sum,
    "backward": lambda legs: sum(reversed(legs)),
    "ascending": lambda legs: sum(sorted(legs)),
    "exact": math.fsum,
    "pairwise": lambda legs: float(np.sum(np.array(legs))),
}


def legs(instances: Instances, row: int, route: list[int]) -> list[float]:
    """Lengths of the legs of a closed tour."""
    depot, tasks = instances.depot[row].tolist(), instances.tasks[row].tolist()
    stops = [depot, *(tasks[task] for task in route), depot]
    return [math.dist(a, b) for a, b in itertools.pairwise(stops)]


def follow(instances: Instances, route: list[int]) -> list[bool]:
    """Whether each step of a route (in a batch of one) is legal at its time."""
    dynamics = RoutingDynamics(instances)
    state = dynamics.reset()
    legal = []
    for task in route:
        legal.append(bool(state.action_mask[0, 0, task + 1]))
        state, _ = dynamics.step(state, th.tensor([[task + 1]]))
    return legal


@st.composite
def tours_at_the_limit(draw: st.DrawFn) -> tuple[Instances, list[int]]:
    """An instance whose D is about the length of a tour, added up in some order; and that tour."""
    n_tasks = draw(st.integers(1, 7))
    scale = draw(st.sampled_from([1.0, 1e-30, 1e-3, 1e6, 1e30]))
    points = scale * draw(layouts(n_tasks))
    route = draw(st.permutations(range(n_tasks)))[: draw(st.integers(1, n_tasks))]
    # On both sides of the tolerance, but not so close to it that rounding decides.
    factor = draw(st.sampled_from([1.0, 1.0, 1 - 1e-13, 1 + 1e-13, 1 - 9e-10, 1 - 1.1e-9, 1 - 1e-6, 1 + 1e-6, 0.7, 2.0]))
    instances = Instances.from_arrays(points[0], points[1:], max_distance=scale, n_uavs=1)
    length = SUMS[draw(st.sampled_from(sorted(SUMS)))](legs(instances, 0, route))
    limit = factor * length if length > 0 else draw(st.sampled_from([1e-9, 1.0])) * scale
    return replace(instances, max_distance=th.tensor([limit], dtype=th.float64)), route


@settings(max_examples=500)
@given(case=tours_at_the_limit())
def test_masks_and_checker_agree_at_the_limit(case: tuple[Instances, list[int]]) -> None:
    """The checker accepts a route exactly when the masks allow every step of it."""
    instances, route = case
    try:
        check_schedule(instances, 0, Schedule([route]))
    except InfeasibleScheduleError:
        assert not all(follow(instances, route))
    else:
        assert all(follow(instances, route))


@settings(max_examples=100)
@given(case=tours_at_the_limit(), order=st.sampled_from(sorted(SUMS)))
def test_a_tour_of_exactly_the_maximum_is_feasible(case: tuple[Instances, list[int]], order: str) -> None:
    """For the masks and the checker, in whatever order its length was added up."""
    instances, route = case
    length = SUMS[order](legs(instances, 0, route))
    if length > 0:
        instances = replace(instances, max_distance=th.tensor([length], dtype=th.float64))
    assert all(follow(instances, route))
    assert check_schedule(instances, 0, Schedule([route])).length == pytest.approx(length, rel=1e-12, abs=0)


@st.composite
def lattice_tours(draw: st.DrawFn) -> tuple[np.ndarray, list[int]]:
    """A depot and tasks on a lattice of any spacing and place, ``(n_tasks + 1, 2)``, and a tour of some of them."""
    n_tasks = draw(st.integers(1, 8))
    cells = st.tuples(st.integers(0, 6), st.integers(0, 6))
    points = np.array(draw(st.lists(cells, min_size=n_tasks + 1, max_size=n_tasks + 1)), dtype=float)
    spacing = draw(st.sampled_from([1.0, 0.1, 1 / 3, 7.0, 100.0, 1e-6]))
    offset = spacing * draw(st.sampled_from([0, 1, -3, 1000]))
    route = draw(st.permutations(range(n_tasks)))[: draw(st.integers(1, n_tasks))]
    return offset + spacing * points, route


@settings(max_examples=300)
@given(case=lattice_tours())
def test_lattice_tours_of_exactly_the_maximum_are_flyable(case: tuple[np.ndarray, list[int]]) -> None:
    """With D computed from the coordinates, also one unit in the last place less or more; 0.1 % less is too short."""
    points, route = case
    stops = points[[0, *(task + 1 for task in route), 0]]
    length = float(np.hypot(*np.diff(stops, axis=0).T).sum())
    if length == 0:
        return
    for limit in (length, np.nextafter(length, 0), np.nextafter(length, np.inf)):
        instances = Instances.from_arrays(points[0], points[1:], max_distance=limit, n_uavs=1)
        assert all(follow(instances, route))
        assert check_schedule(instances, 0, Schedule([route])).objective == len(route)
    short = Instances.from_arrays(points[0], points[1:], max_distance=0.999 * length, n_uavs=1)
    assert not all(follow(short, route))
    with pytest.raises(InfeasibleScheduleError, match="over its maximum"):
        check_schedule(short, 0, Schedule([route]))


def test_the_perimeter_of_a_lattice_square_is_flyable() -> None:
    """Twelve steps of 0.1, whose sum in floats differs from D = 1.2 in the last digits."""
    ring = [(0.1 * i, 0.0) for i in range(1, 4)] + [(0.3, 0.1 * i) for i in range(1, 4)]
    ring += [(0.1 * i, 0.3) for i in (2, 1, 0)] + [(0.0, 0.1 * i) for i in (2, 1)]
    instances = Instances.from_arrays([0, 0], ring, max_distance=1.2, n_uavs=1)
    assert all(follow(instances, list(range(11))))
    assert check_schedule(instances, 0, Schedule([range(11)])).objective == 11


@settings(max_examples=100)
@given(instances=instance_batches(), seed=seeds)
def test_every_accepted_tour_passes_the_checker(instances: Instances, seed: int) -> None:
    """Random legal tours of one UAV: the checker finds the length flown and the rewards collected."""
    dynamics = RoutingDynamics(instances)
    actions, rewards = play_randomly(dynamics, 2, np.random.default_rng(seed))
    state = dynamics.reset(2)
    for action in actions.unbind(-1):
        state, _ = dynamics.step(state, action)
    for row, sample in itertools.product(range(len(instances)), range(2)):
        tour = [node - 1 for node in actions[row, sample].tolist() if node != DEPOT]
        report = check_schedule(instances, row, Schedule([tour]))
        assert report.objective == pytest.approx(rewards[row, sample].sum().item(), rel=1e-12, abs=0)
        assert report.length == pytest.approx(state.traveled[row, sample].item(), rel=1e-12, abs=0)


@settings(max_examples=100)
@given(instances=instance_batches(max_tasks=6), seed=seeds)
def test_every_schedule_that_passes_the_checker_is_accepted(instances: Instances, seed: int) -> None:
    """Random routes, feasible or not: checker and masks agree on each."""
    rng = np.random.default_rng(seed)
    for row in range(len(instances)):
        real = int(instances.task_mask[row].sum())
        route = rng.permutation(real)[: rng.integers(1, real + 1)].tolist()
        try:
            check_schedule(instances, row, Schedule([route]))
        except InfeasibleScheduleError:
            assert not all(follow(instances[row], route))
        else:
            assert all(follow(instances[row], route))


@settings(max_examples=80)
@given(instances=instance_batches(), seed=seeds)
def test_mask_is_its_definition(instances: Instances, seed: int) -> None:
    """For each task, in plain Python: real, unvisited, and there and back within D; the depot if no task is legal."""
    rng = np.random.default_rng(seed)
    dynamics = RoutingDynamics(instances)
    state = dynamics.reset(2)
    routes: dict[tuple[int, int], list[int]] = {}
    while not state.done.all():
        for row, sample in itertools.product(range(len(instances)), range(2)):
            route = routes.setdefault((row, sample), [])
            if not state.done[row, sample]:
                assert_mask(instances, row, route, state.action_mask[row, sample].tolist())
            else:
                assert state.action_mask[row, sample].tolist() == [True] + [False] * instances.n_tasks
        actions = random_legal(state.action_mask, rng)
        for (row, sample), route in routes.items():
            if actions[row, sample] != DEPOT:
                route.append(int(actions[row, sample]) - 1)
        state, _ = dynamics.step(state, actions)


def assert_mask(instances: Instances, row: int, route: list[int], mask: list[bool]) -> None:
    """Compare a mask with the definition, except where rounding decides."""
    limit = instances.max_distance[row].item() * (1 + 1e-9)
    for task in range(instances.n_tasks):
        length = math.fsum(legs(instances, row, [*route, task]))
        if not instances.task_mask[row, task] or task in route:
            assert not mask[task + 1]
        elif abs(length - limit) > 1e-12 * limit:
            assert mask[task + 1] == (length < limit)
    assert mask[DEPOT] == (not any(mask[1:]))


@settings(max_examples=80)
@given(instances=instance_batches(), seed=seeds, lawful_steps=st.integers(0, 4), forbidden=st.integers(0, 1000))
def test_illegal_action_flies_home(instances: Instances, seed: int, lawful_steps: int, forbidden: int) -> None:
    """From anywhere, within D and without a reward, which ends the episode."""
    rng = np.random.default_rng(seed)
    dynamics = RoutingDynamics(instances[:1])
    state = dynamics.reset()
    for _ in range(lawful_steps):
        state, _ = dynamics.step(state, random_legal(state.action_mask, rng))
    illegal = (~state.action_mask[0, 0]).nonzero()[:, 0]
    assert len(illegal) > 0
    new, reward = dynamics.step(state, illegal[forbidden % len(illegal)].view(1, 1))
    position = int(state.position)
    way_home = dynamics.home[0, position].item()
    assert new.done.item() and new.position.item() == DEPOT and reward.item() == 0
    assert new.traveled.item() == state.traveled.item() + way_home
    assert new.traveled.item() <= instances.max_distance[0].item() * (1 + 1e-9)
    assert th.equal(new.visited, state.visited)


def test_one_tour_by_hand() -> None:
    """Tasks at 1, 2 and 3 on a line and one at the depot; D = 4 leaves the farthest out, D = 6 does not."""
    tasks = [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [0.0, 0.0]]
    near, far = (Instances.from_arrays([0, 0], tasks, values=[1, 2, 4, 8], max_distance=D) for D in (4.0, 6.0))

    def masks(instances: Instances, nodes: list[int]) -> tuple[list[list[int]], RoutingState]:
        dynamics = RoutingDynamics(instances)
        state = dynamics.reset()
        found = [state.action_mask[0, 0].int().tolist()]
        for node in nodes:
            state, _ = dynamics.step(state, th.tensor([[node]]))
            found.append(state.action_mask[0, 0].int().tolist())
        return found, state

    found, state = masks(near, [2, 1, 4, 0])
    assert found == [[0, 1, 1, 0, 1], [0, 1, 0, 0, 1], [0, 0, 0, 0, 1], [1, 0, 0, 0, 0], [1, 0, 0, 0, 0]]
    assert state.done.item() and state.traveled.item() == 4.0
    found, state = masks(far, [3, 2, 1, 4])
    assert found == [[0, 1, 1, 1, 1], [0, 1, 1, 0, 1], [0, 1, 0, 0, 1], [0, 0, 0, 0, 1], [1, 0, 0, 0, 0]]
    assert not state.done.item() and state.traveled.item() == 6.0
    problem = RoutingProblem(UniformGenerator(4))
    assert problem.returns(far, th.tensor([[[3, 2, 1, 4, 0], [2, 0, 0, 0, 0]]])).tolist() == [[15.0, 2.0]]


@settings(max_examples=60)
@given(instances=instance_batches())
def test_reachable_tasks_are_the_first_mask(instances: Instances) -> None:
    assert th.equal(instances.reachable(), RoutingDynamics(instances).reset().action_mask[:, 0, 1:])


@settings(max_examples=60)
@given(instances=instance_batches())
def test_nearest_feasible_is_its_definition(instances: Instances) -> None:
    """A legal tour that goes to the nearest legal task at every step, and to the depot only at the end."""
    tours = nearest_feasible(instances)
    dynamics = RoutingDynamics(instances)
    state = dynamics.reset()
    for action in tours.unbind(-1):
        mask, position = state.action_mask[:, 0], state.position[:, 0]
        assert mask.gather(-1, action[:, None]).all()
        for row in range(len(instances)):
            here = dynamics.nodes[row, position[row]].tolist()
            away = [math.dist(here, node) for node in dynamics.nodes[row].tolist()]
            nearest = min(distance for distance, legal in zip(away, mask[row].tolist(), strict=True) if legal)
            assert away[action[row]] == pytest.approx(nearest, rel=1e-12, abs=0)
        state, _ = dynamics.step(state, action[:, None])
    assert state.done.all()


@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds)
def test_collected_value_is_the_sum_of_rewards(instances: Instances, seed: int) -> None:
    """With and without a samples axis."""
    actions, rewards = play_randomly(RoutingDynamics(instances), 3, np.random.default_rng(seed))
    assert th.allclose(collected_value(instances, actions), rewards.sum(-1), rtol=1e-12, atol=0)
    assert th.equal(collected_value(instances, actions[:, 0]), collected_value(instances, actions)[:, 0])

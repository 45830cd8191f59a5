"""The transitions of both levels, as properties of random instances of every kind, checked against plain Python."""

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
    AllocationProblem,
    InfeasibleScheduleError,
    Instances,
    Router,
    RoutingProblem,
    Schedule,
    UniformGenerator,
    check_schedule,
    collected_value,
    nearest_feasible,
    plan_tours,
    schedules,
    split_tasks,
)
from sb3_uav.envs.allocation import UNASSIGNED, AllocationDynamics
from sb3_uav.envs.episodes import Episodes
from sb3_uav.envs.problem import Dynamics, Problem
from sb3_uav.envs.routing import DEPOT, RoutingDynamics, RoutingState

# Ways of adding up the legs of a tour, which differ in their last bits.
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
    """Whether each step of a route (in a batch of one) is legal when it comes."""
    dynamics = RoutingDynamics(instances)
    state = dynamics.reset()
    legal = []
    for task in route:
        legal.append(bool(state.action_mask[0, 0, task + 1]))
        state, _ = dynamics.step(state, th.tensor([[task + 1]]))
    return legal


def random_router(generator: np.random.Generator) -> Router:
    """Flies to any task that still fits."""
    return lambda instances: play_randomly(RoutingDynamics(instances), 1, generator)[0][:, 0]


def dynamics_of(level: str, instances: Instances) -> Dynamics:
    return RoutingDynamics(instances) if level == "routing" else AllocationDynamics(instances, nearest_feasible)


def problem_of(level: str, instances: Instances) -> Problem:
    """A problem of the size of the instances."""
    generator = UniformGenerator(instances.n_tasks, instances.n_uavs)
    return RoutingProblem(generator) if level == "routing" else AllocationProblem(generator)


both_levels = pytest.mark.parametrize("level", ["routing", "allocation"])


# Both levels


@both_levels
@settings(max_examples=100)
@given(instances=instance_batches(), seed=seeds, recklessness=st.sampled_from([0.0, 0.1, 1.0]))
def test_some_action_is_always_legal(level: str, instances: Instances, seed: int, recklessness: float) -> None:
    """In every state that any actions lead to, and every episode ends in time."""
    rng = np.random.default_rng(seed)
    dynamics = dynamics_of(level, instances)
    state = dynamics.reset(2)
    for _ in range(instances.n_tasks + 1):
        assert state.action_mask.any(-1).all()
        n_actions = state.action_mask.shape[-1]
        careless = th.from_numpy(rng.random(state.done.shape) < recklessness)
        anything = th.from_numpy(rng.integers(0, n_actions, state.done.shape))
        state, _ = dynamics.step(state, anything.where(careless, random_legal(state.action_mask, rng)))
    assert state.done.all() and state.action_mask.any(-1).all()


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds)
def test_finished_episodes_stay_as_they_are(level: str, instances: Instances, seed: int) -> None:
    """Whatever the action, however they ended, while other episodes of the batch go on; and without a reward."""
    rng = np.random.default_rng(seed)
    dynamics = dynamics_of(level, instances)
    state = dynamics.reset(3)
    for _ in range(instances.n_tasks + 3):
        done = state.done
        legal = random_legal(state.action_mask, rng)
        anything = th.from_numpy(rng.integers(0, state.action_mask.shape[-1], done.shape))
        careless = th.from_numpy(rng.random(done.shape) < 0.2)
        new, rewards = dynamics.step(state, anything.where(done | careless, legal))
        for name, before, after in zip(type(state)._fields, state, new, strict=True):
            assert th.equal(before[done], after[done]), name
        assert (rewards[done] == 0).all()
        state = new
    assert state.done.all()


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 4))
def test_samples_are_separate_episodes(level: str, instances: Instances, seed: int, n_samples: int) -> None:
    """S samples of B instances in one state go, bit by bit, as B times S batches of one."""
    actions, rewards = play_randomly(dynamics_of(level, instances), n_samples, np.random.default_rng(seed))
    dynamics = dynamics_of(level, instances)
    together = [dynamics.reset(n_samples)]
    for action in actions.unbind(-1):
        together.append(dynamics.step(together[-1], action)[0])
    for row, sample in itertools.product(range(len(instances)), range(n_samples)):
        alone = dynamics_of(level, instances[row])
        state = alone.reset()
        for step, both in enumerate(together):
            for name, single, batched in zip(type(state)._fields, state, both, strict=True):
                assert th.equal(single[0, 0], batched[row, sample]), (name, step)
            if step < actions.shape[-1]:
                state, reward = alone.step(state, actions[row : row + 1, sample : sample + 1, step])
                assert reward.item() == rewards[row, sample, step]


@both_levels
@settings(max_examples=20)
@given(instances=instance_batches(), seed=seeds)
def test_step_does_not_modify_the_state(level: str, instances: Instances, seed: int) -> None:
    rng = np.random.default_rng(seed)
    dynamics = dynamics_of(level, instances)
    state = dynamics.reset(2)
    while not state.done.all():
        before = [field.clone() for field in state]
        new, _ = dynamics.step(state, random_legal(state.action_mask, rng))
        assert all(th.equal(field, old) for field, old in zip(state, before, strict=True))
        state = new


@both_levels
@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds)
def test_returns_rewards_and_lengths_of_whole_episodes(level: str, instances: Instances, seed: int) -> None:
    """What a problem says of complete episodes is what the steps gave."""
    problem = problem_of(level, instances)
    # Allocations name a UAV for padded tasks too.
    n_steps = instances.n_tasks if level == "allocation" else 1
    actions, rewards = play_randomly(problem.dynamics(instances), 3, np.random.default_rng(seed), n_steps)
    returns = problem.returns(instances, actions)
    assert returns.dtype == th.float64 and returns.shape == actions.shape[:2]
    assert th.allclose(returns, rewards.sum(-1), rtol=1e-12, atol=0)
    step_rewards = problem.step_rewards(instances, actions, returns)
    assert th.allclose(step_rewards, rewards, rtol=1e-12, atol=0)
    lengths = problem.lengths(instances, actions)
    assert lengths.shape == actions.shape[:2] and lengths.dtype == th.int64
    for row, sample in itertools.product(range(len(instances)), range(3)):
        assert lengths[row, sample] == steps_until_done(problem, instances[row], actions[row, sample].tolist())


def steps_until_done(problem: Problem, instance: Instances, actions: list[int]) -> int:
    """As an environment counts them."""
    episodes = Episodes(problem, 1)
    episodes.reset(given={0: instance})
    for n_steps, action in enumerate(actions, start=1):
        if episodes.step(np.array([action])).dones[0]:
            return n_steps
    raise AssertionError("The episode did not end.")


@both_levels
def test_instance_without_any_task(level: str, small: Instances) -> None:
    """A row of padding only, as a UAV without tasks is: one step of nothing."""
    instances = replace(small, task_mask=th.zeros_like(small.task_mask))
    problem = problem_of(level, instances)
    state = problem.dynamics(instances).reset()
    assert state.action_mask.any(-1).all()
    actions, rewards = play_randomly(problem.dynamics(instances), 1, np.random.default_rng(0), instances.n_tasks)
    returns = problem.returns(instances, actions)
    assert returns.tolist() == [[0.0]] * 3 and rewards.sum() == 0
    assert problem.lengths(instances, actions).tolist() == [[1]] * 3
    assert problem.step_rewards(instances, actions, returns).tolist() == rewards.tolist()
    assert steps_until_done(problem, instances[0], actions[0, 0].tolist()) == 1


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(), seed=seeds, exponent=st.integers(-60, 60))
def test_unit_of_length_does_not_matter(level: str, instances: Instances, seed: int, exponent: int) -> None:
    """Coordinates and D times a power of two, which rounds nothing: every mask and every reward stays."""
    factor = 2.0**exponent
    scaled = replace(
        instances,
        depot=instances.depot * factor,
        tasks=instances.tasks * factor,
        max_distance=instances.max_distance * factor,
    )
    actions, rewards = play_randomly(dynamics_of(level, instances), 2, np.random.default_rng(seed))
    one, other = dynamics_of(level, instances), dynamics_of(level, scaled)
    state, state_scaled = one.reset(2), other.reset(2)
    for step in range(actions.shape[-1]):
        assert th.equal(state.action_mask, state_scaled.action_mask)
        state, _ = one.step(state, actions[..., step])
        state_scaled, reward = other.step(state_scaled, actions[..., step])
        assert th.equal(reward, rewards[..., step])


@both_levels
@settings(max_examples=30)
@given(instances=instance_batches(), seed=seeds, extra=st.integers(1, 4))
def test_padding_changes_nothing(level: str, instances: Instances, seed: int, extra: int) -> None:
    """The same actions earn the same rewards at the same steps, and no padded task is ever legal."""
    padded = instances.pad(instances.n_tasks + extra)
    actions, rewards = play_randomly(dynamics_of(level, instances), 2, np.random.default_rng(seed))
    dynamics = dynamics_of(level, padded)
    state = dynamics.reset(2)
    for step in range(actions.shape[-1]):
        assert state.action_mask.gather(-1, actions[..., step, None])[~state.done].all()
        if level == "routing":
            assert not state.action_mask[..., instances.n_tasks + 1 :].any()
        state, reward = dynamics.step(state, actions[..., step])
        assert th.equal(reward, rewards[..., step])
    assert state.done.all()


# Routing: feasibility


@st.composite
def tours_at_the_limit(draw: st.DrawFn) -> tuple[Instances, list[int]]:
    """An instance whose D is the length of a tour, added up in some order, or a little beside it; and that tour."""
    n_tasks = draw(st.integers(1, 7))
    scale = draw(st.sampled_from([1.0, 1e-30, 1e-3, 1e6, 1e30]))
    points = scale * draw(layouts(n_tasks))
    route = draw(st.permutations(range(n_tasks)))[: draw(st.integers(1, n_tasks))]
    # One part in a billion is the tolerance, 1e-9 itself the border where rounding decides.
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
        assert report.length == pytest.approx(state.travelled[row, sample].item(), rel=1e-12, abs=0)


@settings(max_examples=100)
@given(instances=instance_batches(max_tasks=6), seed=seeds)
def test_every_schedule_that_passes_the_checker_is_accepted(instances: Instances, seed: int) -> None:
    """Random routes of all UAVs, feasible or not: checker and masks say the same of each."""
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
    """Task by task, in plain Python: real, unvisited, and there and home again within D; the depot if no task is."""
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
    """A mask against the definition, where D is not so near that rounding decides."""
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
    """From wherever the UAV is, within D, for no reward; so ends the episode."""
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
    assert new.travelled.item() == state.travelled.item() + way_home
    assert new.travelled.item() <= instances.max_distance[0].item() * (1 + 1e-9)
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
    assert state.done.item() and state.travelled.item() == 4.0
    found, state = masks(far, [3, 2, 1, 4])
    assert found == [[0, 1, 1, 1, 1], [0, 1, 1, 0, 1], [0, 1, 0, 0, 1], [0, 0, 0, 0, 1], [1, 0, 0, 0, 0]]
    assert not state.done.item() and state.travelled.item() == 6.0
    problem = RoutingProblem(UniformGenerator(4))
    assert problem.returns(far, th.tensor([[[3, 2, 1, 4, 0], [2, 0, 0, 0, 0]]])).tolist() == [[15.0, 2.0]]


@settings(max_examples=60)
@given(instances=instance_batches())
def test_reachable_tasks_are_the_first_mask(instances: Instances) -> None:
    assert th.equal(instances.reachable(), RoutingDynamics(instances).reset().action_mask[:, 0, 1:])


@settings(max_examples=60)
@given(instances=instance_batches())
def test_nearest_feasible_is_its_definition(instances: Instances) -> None:
    """A legal tour, that goes to the nearest legal task at every step and home only at the end."""
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


# Allocation


@settings(max_examples=80)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 3), partial=st.booleans())
def test_split_gives_every_task_to_one_uav(instances: Instances, seed: int, n_samples: int, partial: bool) -> None:
    """Each UAV's tasks, in their order, at the front of its row, with the data of the original; then padding."""
    rng = np.random.default_rng(seed)
    low = UNASSIGNED if partial else 0
    assignment = th.from_numpy(rng.integers(low, instances.n_uavs, (len(instances), n_samples, instances.n_tasks)))
    subsets = split_tasks(instances, assignment)
    subsets.instances.validate()
    assert len(subsets.instances) == len(subsets.task_index) == len(instances) * n_samples * instances.n_uavs
    assert subsets.instances.n_uavs == 1
    sizes = []
    for i, (row, sample, uav) in enumerate(
        itertools.product(range(len(instances)), range(n_samples), range(instances.n_uavs))
    ):
        real = int(instances.task_mask[row].sum())
        expected = [task for task in range(real) if assignment[row, sample, task] == uav]
        sizes.append(len(expected))
        assert subsets.task_index[i][subsets.instances.task_mask[i]].tolist() == expected
        assert subsets.instances.task_mask[i].sum() == len(expected)
        assert th.equal(subsets.instances.tasks[i, : len(expected)], instances.tasks[row, expected])
        assert th.equal(subsets.instances.values[i, : len(expected)], instances.values[row, expected])
        assert th.equal(subsets.instances.depot[i], instances.depot[row])
        assert subsets.instances.max_distance[i] == instances.max_distance[row]
    assert subsets.instances.n_tasks == max(*sizes, 1)


@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds, n_samples=st.integers(1, 3), greedy=st.booleans())
def test_planned_tours_pass_the_checker(instances: Instances, seed: int, n_samples: int, greedy: bool) -> None:
    """Their value is the checker's objective, and every UAV visits tasks of its own only."""
    rng = np.random.default_rng(seed)
    assignment = th.from_numpy(rng.integers(0, instances.n_uavs, (len(instances), n_samples, instances.n_tasks)))
    planned = plan_tours(instances, assignment, nearest_feasible if greedy else random_router(rng))
    assert planned.tours.shape[:3] == (len(instances), n_samples, instances.n_uavs)
    assert planned.value.shape == (len(instances), n_samples) and planned.value.dtype == th.float64
    for sample in range(n_samples):
        for row, schedule in enumerate(schedules(planned.tours[:, sample])):
            report = check_schedule(instances, row, schedule)
            assert report.objective == pytest.approx(planned.value[row, sample].item(), rel=1e-12, abs=0)
            for uav, route in enumerate(schedule.routes):
                assert {assignment[row, sample, task].item() for task in route} <= {uav}


@settings(max_examples=60)
@given(instances=instance_batches(), seed=seeds)
def test_allocation_rewards_only_the_end(instances: Instances, seed: int) -> None:
    """Tasks in input order, one a step; the value of the router's tours when the last real one has a UAV."""
    rng = np.random.default_rng(seed)
    dynamics = AllocationDynamics(instances, nearest_feasible)
    state = dynamics.reset(2)
    n_real = instances.task_mask.sum(1)[:, None].expand(-1, 2)
    assignment = th.full((len(instances), 2, instances.n_tasks), UNASSIGNED)
    for step in range(instances.n_tasks):
        assert th.equal(state.assignment, assignment)
        assert th.equal(state.task, n_real.clamp(max=step)) and th.equal(state.done, n_real <= step)
        assert state.action_mask.all()
        actions = random_legal(state.action_mask, rng)
        assignment[..., step] = actions.where(step < n_real, UNASSIGNED)
        state, rewards = dynamics.step(state, actions)
        value = plan_tours(instances, assignment, nearest_feasible).value
        assert th.equal(rewards, value.where(n_real == step + 1, 0.0))
    assert state.done.all()


@pytest.mark.parametrize("n_uavs", [1, 2, 3, 5, 20])
def test_more_uavs_than_tasks(n_uavs: int) -> None:
    """Idle UAVs fly nowhere; with a UAV each, all reachable tasks are visited."""
    instances = UniformGenerator(n_tasks=3, n_uavs=n_uavs, max_distance=9.0)(4, np.random.default_rng(0))
    assignment = (th.arange(3) % n_uavs).expand(4, 1, 3)
    planned = plan_tours(instances, assignment, nearest_feasible)
    assert planned.value.tolist() == [[3.0]] * 4
    for schedule in schedules(planned.tours[:, 0]):
        assert [len(route) for route in schedule.routes] == [len(range(uav, 3, n_uavs)) for uav in range(n_uavs)]


def test_distance_too_short_for_anything() -> None:
    """The one legal action is to stay at home, and the value is 0."""
    instances = Instances.from_arrays([0, 0], [[1, 0], [0, 1]], max_distance=1.0, n_uavs=2)
    assert nearest_feasible(instances).tolist() == [[DEPOT]]
    planned = plan_tours(instances, th.tensor([[[0, 1]]]), nearest_feasible)
    assert planned.value.tolist() == [[0.0]] and schedules(planned.tours[:, 0]) == [Schedule([[], []])]

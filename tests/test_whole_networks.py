"""Networks with ``whole`` on the whole problem: both drivers agree, nothing but the problem matters, old networks refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import seeds, whole_batches
from driver_helpers import make_env, make_policy, near_unit, play_vectorized, sample
from hypothesis import given, settings
from hypothesis import strategies as st
from policy_helpers import make_policy as make_plain_policy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_uav.envs import FixedGenerator, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, check_schedule
from sb3_uav.envs.allocation import allowed_uavs, plan_tours, schedules
from sb3_uav.envs.problem import WHOLE_KEYS
from sb3_uav.envs.sweep import sweep_order
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.policies.fleet_geometry import FleetFeature, FleetGeometry
from sb3_uav.policies.geometry import FAR_SCALE
from sb3_uav.policies.move_geometry import MoveFeature, MoveGeometry
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.world import World
from sb3_uav.solvers.dl_drl import DLDRL
from sb3_uav.solvers.kmeans_am import KMeansAM
from sb3_uav.studies.compare.fixed_router import _DividedSubsets

levels = pytest.mark.parametrize("level", ["allocator", "router"])


def beyond(instances: Instances) -> bool:
    return bool(instances.beyond_the_paper)


def fleet(n: int = 6, n_tasks: int = 9, n_uavs: int = 3, seed: int = 0) -> Instances:
    """Instances in which everything differs."""
    rng = np.random.default_rng(seed)
    plain = UniformGenerator(n_tasks, n_uavs)(n, rng)
    return Instances.from_arrays(
        plain.depot,
        plain.tasks,
        values=rng.integers(1, 100, (n, n_tasks)),
        max_distance=rng.uniform(0.8, 2.0, (n, n_uavs)),
        n_uavs=n_uavs,
        start=rng.random((n, n_uavs, 2)),
        end=rng.random((n, n_uavs, 2)),
        service=0.1 * rng.random((n, n_tasks)),
    )


@levels
@settings(max_examples=50)
@given(instances=whole_batches().filter(beyond).map(near_unit), n_samples=st.integers(1, 2), seed=seeds)
def test_fused_evaluation_equals_the_step_loop(level: str, instances: Instances, n_samples: int, seed: int) -> None:
    if level == "router":
        instances = instances.with_fleet(1)
        if not beyond(instances):
            return
    policy = make_policy(level, "whole", instances.n_tasks, instances.n_uavs, True)
    actions = sample(policy, instances, n_samples, seed)
    evaluation = policy.evaluate_episodes(instances, actions)

    def compare(step: int, observation: dict[str, np.ndarray], running: np.ndarray) -> None:
        tensor: Any = obs_as_tensor(observation, th.device("cpu"))
        with th.no_grad():
            _, log_prob, _ = policy.evaluate_actions(tensor, actions[..., step].flatten().clamp(min=0))
        fused = evaluation.log_prob[..., step].flatten()
        th.testing.assert_close(fused[running], log_prob[running], atol=1e-4, rtol=1e-4)

    found = play_vectorized(level, instances, actions, compare)
    expected = make_env(level, instances).problem.returns(instances, actions)
    assert found[0] == pytest.approx(expected.numpy(), rel=1e-9, abs=0)


@settings(max_examples=30)
@given(instances=whole_batches(max_tasks=6), seed=seeds)
def test_every_schedule_of_the_pair_is_feasible(instances: Instances, seed: int) -> None:
    allocator, router = (make_policy(level, "whole", 4, 1) for level in ("allocator", "router"))
    for decode in ("greedy", "augment"):
        solver = DLDRL(allocator, router, decode, samples=16)  # type: ignore[arg-type]
        for row, result in enumerate(solver.solve(instances, seed=seed)):
            check_schedule(instances, row, result.schedule)


@settings(max_examples=20)
@given(instances=whole_batches(max_tasks=6))
def test_kmeans_with_a_router_that_sees_the_whole_problem(instances: Instances) -> None:
    solver = KMeansAM(make_policy("router", "whole", 4, 1))  # type: ignore[arg-type]
    for row, result in enumerate(solver.solve(instances)):
        check_schedule(instances, row, result.schedule)


def routes_of(instances: Instances) -> list[Any]:
    allocator: Any = make_policy("allocator", "whole", 9, 3)
    router: Any = make_policy("router", "whole", 9, 3)
    shown = instances.reorder(allocator.task_order(instances))
    order = allocator.task_order(instances)
    planned = plan_tours(shown, allocator.decode_episodes(shown), router.plan)
    names = order.tolist()
    return [
        [[names[row][task] for task in route] for route in schedule.routes]
        for row, schedule in enumerate(schedules(planned.tours[:, 0]))
    ]


@pytest.mark.parametrize("change", ["moved", "scaled", "worth more"])
def test_units_do_not_matter(change: str) -> None:
    instances = fleet()
    if change == "moved":
        changed = replace(instances.map_points(lambda points: points + 5.0), depot=instances.depot + 5.0)
    elif change == "scaled":
        assert instances.service is not None
        changed = replace(
            instances.map_points(lambda points: 4 * points),
            depot=4 * instances.depot,
            max_distance=4 * instances.max_distance,
            service=4 * instances.service,
        )
    else:
        changed = replace(instances, values=8 * instances.values)
    assert routes_of(changed) == routes_of(instances)


def test_the_order_of_tasks_and_uavs_does_not_matter() -> None:
    instances = fleet()
    expected = routes_of(instances)
    tasks = th.tensor([3, 1, 4, 0, 5, 8, 2, 6, 7])
    shuffled = routes_of(instances.reorder(tasks.expand(len(instances), -1)))
    assert [[[tasks[task].item() for task in route] for route in routes] for routes in shuffled] == expected
    uavs = [2, 0, 1]
    assert instances.start is not None and instances.end is not None
    other = replace(
        instances, start=instances.start[:, uavs], end=instances.end[:, uavs], max_distance=instances.max_distance[:, uavs]
    )
    assert [[routes[uav] for uav in (1, 2, 0)] for routes in routes_of(other)] == expected


@levels
def test_every_field_matters(level: str) -> None:
    """Changing any of them changes the probabilities."""
    instances = fleet()
    policy = make_policy(level, "whole", 9, 3 if level == "allocator" else 1, True)
    shown = instances if level == "allocator" else instances.with_fleet(1)
    actions = sample(policy, shown, 1, 0)
    before = policy.evaluate_episodes(shown, actions).log_prob[..., 0]
    assert shown.start is not None and shown.end is not None and shown.service is not None
    changes: dict[str, Any] = {
        "start": 0.9 * shown.start,
        "end": 0.9 * shown.end,
        "service": 0.5 * shown.service,
        "values": shown.values.flip(1),
    }
    if shown.max_distance.dim() == 2:
        changes["max_distance"] = shown.max_distance * th.tensor([1.0, 1.1, 0.9], dtype=th.float64)
    for name, changed in changes.items():
        after = policy.evaluate_episodes(replace(shown, **{name: changed}), actions).log_prob[..., 0]
        assert (after - before).abs().max() > 1e-4, name


@levels
def test_padding_does_not_matter(level: str) -> None:
    instances = fleet() if level == "allocator" else fleet().with_fleet(1)
    policy = make_policy(level, "whole", 9, instances.n_uavs, True)
    actions = sample(policy, instances, 2, 1)
    padded = instances.pad(12)
    more = th.nn.functional.pad(actions, (0, 12 - actions.shape[2]), value=-1) if level == "allocator" else actions
    found = policy.evaluate_episodes(padded, more).log_prob[..., : actions.shape[2]]
    th.testing.assert_close(found, policy.evaluate_episodes(instances, actions).log_prob, atol=1e-5, rtol=0)


@levels
def test_networks_of_the_paper_refuse_the_rest(level: str) -> None:
    instances = fleet() if level == "allocator" else fleet().with_fleet(1)
    for preset in ("default", "paper"):
        policy = make_plain_policy(level, preset=preset)
        with pytest.raises(ValueError, match=r"sees only the paper's problem, but the instances have .*start.*preset='whole'"):
            policy.decode_episodes(instances)
        if isinstance(policy, AllocatorPolicy):
            with pytest.raises(ValueError, match="sees only the paper's problem"):
                policy.encode_nodes(instances)
        env = make_env(level, instances)
        with pytest.raises(ValueError, match="would not see; use preset='whole'"):
            type(policy)(env.observation_space, env.action_space, lambda _: 0.0, preset=preset)


def test_a_pair_that_sees_only_the_paper_is_refused_by_the_solver() -> None:
    solver = DLDRL(make_plain_policy("allocator"), make_plain_policy("router"))
    with pytest.raises(ValueError, match=r"solves only instances whose UAVs all fly equally far.*dl-drl:allocator=world"):
        solver.solve(fleet())


def test_observations_show_the_whole_problem_where_there_is_more() -> None:
    instances = fleet(1)
    for env in (TaskAllocationEnv(instances=instances), RoutePlanningEnv(instances=instances)):
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        n_uavs = 3 if isinstance(env, TaskAllocationEnv) else 1
        assert observation["uav_start"].reshape(-1, 2).tolist() == instances.uav_start[0, :n_uavs].float().tolist()
        assert observation["service"].tolist() == instances.service_cost[0].float().tolist()
    assert not set(WHOLE_KEYS) & set(TaskAllocationEnv(5, 2).problem.observation_space.spaces)
    with pytest.raises(ValueError, match=r"The instance has max_distance per UAV, start, .*observations.*do not show"):
        TaskAllocationEnv(9, 3).reset(options={"instance": instances})


def test_whole_needs_its_ingredients() -> None:
    with pytest.raises(ValueError, match="whole=True needs geometry=True"):
        make_plain_policy("router", preset="whole", geometry=False)


@pytest.mark.parametrize("env_class", [TaskAllocationEnv, RoutePlanningEnv])
def test_a_later_generator_may_be_of_the_papers_problem(env_class: Any) -> None:
    """The observation stays what the space says."""
    env = env_class(instances=fleet(1))
    env.problem.set_generator(UniformGenerator(9, 3))
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    env.problem.set_generator(FixedGenerator(fleet(1)))
    assert env.reset(seed=0)[0] in env.observation_space


@levels
@pytest.mark.parametrize("change", ["range", "far end", "far start"])
def test_logits_are_finite_whatever_a_fleet_is_like(level: str, change: str) -> None:
    """The first UAV cannot fly, or another one is out of this world; both drivers."""
    instances = fleet(4)
    if change == "range":
        ranges = instances.max_distance.clone()
        ranges[:, 0] = 0.0
        instances = replace(instances, max_distance=ranges)
    else:
        name = change.split()[1]
        sites = getattr(instances, name).clone()
        sites[:, 0 if level == "router" else 1] *= 1e25
        instances = replace(instances, **{name: sites})
    env = (TaskAllocationEnv if level == "allocator" else RoutePlanningEnv)(generator=FixedGenerator(instances))
    if level == "router":
        instances = instances.with_fleet(1)
    policy = make_policy(level, "whole", instances.n_tasks, instances.n_uavs, True)
    evaluation = policy.evaluate_episodes(instances, sample(policy, instances, 2, 0))
    assert evaluation.log_prob.isfinite().all()
    tensor: Any = obs_as_tensor({key: value[None] for key, value in env.reset(seed=0)[0].items()}, th.device("cpu"))
    with th.no_grad():
        assert not policy.masked_logits(tensor).isnan().any()


def test_the_router_of_a_comparison_learns_the_whole_problem() -> None:
    env = RoutePlanningEnv(generator=_DividedSubsets(FixedGenerator(fleet())))
    assert env.reset(seed=0)[0] in env.observation_space and env.problem.is_whole


# ---------------------------------------------------------------------------------------------------------------- by hand


def two_uavs() -> Instances:
    """One flies from 10 to 14 and 8 far, the other from 10 to 10 and 4 far; the depot is elsewhere."""
    return Instances.from_arrays(
        [0, 0], [[12, 0], [11, 0], [8, 0], [99, 0]], None, [8, 4], 2, start=[[10, 0], [10, 0]], end=[[14, 0], [10, 0]]
    )


def test_a_uav_gets_no_task_that_it_cannot_serve() -> None:
    """Unless none can, because somebody has to get it."""
    allowed = allowed_uavs(two_uavs())
    assert allowed is not None and allowed[0].tolist() == [[True, True], [True, True], [True, True], [True, True]]
    short = allowed_uavs(replace(two_uavs(), max_distance=th.tensor([[8.0, 1.0]], dtype=th.float64)))
    assert short is not None and short[0].tolist() == [[True, False], [True, False], [True, False], [True, True]]


def test_tasks_are_swept_around_the_uavs() -> None:
    """Not around a depot that none of them flies to."""
    rng = np.random.default_rng(0)
    tasks, places = 10 + rng.random((12, 2)), np.full((2, 2), 10.5)
    apart = Instances.from_arrays([0, 0], tasks, n_uavs=2, start=places, end=places)
    assert sweep_order(apart).tolist() == sweep_order(Instances.from_arrays(places[0], tasks, n_uavs=2)).tolist()


def test_places_and_loads_of_uavs() -> None:
    """Relative to the mean of the ends, in units of the longest range; a fair share is as large as the range."""
    static = StaticObservation.from_instances(two_uavs())
    world = World.of(static)
    assert world.start[0].tolist() == [[-0.25, 0.0], [-0.25, 0.0]] and world.end[0].tolist() == [[0.25, 0.0], [-0.25, 0.0]]
    assert world.reach.tolist() == [[1.0, 0.5]]
    geometry = FleetGeometry.of(static, whole=True)
    features = geometry.features(geometry.initial(1, 2), th.zeros(1, 1, dtype=th.int64), th.full((1, 1, 4), -1))
    # A first task of four, for UAVs that have two thirds and one third of all range.
    assert features[0, 0, :, FleetFeature.LOAD].tolist() == pytest.approx([0.5 / (4 / 3), 0.5 / (2 / 3)])


def test_slack_of_a_move_is_what_is_left_after_service() -> None:
    """From the start at 10 over the task at 12, which costs 1, to the end at 14: 3 of 8 are left."""
    instance = Instances.from_arrays([0, 0], [[12, 0]], None, 8, 1, start=[[10, 0]], end=[[14, 0]], service=[1.0])
    geometry = MoveGeometry.of(StaticObservation.from_instances(instance), whole=True)
    zero, mask = th.zeros(1, 1, dtype=th.int64), th.tensor([[[False, True]]])
    features = geometry.features(zero, th.ones(1, 1), mask)
    assert float(features[0, 0, 1, MoveFeature.SLACK]) == pytest.approx(FAR_SCALE * 3 / 8)


def test_the_end_of_a_grounded_uav_moves_nothing() -> None:
    """Networks would see all tasks far away, in the same place."""
    ends = [[[14, 0], [10, 0]], [[14, 0], [9e3, 0]], [[9e3, 0], [10, 0]]]
    homes = [StaticObservation.from_instances(replace(two_uavs(), end=th.tensor([end]).double())).home for end in ends]
    assert [home.tolist() for home in homes] == [[[12.0, 0.0]], [[14.0, 0.0]], [[10.0, 0.0]]]

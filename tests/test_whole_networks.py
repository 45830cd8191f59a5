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

from sb3_uav.envs import Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, check_schedule
from sb3_uav.envs.allocation import plan_tours, schedules
from sb3_uav.envs.problem import WHOLE_KEYS
from sb3_uav.solvers.dl_drl import DLDRL
from sb3_uav.solvers.kmeans_am import KMeansAM

levels = pytest.mark.parametrize("level", ["allocator", "router"])


def beyond(instances: Instances) -> bool:
    return any(name != "must_serve" for name in instances.beyond_the_paper)


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
        env = make_env(level, instances)
        with pytest.raises(ValueError, match="would not see; use preset='whole'"):
            type(policy)(env.observation_space, env.action_space, lambda _: 0.0, preset=preset)


def test_a_pair_that_sees_only_the_paper_is_refused_by_the_solver() -> None:
    solver = DLDRL(make_plain_policy("allocator"), make_plain_policy("router"))
    with pytest.raises(ValueError, match="solves only instances whose UAVs all fly equally far"):
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

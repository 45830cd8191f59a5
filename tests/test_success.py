"""`is_success`: every task that can count is visited, by the same definition wherever episodes are played."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.routing import nearest_feasible
from sb3_uav.reinforce import REINFORCE

NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
# From the depot in the origin, with D = 2: two tasks in one direction, one in the other, and one out of reach.
TASKS = [[0.4, 0.0], [0.9, 0.0], [-0.9, 0.0], [0.0, 1.1]]


def instance(values: Any = None, n_tasks: int = 4) -> Instances:
    given = None if values is None else [values[:n_tasks]]
    return Instances.from_arrays([[0.0, 0.0]], [TASKS[:n_tasks]], given, max_distance=2.0, n_uavs=2)


def last_info(env: ProblemEnv, batch: Instances, actions: list[int]) -> dict[str, Any]:
    env.reset(options={"instance": batch})
    infos = [env.step(action)[2:] for action in actions]
    assert [info[0] for info in infos] == [False] * (len(actions) - 1) + [True]
    assert all("is_success" not in info[2] for info in infos[:-1])
    return infos[-1][2]


@pytest.mark.parametrize(
    ("values", "actions", "expected"),
    [
        # Each UAV in its direction; the last task cannot be reached by any.
        (None, [0, 0, 1, 1], True),
        # One UAV cannot fly in both directions.
        (None, [0, 0, 0, 1], False),
        # A task without a value does not count.
        ([1.0, 1.0, 0.0, 5.0], [0, 0, 0, 1], True),
        ([0.1, 0.2, 0.3, 5.0], [0, 0, 1, 1], True),
    ],
)
def test_allocations(values: Any, actions: list[int], expected: bool) -> None:
    assert last_info(TaskAllocationEnv(4, 2), instance(values), actions)["is_success"] is expected


@pytest.mark.parametrize(
    ("values", "actions", "expected"),
    [
        (None, [1, 2, 0], False),
        ([1.0, 2.0, 0.0, 1.0], [1, 2, 0], True),
        # The sum of the rewards is rounded in another order.
        ([0.1, 0.7, 0.0, 1.0], [1, 2, 0], True),
        ([1.0, 2.0, 0.0, 1.0], [2, 1, 0], True),
        ([1.0, 2.0, 0.0, 1.0], [0], False),
    ],
)
def test_tours(values: Any, actions: list[int], expected: bool) -> None:
    env = RoutePlanningEnv(4)
    if actions == [0]:
        # An illegal return ends the episode, and not with a success.
        env.reset(options={"instance": instance(values)})
        info = env.step(0)[4]
    else:
        info = last_info(env, instance(values), actions)
    assert info["is_success"] is expected


def test_nothing_to_visit_is_a_success() -> None:
    far = Instances.from_arrays([[0.0, 0.0]], [[[3.0, 0.0]]], max_distance=2.0, n_uavs=1)
    assert last_info(RoutePlanningEnv(1), far, [0])["is_success"] is True


def test_batched_rows_say_the_same_as_single_environments() -> None:
    """Some succeed with 4 tasks and D = 3; the rows end at different steps."""

    def play(vec_env: type) -> list[tuple[int, bool]]:
        env = vec_env([lambda: Monitor(RoutePlanningEnv(4, 3.0))] * 8)
        env.seed(0)
        env.reset()
        found = []
        for _ in range(12):
            masks = np.stack(env.env_method("action_masks"))
            _, _, dones, infos = env.step(masks.shape[1] - 1 - masks[:, ::-1].argmax(1))
            assert all(("is_success" in info) == done for info, done in zip(infos, dones, strict=True))
            found += [(row, info["is_success"]) for row, info in enumerate(infos) if dones[row]]
        return found

    batched = play(BatchedVecEnv)
    assert batched == play(DummyVecEnv) and {True, False} == {won for _, won in batched}


@pytest.mark.parametrize(("policy", "env_class"), [("AllocatorPolicy", TaskAllocationEnv), ("RouterPolicy", RoutePlanningEnv)])
def test_the_fused_driver_counts_successes(policy: str, env_class: Any) -> None:
    """With enough distance all episodes succeed, with little only some; in SB3's evaluation too."""
    rates = []
    for distance in (100.0, 1.2):
        env = BatchedVecEnv([lambda distance=distance: env_class(6, max_distance=distance)] * 4)  # type: ignore[misc]
        model = REINFORCE(policy, env, n_samples=2, policy_kwargs=NETWORK, seed=0, device="cpu")
        evaluation_env = BatchedVecEnv([lambda distance=distance: env_class(6, max_distance=distance)])  # type: ignore[misc]
        evaluation_env.seed(0)
        evaluation = EvalCallback(evaluation_env, n_eval_episodes=30, eval_freq=6, verbose=0)
        model.learn(1, callback=evaluation)
        assert model.ep_success_buffer is not None and len(model.ep_success_buffer) == 8
        rates.append((float(np.mean(model.ep_success_buffer)), float(np.mean(evaluation._is_success_buffer))))
    assert rates[0] == (1.0, 1.0) and 0 < min(rates[1]) <= max(rates[1]) < 1


def test_samples_are_judged_one_by_one() -> None:
    problem = TaskAllocationEnv(4, 2).problem
    batch = Instances.concatenate([instance(), instance([1.0, 1.0, 0.0, 5.0])])
    actions = th.tensor([[0, 0, 1, 1], [0, 0, 0, 1]]).expand(2, 2, 4)
    won = problem.successes(batch, problem.returns(batch, actions))
    assert won is not None and won.tolist() == [[True, False], [True, True]]
    # Padding is no task.
    padded = RoutePlanningEnv(4).problem
    short = instance(n_tasks=2).pad(4)
    tours = nearest_feasible(short)[:, None]
    assert padded.successes(short, padded.returns(short, tours)).tolist() == [[True]]  # type: ignore[union-attr]

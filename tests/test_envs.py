"""The Gymnasium environments of both levels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import instance_batches, seeds
from env_helpers import (
    act,
    both_levels,
    make,
    overwrite,
    play,
    rendered,
)
from gymnasium.error import ResetNeeded
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.envs import (
    ClusteredGenerator,
    FixedGenerator,
    InstanceGenerator,
    Instances,
    RoutePlanningEnv,
    Schedule,
    TaskAllocationEnv,
    UniformGenerator,
    check_schedule,
    nearest_feasible,
)
from sb3_uav.envs.gym_env import ProblemEnv

SMALL_IDS = ["TaskAllocation-U3-N20-v0", "RoutePlanning-N20-v0"]


# Reset


@both_levels
def test_seeds(level: str) -> None:
    """The same seed gives the same sequence of episodes, another seed a different one."""
    runs = []
    for seed in (1, 1, 2):
        env = make(level, n_tasks=6)
        episodes = [play(env, np.random.default_rng(0), seed=seed), play(env, np.random.default_rng(0))]
        runs.append([np.concatenate([o["tasks"] for o in observations]) for observations, _ in episodes])
    assert all(np.array_equal(a, b) for a, b in zip(runs[0], runs[1], strict=True))
    assert not np.array_equal(runs[0][0][:12], runs[2][0][:12])
    assert not np.array_equal(runs[0][0][:12], runs[0][1][:12])


@both_levels
def test_seed_restarts_the_instances(level: str) -> None:
    env = make(level, n_tasks=6)
    first = env.reset(seed=3)[0]["tasks"]
    second = env.reset()[0]["tasks"]
    assert np.array_equal(env.reset(seed=3)[0]["tasks"], first) and np.array_equal(env.reset()[0]["tasks"], second)
    assert not np.array_equal(first, second)


@both_levels
@settings(max_examples=25)
@given(instances=instance_batches(max_batch=1), seed=seeds)
def test_given_instance_is_played(level: str, instances: Instances, seed: int) -> None:
    """Of any size that fits: the observations show that instance, padded, and the routes pass the checker."""
    rng = np.random.default_rng(seed)
    env = make(level, n_tasks=9, **({"n_uavs": instances.n_uavs} if level == "allocation" else {}))
    observations, rewards = play(env, rng, options={"instance": instances})
    n_tasks, shown = instances.n_tasks, instances.near_origin()
    for observation in observations:
        assert np.array_equal(observation["depot"], shown.depot[0].float().numpy())
        assert np.array_equal(observation["tasks"][: 2 * n_tasks], shown.tasks[0].float().flatten().numpy())
        assert np.array_equal(observation["task_values"][:n_tasks], instances.values[0].float().numpy())
        assert observation["task_mask"].tolist() == instances.task_mask[0].tolist() + [0] * (9 - n_tasks)
        assert observation["max_distance"] == instances.max_distance.float().numpy()
        if level == "routing":
            assert not observation["visited"][observation["task_mask"] == 0].any()
    report = check_schedule(instances, 0, Schedule(env.episodes.routes(0)))
    assert report.objective == pytest.approx(sum(rewards), rel=1e-12, abs=0)
    # The next episode draws an instance again.
    assert env.reset()[0]["task_mask"].all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"instances": None}, r"Unknown reset options \['instances'\]; the one option is 'instance'"),
        ({"instance": None}, "Option 'instance' must be Instances with batch size 1, found None"),
        ({"instance": "plan.npz"}, r"Option 'instance' must be Instances with batch size 1, found 'plan\.npz'"),
        (
            {"instance": UniformGenerator(5)(2, np.random.default_rng(0))},
            "Option 'instance' must be Instances with batch size 1",
        ),
        ({"instance": UniformGenerator(9)(1, np.random.default_rng(0))}, "The instance has 9 tasks, .* holds 5; make the env"),
    ],
)
@both_levels
def test_bad_options_are_refused(level: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(level, n_tasks=5).reset(options=options)


@both_levels
def test_bad_numbers_in_a_given_instance_are_refused(level: str) -> None:
    instance = UniformGenerator(5)(1, np.random.default_rng(0))
    instance.tasks[0, 3, 1] = th.nan
    with pytest.raises(ValueError, match=r"field 'tasks' holds nan at index \(0, 3, 1\)"):
        make(level, n_tasks=5).reset(options={"instance": instance})


def test_fleet_of_a_given_instance() -> None:
    """Allocation refuses a number of UAVs other than that of its actions; routing, which plans for one, accepts any."""
    instance = UniformGenerator(5, n_uavs=6)(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"The instance has 6 UAVs, but the environment was made for 4; make .* n_uavs=6"):
        TaskAllocationEnv(n_tasks=5, n_uavs=4).reset(options={"instance": instance})
    observation, _ = RoutePlanningEnv(n_tasks=5).reset(options={"instance": instance})
    assert np.array_equal(observation["tasks"], instance.tasks.float().numpy().ravel())


# Constructor arguments


@both_levels
def test_sizes_and_distance(level: str) -> None:
    env = make(level, n_tasks=3, max_distance=0.5)
    observation, _ = env.reset(seed=0)
    assert observation["tasks"].shape == (6,) and observation["max_distance"] == 0.5
    assert env.action_space.n == 4  # type: ignore[attr-defined]
    assert TaskAllocationEnv(n_uavs=7).action_space.n == 7  # type: ignore[attr-defined]


@both_levels
def test_distributions(level: str) -> None:
    """Each environment draws what its generator draws from the same random numbers."""
    n_uavs = 1 if level == "routing" else 4
    cases: list[tuple[dict[str, Any], InstanceGenerator]] = [
        ({}, UniformGenerator(8, n_uavs)),
        ({"distribution": "clustered"}, ClusteredGenerator(8, n_uavs)),
        ({"generator": ClusteredGenerator(8, n_uavs, n_clusters=1)}, ClusteredGenerator(8, n_uavs, n_clusters=1)),
    ]
    for kwargs, generator in cases:
        env = make(level, n_tasks=8, **kwargs)
        env.reset(seed=11)
        assert th.equal(env.instance.tasks, generator(1, np.random.default_rng(11)).tasks)
    with pytest.raises(ValueError, match="distribution is 'moon'; choose one of"):
        make(level, distribution="moon")


@both_levels
def test_instances_from_a_file(level: str, tmp_path: Path, small: Instances) -> None:
    """The file decides the sizes, and every episode plays one of its rows."""
    small.save(tmp_path / "small.npz")
    env = make(level, n_tasks=99, instances=tmp_path / "small.npz")
    assert env.observation_space["tasks"].shape == (10,)  # type: ignore[index]
    if level == "allocation":
        assert env.action_space.n == 2  # type: ignore[attr-defined]
    seen = set()
    for seed in range(20):
        env.reset(seed=seed)
        same = [row for row in range(3) if th.equal(env.instance.tasks[0], small.tasks[row])]
        assert len(same) == 1 and th.equal(env.instance.depot[0], small.depot[same[0]])
        seen.add(same[0])
    assert seen == {0, 1, 2}
    with pytest.raises(FileNotFoundError, match="no such instance file"):
        make(level, instances=tmp_path / "nowhere.npz")


@both_levels
def test_bad_sizes_are_refused(level: str) -> None:
    with pytest.raises(ValueError, match="n_tasks is 0, but an instance needs at least 1 task"):
        make(level, n_tasks=0)
    with pytest.raises(ValueError, match=r"max_distance is -1\.0, but"):
        make(level, max_distance=-1.0)
    with pytest.raises(ValueError, match="n_uavs is 0, but a fleet needs at least 1 UAV"):
        TaskAllocationEnv(n_uavs=0)
    with pytest.raises(ValueError, match="render_mode is 'ascii'; choose one of"):
        make(level, render_mode="ascii")


@both_levels
def test_set_generator(level: str) -> None:
    """It takes effect with the next episode; one of another size is refused."""
    env = make(level, n_tasks=5)
    env.reset(seed=0)
    n_uavs = env.problem.generator.n_uavs
    source = FixedGenerator(UniformGenerator(5, n_uavs, max_distance=3.0)(1, np.random.default_rng(9)))
    env.set_generator(source)
    assert env.instance.max_distance == 2.0
    env.reset()
    assert th.equal(env.instance.tasks, source.instances.tasks) and env.instance.max_distance == 3.0
    with pytest.raises(ValueError, match=f"The new generator draws 6 tasks and {n_uavs} UAVs, .* for 5 and {n_uavs}; make a"):
        env.set_generator(UniformGenerator(6, n_uavs))


@pytest.mark.parametrize("env_id", SMALL_IDS)
def test_ids_take_another_size(env_id: str) -> None:
    """``gym.make(id, n_tasks=...)``, as with the zoo's ``env_kwargs``: episodes still end without truncation."""
    env = gym.make(env_id, n_tasks=40, max_distance=1000.0)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    problem_env = env.unwrapped
    assert isinstance(problem_env, ProblemEnv)
    for _ in range(41):
        _, _, terminated, truncated, _ = env.step(act(problem_env, rng))
        assert not truncated
        if terminated:
            break
    assert terminated


# Steps


@both_levels
@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_observations_hold_the_state(level: str, seed: int) -> None:
    """The mask is that of ``action_masks``, and the rest follows from the actions so far."""
    rng = np.random.default_rng(seed)
    env = make(level, n_tasks=6, max_distance=1.5)
    observation, _ = env.reset(seed=seed)
    actions: list[int] = []
    terminated = False
    while not terminated:
        assert observation["action_mask"].dtype == np.int8 and env.action_masks().dtype == np.bool_
        assert observation["action_mask"].tolist() == env.action_masks().astype(int).tolist()
        if level == "allocation":
            assert observation["current_task"] == len(actions)
            assert observation["assignment"].tolist() == actions + [-1] * (6 - len(actions))
        else:
            assert observation["position"] == (actions or [0])[-1]
            assert observation["visited"].nonzero()[0].tolist() == sorted(action - 1 for action in actions)
            flown = check_open_length(env.instance, actions)
            assert observation["remaining_distance"] == pytest.approx(1.5 - flown, abs=1e-6)
        actions.append(act(env, rng))
        observation, _, terminated, _, _ = env.step(actions[-1])
    assert env.action_masks().any()


@both_levels
@settings(max_examples=40)
@given(instances=instance_batches(max_batch=1), seed=seeds, recklessness=st.sampled_from([0.0, 0.3, 1.0]))
def test_some_action_is_legal_in_every_state(level: str, instances: Instances, seed: int, recklessness: float) -> None:
    """For any instance, after legal and illegal actions, until the end and after it."""
    rng = np.random.default_rng(seed)
    env = make(level, n_tasks=9, **({"n_uavs": instances.n_uavs} if level == "allocation" else {}))
    observation, _ = env.reset(options={"instance": instances})
    for _ in range(11):
        assert observation["action_mask"].any() and env.action_masks().any()
        reckless = rng.random() < recklessness
        observation, _, terminated, _, _ = env.step(env.action_space.sample() if reckless else act(env, rng))
    assert terminated


def check_open_length(instance: Instances, nodes: list[int]) -> float:
    """Length of the way from the depot through these nodes."""
    stops = np.vstack([instance.depot[0].numpy(), *(instance.tasks[0, node - 1].numpy() for node in nodes)])
    return float(np.linalg.norm(np.diff(stops, axis=0), axis=1).sum())


@both_levels
def test_nothing_returned_shares_memory(level: str) -> None:
    """Overwriting the arrays that an environment returns changes neither the episode nor other observations."""
    rewards = []
    for vandal in (False, True):
        rng = np.random.default_rng(0)
        env = make(level, n_tasks=6)
        observation, _ = env.reset(seed=4)
        collected, terminated = [], False
        while not terminated:
            action = act(env, rng)
            mask = env.action_masks()
            if vandal:
                overwrite(mask, *observation.values())
            else:
                kept = {key: value.copy() for key, value in observation.items()}
            new, reward, terminated, _, _ = env.step(action)
            if not vandal:
                assert all(np.array_equal(kept[key], observation[key]) for key in kept)
            collected.append((reward, {key: value.tolist() for key, value in new.items()}))
            observation = new
        rewards.append(collected)
    assert rewards[0] == rewards[1]


def test_illegal_actions_are_counted() -> None:
    """They do not raise, the UAV flies home, and the next episode counts from 0."""
    env = RoutePlanningEnv(n_tasks=5, max_distance=3.0)
    env.reset(seed=0)
    legal = int(np.flatnonzero(env.action_masks())[0])
    assert env.step(legal)[4] == {"illegal_actions": 0}
    _, reward, terminated, truncated, info = env.step(legal)
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info == {"illegal_actions": 1, "objective": 1.0, "is_success": False}
    assert env.episodes.routes(0) == [[legal - 1]]
    env.reset(seed=0)
    assert env.step(legal)[4]["illegal_actions"] == 0


@pytest.mark.parametrize("action", [-1, 4, 1000, 0.5, float("nan"), None, "1", [0, 1]])
def test_impossible_actions_are_refused(action: Any) -> None:
    """With the range in the message, and without changing the episode."""
    env = TaskAllocationEnv(n_tasks=3, n_uavs=4)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="Give 1 whole numbers between 0 and 3 as actions; found"):
        env.step(action)
    assert env.step(3)[0]["current_task"] == 1


@pytest.mark.parametrize("action", [2, np.int64(2), np.array(2), np.array([2]), 2.0, th.tensor(2)])
def test_actions_of_any_integer_type(action: Any) -> None:
    env = TaskAllocationEnv(n_tasks=3, n_uavs=4)
    env.reset(seed=0)
    assert env.step(action)[0]["assignment"].tolist() == [2, -1, -1]


@both_levels
def test_step_before_reset(level: str) -> None:
    with pytest.raises(ResetNeeded, match=r"There is no episode to step yet; call reset\(\) first"):
        make(level).step(0)


@both_levels
def test_stepping_on_after_the_end(level: str) -> None:
    """Changes nothing and earns nothing."""
    env = make(level, n_tasks=4, render_mode="rgb_array")
    observations, _ = play(env, np.random.default_rng(0), seed=0)
    image = rendered(env)
    for action in range(3):
        observation, reward, terminated, _, _ = env.step(action)
        assert (reward, terminated) == (0.0, True)
        assert all(np.array_equal(observation[key], observations[-1][key]) for key in observation)
    assert np.array_equal(rendered(env), image)


def test_reward_of_the_allocation_env() -> None:
    """The value of the nearest-feasible tours by default."""
    env = TaskAllocationEnv(n_tasks=6, n_uavs=2)
    env.reset(seed=0)
    rewards = [float(env.step(action)[1]) for action in (0, 1, 0, 1, 0, 1)]
    tours = []
    for start in (0, 1):
        subset = Instances.from_arrays(env.instance.depot, env.instance.tasks[:, start::2])
        tours.append([start + 2 * (node - 1) for node in nearest_feasible(subset)[0].tolist() if node > 0])
    assert rewards == [0.0] * 5 + [check_schedule(env.instance, 0, Schedule(tours)).objective]
    assert env.episodes.routes(0) == tours


def test_set_router() -> None:
    """It takes effect with the next reward, even during an episode; so does the constructor's argument."""

    def homebody(instances: Instances) -> th.Tensor:
        return th.zeros(len(instances), 1, dtype=th.int64)

    def final_reward(env: TaskAllocationEnv) -> float:
        return float([env.step(0)[1] for _ in range(4)][-1])

    env = TaskAllocationEnv(n_tasks=4)
    env.reset(seed=0)
    assert final_reward(env) > 0
    env.reset(seed=0)
    env.set_router(homebody)
    assert final_reward(env) == 0
    env.reset(seed=0)
    env.set_router(nearest_feasible)
    assert final_reward(env) > 0
    env = TaskAllocationEnv(n_tasks=4, router=homebody)
    env.reset(seed=0)
    assert final_reward(env) == 0

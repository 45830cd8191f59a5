"""Generators, distributions, routers and rewards by dotted path: what they do, and what is refused when the env is made."""

from __future__ import annotations

import copy
import pickle
import random
import re
import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import zoo_hooks
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, nearest_feasible
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.pretrained import files
from sb3_uav.reinforce import REINFORCE

NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
ALLOCATION, ROUTING = "TaskAllocation-U3-N20-v0", "RoutePlanning-N20-v0"


def make(env_id: str = ALLOCATION, **kwargs: Any) -> ProblemEnv:
    env = gym.make(env_id, **kwargs).unwrapped
    assert isinstance(env, ProblemEnv)
    return env


def first_instance(**kwargs: Any) -> Instances:
    env = make(**kwargs)
    env.reset(seed=3)
    return env.instance


def play(env: ProblemEnv, choose: Any) -> tuple[list[float], dict[str, Any]]:
    env.reset(seed=0)
    rewards, done, info = [], False, dict[str, Any]()
    while not done:
        _, reward, done, _, info = env.step(choose(env))
        rewards.append(reward)
    return rewards, info


def first_legal(env: ProblemEnv) -> int:
    return int(env.action_masks().nonzero()[0][-1])


# ------------------------------------------------------------------------------------------------------ what they do


def test_generators_are_made_with_the_sizes_of_the_environment() -> None:
    instance = first_instance(generator="zoo_hooks.Corner")
    assert (instance.n_tasks, instance.n_uavs, instance.max_distance.item()) == (20, 3, 1.5)
    assert instance.depot.tolist() == [[0.0, 0.0]]
    same = first_instance(generator=zoo_hooks.Corner(20, 3, 1.5))
    assert same.digest() == instance.digest() == first_instance(generator=zoo_hooks.Corner).digest()


def test_generators_get_further_arguments_and_may_have_a_size_of_their_own() -> None:
    env = make(generator={"zoo_hooks.Scaled": {"n_tasks": 7, "scale": 0.01}})
    env.reset(seed=0)
    assert env.instance.n_tasks == 7 and env.instance.tasks.max() <= 0.01 and env.action_space == gym.spaces.Discrete(3)
    clusters = make(generator={"sb3_uav.envs.ClusteredGenerator": {"n_clusters": 2}}).problem.generator
    assert (clusters.n_clusters, clusters.n_tasks, clusters.max_distance) == (2, 20, 1.5)  # type: ignore[attr-defined]


def test_generators_may_draw_fewer_tasks_than_they_have_slots_for() -> None:
    class Fewer(UniformGenerator):
        def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
            return UniformGenerator(self.n_tasks - 3, self.n_uavs)(batch_size, rng)

    env = make(generator=Fewer(20, 3))
    env.reset(seed=0)
    assert env.instance.task_mask.sum().item() == 17 and env.instance.n_tasks == 20


def test_a_generator_replaces_the_distribution_of_an_id() -> None:
    env_id = "TaskAllocation-Universal-v0"
    instance = first_instance(env_id=env_id, generator={"zoo_hooks.Corner": {"n_tasks": 9}})
    assert (instance.n_tasks, instance.n_uavs) == (9, 8) and instance.depot.tolist() == [[0.0, 0.0]]
    assert make(env_id, generator=zoo_hooks.Corner(20, 3, 1.5)).observation_space == make().observation_space


def test_nothing_is_drawn_from_an_object_before_the_first_episode() -> None:
    """One that takes its instances from a list, say, would skip the first ones."""

    class Queue(UniformGenerator):
        n_drawn = 0

        def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
            type(self).n_drawn += batch_size
            return super().__call__(batch_size, rng)

    env = make(generator=Queue(20, 3), router="zoo_hooks.one_task", reward="zoo_hooks.root_of_visits")
    alone = make(ROUTING, generator=Queue(20, 1), reward="zoo_hooks.root_of_visits")
    assert Queue.n_drawn == 0
    env.reset(seed=0)
    alone.reset(seed=0)
    assert Queue.n_drawn == 2
    with pytest.raises(ValueError, match=r"its n_tasks is 0; it needs a whole number"):
        make(generator=types.SimpleNamespace(n_tasks=0, n_uavs=3))
    # Those of the package have no state.
    with pytest.raises(ValueError, match=r"^reward is 'zoo_hooks\.broken': it failed"):
        make(generator=UniformGenerator(20, 3), reward="zoo_hooks.broken")


def test_distributions_draw_points_and_values() -> None:
    plain = first_instance(distribution="zoo_hooks.stripe")
    assert plain.tasks[..., 0].max() <= 0.1 < plain.tasks[..., 1].max() and (plain.values == 1).all()
    assert (plain.n_tasks, plain.n_uavs, plain.max_distance.item()) == (20, 3, 1.5)
    narrow = first_instance(distribution={"zoo_hooks.stripe": {"width": 0.01}})
    assert th.allclose(narrow.tasks * th.tensor([10.0, 1.0]), plain.tasks)
    values = first_instance(env_id=ROUTING, distribution="zoo_hooks.valued").values
    assert set(values.flatten().tolist()) == {1.0, 2.0, 3.0, 4.0}


def test_routers_plan_the_tours_of_the_reward() -> None:
    def objective(**kwargs: Any) -> float:
        return play(make("TaskAllocation-U4-N80-v0", **kwargs), lambda env: 0)[1]["objective"]

    assert objective(router="zoo_hooks.one_task") == 1.0
    assert objective(router={"zoo_hooks.one_task": {"worst": True}}) == 0.0
    nearest = objective()
    assert nearest == objective(router="sb3_uav.envs.nearest_feasible") > 1
    trained = objective(router="universal")
    assert trained == objective(router=str(files("universal")[1])) > nearest


def test_the_shipped_router_is_loaded_once() -> None:
    env = DummyVecEnv([lambda: make(router="universal")] * 2)
    first, second = env.get_attr("problem")
    assert first.router == second.router
    model = REINFORCE("AllocatorPolicy", env, policy_kwargs=NETWORK, seed=0, device="cpu")
    assert model.problem is first


@pytest.mark.parametrize("env_id", [ALLOCATION, ROUTING])
def test_a_reward_comes_at_the_end(env_id: str) -> None:
    rewards, info = play(make(env_id, reward="zoo_hooks.root_of_visits"), first_legal)
    plain, usual = play(make(env_id), first_legal)
    assert len(rewards) == len(plain) and rewards[:-1] == [0.0] * (len(rewards) - 1)
    assert info["objective"] == rewards[-1] and "is_success" not in info and "is_success" in usual
    if env_id == ROUTING:
        assert rewards[-1] == pytest.approx(usual["objective"] ** 0.5)
    else:
        # The last UAV has all tasks.
        assert rewards[-1] == pytest.approx(usual["objective"] ** 0.5)
    squared, _ = play(make(env_id, reward={"zoo_hooks.root_of_visits": {"power": 2}}), first_legal)
    assert squared[-1] == pytest.approx(usual["objective"] ** 2)
    assert play(make(env_id, reward="zoo_hooks.plain_value"), first_legal)[0][-1] == sum(plain)


def test_a_reward_sees_the_order_of_the_visits() -> None:
    env = make(ROUTING, reward="zoo_hooks.order_of_visits")
    visits: list[int] = []

    def choose(env: ProblemEnv) -> int:
        visits.append(first_legal(env))
        return visits[-1]

    rewards, _ = play(env, choose)
    assert visits[-1] == 0 and rewards[-1] == visits[-2] - 1


def test_a_reward_sees_the_whole_fleet() -> None:
    """With more UAVs than tasks too: which UAV flies a tour may matter."""
    shapes: list[tuple[int, ...]] = []

    def last_uav(instances: Instances, tours: th.Tensor) -> th.Tensor:
        shapes.append((instances.n_uavs, *tours.shape[:2]))
        return (tours[:, -1] >= 0).sum(-1).double()

    env = TaskAllocationEnv(3, 5, max_distance=9.0, reward=last_uav)
    assert play(env, lambda env: 4)[0][-1] == 3 and play(env, lambda env: 3)[0][-1] == 0
    assert shapes == [(5, 2, 5), (5, 1, 5), (5, 1, 5)]
    assert env.problem.returns(env.instance, th.tensor([[[4, 0, 4]]])).tolist() == [[2.0]]


@pytest.mark.parametrize(("env_id", "policy"), [(ALLOCATION, "AllocatorPolicy"), (ROUTING, "RouterPolicy")])
@pytest.mark.parametrize("vec_env", [BatchedVecEnv, DummyVecEnv])
def test_both_drivers_give_the_same_reward(env_id: str, policy: str, vec_env: type) -> None:
    """The fused driver's returns are those of the environment, stepped with the same actions."""
    kwargs: dict[str, Any] = dict(reward="zoo_hooks.root_of_visits", distribution="zoo_hooks.stripe")
    env = vec_env([lambda: make(env_id, **kwargs)] * 2)
    model = REINFORCE(policy, env, policy_kwargs=NETWORK, seed=0, device="cpu")
    assert model.problem is not None and isinstance(model.policy, AllocatorPolicy | RouterPolicy)
    instances = model.problem.generator(2, np.random.default_rng(5))
    actions = model.policy.decode_episodes(instances)
    returns = model.problem.returns(instances, actions)
    rewards = model.problem.step_rewards(instances, actions, returns)
    assert rewards.sum(-1).tolist() == returns.tolist()
    for row in range(2):
        single = make(env_id, **kwargs)
        single.reset(options={"instance": instances[row]})
        played, done, step = [], False, 0
        while not done:
            _, reward, done, _, _ = single.step(int(actions[row, 0, step]))
            played.append(reward)
            step += 1
        assert played == rewards[row, 0, :step].tolist()
    model.learn(1)
    assert model.n_batches == 1


def test_objects_of_the_same_class_and_arguments_are_equal() -> None:
    """So that REINFORCE's fused driver recognizes the rows of a DummyVecEnv as the same environment."""
    kwargs: dict[str, Any] = dict(
        generator={"zoo_hooks.PlainCorner": {"side": 0.5}},
        reward={"zoo_hooks.PowerOfVisits": {"power": 2}},
        router="zoo_hooks.NearestRouter",
    )
    env = DummyVecEnv([lambda: make(**kwargs)] * 2)
    first, second = env.get_attr("problem")
    assert (first.generator, first.reward, first.router) == (second.generator, second.reward, second.router)
    assert hash(first.generator) == hash(second.generator) and first.generator.side == 0.5
    assert copy.deepcopy(first.reward) == pickle.loads(pickle.dumps(first.reward)) == first.reward
    others = make(generator="zoo_hooks.PlainCorner", reward="zoo_hooks.PowerOfVisits").problem
    assert first.generator != others.generator and first.reward != others.reward
    model = REINFORCE("AllocatorPolicy", env, policy_kwargs=NETWORK, seed=0, device="cpu")
    assert model.problem is first
    assert play(make(reward="zoo_hooks.PowerOfVisits"), first_legal) == play(
        make(reward="zoo_hooks.root_of_visits"), first_legal
    )


def test_trying_out_disturbs_no_random_stream() -> None:
    kwargs: dict[str, Any] = dict(generator="zoo_hooks.Corner", router="universal", reward="zoo_hooks.root_of_visits")
    make(**kwargs)
    before = random.getstate(), np.random.get_state()[1].tolist(), th.get_rng_state().tolist()  # type: ignore[index]
    make(**kwargs)
    assert before == (random.getstate(), np.random.get_state()[1].tolist(), th.get_rng_state().tolist())  # type: ignore[index]
    assert first_instance(router="universal").digest() == first_instance().digest()


# ------------------------------------------------------------------------------------------------------ what is refused

GENERATORS = [
    ("nowhere.Generator", "cannot be imported (No module named 'nowhere'); give the dotted path of one"),
    ("zoo_hooks.Missing", "cannot be imported (module 'zoo_hooks' has no attribute 'Missing')"),
    ("Generator", "is no dotted path; write package.module.name"),
    ({"zoo_hooks.Corner": {"n_clusters": 3}}, "could not be made with"),
    ({"a.B": {}, "c.D": {}}, "write one dotted path and a mapping of its arguments"),
    ({"zoo_hooks.Corner": 3}, "write one dotted path and a mapping of its arguments"),
    ("zoo_hooks.NoSize", "its n_tasks is None; it needs a whole number of at least 1."),
    ("zoo_hooks.TooFew", "it drew 1 instances of 20 tasks and 3 UAVs instead of 2 instances of 20 tasks and 3 UAVs."),
    ("zoo_hooks.OtherSize", "it drew 2 instances of 21 tasks"),
    ("zoo_hooks.Arrays", "it returned an object of type ndarray; return sb3_uav.envs.Instances."),
    ("zoo_hooks.Global", "it draws different instances from equal random generators; draw with the rng"),
    ("zoo_hooks.Negative", "task values must be >= 0"),
    ("zoo_hooks.broken", "could not be made with"),
    (5, "its n_tasks is None"),
]
DISTRIBUTIONS = [
    ("gaussian", "distribution is 'gaussian'; choose one of"),
    ("zoo_hooks.gaussian", "cannot be imported"),
    ("zoo_hooks.depots_only", "return a tuple of depots and tasks, or of depots, tasks and values"),
    ("zoo_hooks.too_many", "Instances.values has shape (2, 20), expected (2, 21)"),
    ("zoo_hooks.broken", "it failed with KeyError('battery')"),
    ({"zoo_hooks.stripe": {"height": 1}}, "it failed with TypeError"),
    (5, "it is of type int, which cannot be called; give function(n_instances, n_tasks, rng)."),
]
ROUTERS = [
    (
        "nowhere",
        "router: nowhere: no such file; give the zip of a router that was trained before, or one of "
        "['universal', 'world']. Or give",
    ),
    ("nowhere.zip", "nowhere.zip: no such file; give the zip of a router"),
    ("zoo_hooks.nowhere", "cannot be imported"),
    ("zoo_hooks.flat", "it returned torch.int64 of shape"),
    ("zoo_hooks.floats", "it returned torch.float64 of shape"),
    ("zoo_hooks.broken", "it failed with KeyError('battery')"),
    ("zoo_hooks.everything", "it visited a task twice, or one that task_mask marks as padding."),
    ("zoo_hooks.twice", "it visited a task twice"),
    ("zoo_hooks.far", "it planned a tour of length"),
    (str(files("universal")[0]), "holds the policy of class AllocatorPolicy, but RouterPolicy is needed here"),
    (7, "it is of type int, which cannot be called; give function(instances)."),
]
REWARDS = [
    ("nowhere.reward", "cannot be imported"),
    ("zoo_hooks.per_tour", "it returned a tensor of shape (2, 3); return a tensor of shape (2,), one number per row."),
    ("zoo_hooks.infinite", "it returned inf; return finite numbers."),
    ("zoo_hooks.broken", "it failed with KeyError('battery')"),
    ({"zoo_hooks.root_of_visits": {"exponent": 2}}, "it failed with TypeError"),
    (3.5, "it is of type float, which cannot be called; give function(instances, tours)."),
]


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        *(("generator", *case) for case in GENERATORS),
        *(("distribution", *case) for case in DISTRIBUTIONS),
        *(("router", *case) for case in ROUTERS),
        *(("reward", *case) for case in REWARDS),
    ],
)
def test_what_cannot_be_used_is_refused_when_the_environment_is_made(argument: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        make(**{argument: value})
    assert str(caught.value).startswith(f"{argument} is {value!r:.200}")


@pytest.mark.parametrize("argument", ["generator", "distribution", "reward"])
def test_the_router_alone_is_as_strict(argument: str) -> None:
    with pytest.raises(ValueError, match=rf"^{argument} is 'nowhere\.it': cannot be imported"):
        make(ROUTING, **{argument: "nowhere.it"})
    with pytest.raises(ValueError, match=r"^reward is 'zoo_hooks\.per_tour': it returned a tensor of shape \(2, 1\)"):
        make(ROUTING, reward="zoo_hooks.per_tour")


def test_contradictions_are_refused(tmp_path: Path) -> None:
    UniformGenerator(5, 3)(2, np.random.default_rng(0)).save(tmp_path / "set.npz")
    path = str(tmp_path / "set.npz")
    with pytest.raises(ValueError, match="generator and instances both say what to draw; give one of them"):
        make(generator="zoo_hooks.Corner", instances=path)
    with pytest.raises(ValueError, match="generator and distribution both say what to draw"):
        make(generator="zoo_hooks.Corner", distribution="zoo_hooks.stripe")
    with pytest.raises(ValueError, match="instances and distribution both say what to draw"):
        make(instances=path, distribution="zoo_hooks.stripe")


def test_different_rewards_leave_the_fused_driver() -> None:
    env = DummyVecEnv([lambda: TaskAllocationEnv(6, 2), lambda: TaskAllocationEnv(6, 2, reward=zoo_hooks.plain_value)])
    with pytest.warns(UserWarning, match="rows 0 and 1 of the DummyVecEnv have different rewards"):
        REINFORCE("AllocatorPolicy", env, policy_kwargs=NETWORK, n_samples=2, device="cpu").learn(1)


def test_functions_are_taken_as_they_are() -> None:
    env = RoutePlanningEnv(20, reward=zoo_hooks.plain_value)
    assert env.problem.reward is zoo_hooks.plain_value
    assert TaskAllocationEnv(router=nearest_feasible).problem.router is nearest_feasible

"""Which environments REINFORCE plays in whole episodes, and what it says when it does not."""

import inspect
import re
import warnings
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, TimeLimit, TransformReward
from reinforce_models import SMALL, make_env, make_model
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecMonitor, VecNormalize

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, nearest_feasible
from sb3_uav.envs.generators import FixedGenerator
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.drivers import _FUSED_SETTINGS, _STEP_LOOP_SETTINGS
from sb3_uav.reinforce.recognition import find_problem, why_unrecognized


def fixed(seed: int = 0, n_instances: int = 8) -> Instances:
    return UniformGenerator(6, 1, 1.2)(n_instances, np.random.default_rng(seed))


def reward_doubled(env: gym.Env) -> gym.Env:
    return TransformReward(env, lambda reward: 2 * float(reward))


class DoubledReward(RoutePlanningEnv):
    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, 2 * reward, terminated, truncated, info


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, BatchedVecEnv])
@pytest.mark.parametrize("kind", ["file", "object", "copies"])
def test_rows_with_equal_fixed_instances_are_one_problem(vec_env_cls, kind, tmp_path):
    fixed().save(tmp_path / "mine.npz")
    given: dict[str, Any] = {"file": str(tmp_path / "mine.npz"), "object": fixed()}
    rows = [lambda: RoutePlanningEnv(6, instances=given.get(kind) or fixed())] * 4
    model = make_model("router", "shared", vec_env_cls(rows), n_samples=4)
    assert model.problem is not None
    drawn = model.draw_batch(0).depot
    assert all((fixed().depot == depot).all(1).any() for depot in drawn)
    assert model.learn_instances(4).n_instances == 4


def test_fixed_generators_are_equal_by_content():
    first, same, other = FixedGenerator(fixed()), FixedGenerator(fixed()), FixedGenerator(fixed(1))
    assert first == same and hash(first) == hash(same)
    assert first != other and first != FixedGenerator(fixed(n_instances=7)) and first != UniformGenerator(6, 1, 1.2)

    class Reversed(FixedGenerator):
        pass

    assert first != Reversed(fixed())


@pytest.mark.parametrize(
    "wrapper",
    [RecordEpisodeStatistics, OrderEnforcing, PassiveEnvChecker, lambda env: TimeLimit(env, 21)],
    ids=["RecordEpisodeStatistics", "OrderEnforcing", "PassiveEnvChecker", "TimeLimit"],
)
def test_harmless_wrappers_leave_the_fused_driver(wrapper):
    """No tour of 20 tasks has more than 21 steps."""
    model = REINFORCE("RouterPolicy", wrapper(gym.make("RoutePlanning-N20-v0")), n_samples=8, policy_kwargs=SMALL, seed=0)
    assert model.problem is not None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(40)
    assert model.n_instances > 0
    assert BatchedVecEnv([lambda: wrapper(gym.make("RoutePlanning-N20-v0"))] * 2).problem is not None


def test_harmless_vectorized_wrappers_leave_the_fused_driver():
    for env in (VecMonitor(make_env("router")), VecCheckNan(make_env("router")), VecMonitor(VecCheckNan(make_env("router")))):
        assert make_model("router", env=env).problem is not None


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ([lambda: reward_doubled(RoutePlanningEnv(6))] * 2, "the wrapper TransformReward may change observations"),
        (
            [lambda: TimeLimit(gym.make("RoutePlanning-N20-v0"), 20)],
            "the wrapper (Patched)?TimeLimit may change observations or rewards",
        ),
        (
            # Another class of the same name may do anything.
            [lambda: type("TimeLimit", (TimeLimit,), {})(RoutePlanningEnv(6), 100)],
            "the wrapper TimeLimit may change observations or rewards",
        ),
        ([lambda: DoubledReward(6)] * 2, "DoubledReward overrides step or reset"),
        ([lambda: gym.make("CartPole-v1")], "is not an environment of sb3_uav"),
        (
            [lambda: RoutePlanningEnv(6, instances=fixed(0)), lambda: RoutePlanningEnv(6, instances=fixed(1))],
            r"rows 0 and 1 of the DummyVecEnv draw different instances \(FixedGenerator and FixedGenerator are not equal\)",
        ),
        (
            [
                lambda: TaskAllocationEnv(6, 2),
                lambda: TaskAllocationEnv(6, 2, router=lambda subsets: nearest_feasible(subsets)),
            ],
            "rows 0 and 1 of the DummyVecEnv have different routers",
        ),
    ],
)
def test_the_reason_for_the_step_loop_is_named(rows, reason):
    env = DummyVecEnv(rows)
    assert find_problem(env) is None
    assert why_unrecognized(env) == why_unrecognized(VecMonitor(env))
    assert re.search(reason, why_unrecognized(env))


def test_vectorized_environments_of_other_kinds_are_named():
    reason = "the environment is a VecNormalize, which may change observations or rewards"
    assert why_unrecognized(VecNormalize(make_env(), norm_obs=False)) == reason
    env = SubprocVecEnv([partial(RoutePlanningEnv, 6)])
    assert why_unrecognized(env) == "the environment is a SubprocVecEnv"
    env.close()


def test_a_refused_baseline_names_the_true_cause():
    env = DummyVecEnv([lambda: RoutePlanningEnv(6, instances=fixed(0)), lambda: RoutePlanningEnv(6, instances=fixed(1))])
    with pytest.raises(ValueError, match=r"but rows 0 and 1 of the DummyVecEnv draw different instances.*use 'none'"):
        make_model("router", "shared", env).learn(10)
    with pytest.raises(ValueError, match="but ActorCriticPolicy is not a policy of sb3_uav; use 'none'"):
        REINFORCE("MlpPolicy", "CartPole-v1", baseline="rollout")
    with pytest.raises(ValueError, match="learn_instances needs whole episodes, but rows 0 and 1"):
        make_model("router", "none", env).learn_instances(4)


def test_settings_without_effect_are_reported():
    env = DummyVecEnv([lambda: reward_doubled(RoutePlanningEnv(6))])
    model = make_model("router", "none", env, n_samples=8, lr_decay=0.9, n_steps=16)
    expected = r"REINFORCE ignores n_samples=8, instances_per_epoch=8, lr_decay=0.9 here: the wrapper TransformReward"
    with pytest.warns(UserWarning, match=expected):
        model.learn(16)
    model = make_model("router", "none", n_steps=16, gamma=0.9)
    with pytest.warns(UserWarning, match="REINFORCE ignores n_steps=16, gamma=0.9 here: it plays whole episodes"):
        model.learn(16)
    with pytest.warns(UserWarning, match="REINFORCE ignores n_samples=2 here: ActorCriticPolicy is not a policy"):
        REINFORCE("MlpPolicy", "CartPole-v1", n_samples=2, n_steps=16, device="cpu").learn(16)


def test_defaults_of_the_settings_are_those_of_the_constructor():
    parameters = inspect.signature(REINFORCE.__init__).parameters
    for name, default in {**_FUSED_SETTINGS, **_STEP_LOOP_SETTINGS}.items():
        assert parameters[name].default == default, name

"""A router that was trained before, under an allocator that learns."""

from typing import Any

import numpy as np
import pytest
import torch as th
from fixed_set_runs import N_UAVS, NETWORK, ROLLOUT, allocation_env, equal, load, make_callback, make_model, parameters
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

from sb3_uav import pretrained
from sb3_uav.envs import BatchedVecEnv, UniformGenerator, nearest_feasible
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import ITSCallback, PretrainedRouterCallback
from sb3_uav.training.fixed_set_returns import evaluate_fixed_set

pytestmark = pytest.mark.filterwarnings("ignore:FixedSetEvalCallback saves nothing")


def test_pretrained_router_gives_the_rewards(tmp_path):
    router = make_model(REINFORCE, "routing")
    router.learn(10 * ROLLOUT)
    router.save(tmp_path / "pretrained")
    evaluation = EvalCallback(BatchedVecEnv([allocation_env]), eval_freq=10**6)
    run = tmp_path / "run"
    instances = UniformGenerator(12, N_UAVS, max_distance=1.5)(30, np.random.default_rng(0))
    fixed = make_callback(run, instances=instances, eval_freq=10**6)
    callbacks = [PretrainedRouterCallback(tmp_path / "pretrained.zip", run), fixed, evaluation]
    model = make_model(PPO)
    model.learn(ROLLOUT, callback=callbacks)
    for env in (model.env, evaluation.eval_env):
        plan = env.get_attr("problem")[0].router
        assert equal(parameters(router), plan.__self__.state_dict())
    assert (run / "router.zip").read_bytes() == (tmp_path / "pretrained.zip").read_bytes()
    problem = allocation_env().problem
    problem.router = plan
    assert np.array_equal(load(run).results[-1], evaluate_fixed_set(model.policy, problem, instances, 0).greedy)
    problem.router = nearest_feasible
    assert not np.array_equal(load(run).results[-1], evaluate_fixed_set(model.policy, problem, instances, 0).greedy)


def test_pretrained_router_by_the_name_of_its_pair():
    assert PretrainedRouterCallback("universal").router == pretrained.files()[1]
    with pytest.raises(FileNotFoundError, match=r"router: magic: no such file; .* or one of \['universal', 'world'\]"):
        PretrainedRouterCallback("magic")


def test_pretrained_router_leaves_random_numbers_alone(tmp_path):
    make_model(REINFORCE, "routing").save(tmp_path / "router")

    class Watch(BaseCallback):
        states: Any = None

        def _on_training_start(self) -> None:
            self.states = (th.get_rng_state(), np.random.get_state()[1].tolist())  # type: ignore[index]

        def _on_step(self) -> bool:
            return True

    watches = []
    for first in ([], [PretrainedRouterCallback(tmp_path / "router.zip", tmp_path / "run")]):
        watches.append(Watch())
        make_model(PPO).learn(ROLLOUT, callback=[*first, watches[-1]])
    assert th.equal(watches[0].states[0], watches[1].states[0]) and watches[0].states[1] == watches[1].states[1]


def test_pretrained_router_is_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.zip: no such file"):
        PretrainedRouterCallback(tmp_path / "none.zip")
    make_model(PPO).save(tmp_path / "allocator")
    make_model(PPO, "routing").save(tmp_path / "router")
    with pytest.raises(ValueError, match="RouterPolicy is needed here"):
        make_model(PPO).learn(ROLLOUT, callback=PretrainedRouterCallback(tmp_path / "allocator.zip"))
    with pytest.raises(ValueError, match="needs a TaskAllocation environment"):
        make_model(PPO, "routing").learn(ROLLOUT, callback=PretrainedRouterCallback(tmp_path / "router.zip"))
    its = ITSCallback(dict(policy="RouterPolicy", policy_kwargs=NETWORK), save_path=str(tmp_path))
    with pytest.raises(ValueError, match="both provide a router"):
        make_model(REINFORCE).learn(ROLLOUT, callback=[PretrainedRouterCallback(tmp_path / "router.zip"), its])

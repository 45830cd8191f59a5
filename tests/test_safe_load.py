"""Algorithms from zips without unpickling: they go on as those that SB3 loads, and what was tampered with is refused."""

from __future__ import annotations

import base64
import json
import pickle
from pathlib import Path
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import pytest
import torch as th
from gymnasium import spaces
from malicious_zips import Touch, contents, saved, torch_zip, write
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.utils import LinearSchedule

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import EpisodeRolloutBuffer
from sb3_uav.training.safe_load import observation_space_of, read_model, safe_zips

TINY = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=16)
REMEDY = "Add --trust."


def make_vec() -> BatchedVecEnv:
    return BatchedVecEnv([lambda: RoutePlanningEnv(6)] * 4)


def make_model(cls: Any, **kwargs: Any) -> Any:
    small = {} if cls is REINFORCE else {"n_steps": 8}
    if issubclass(cls, PPO | MaskablePPO):
        small |= {"batch_size": 8, "n_epochs": 1}
    given = {"policy_kwargs": dict(TINY), "device": "cpu", "seed": 1, **small, **kwargs}
    return cls(RouterPolicy, make_vec(), **given)


@pytest.fixture
def never_unpickled(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("unpickled")

    for module in (pickle, cloudpickle):
        monkeypatch.setattr(module, "loads", refuse)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("zips") / "ppo.zip"
    model = make_model(PPO)
    model.learn(32)
    model.save(path)
    return path


CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "reinforce": (REINFORCE, dict(baseline="rollout", instances_per_epoch=4, baseline_kwargs=dict(n_test_instances=8))),
    "paper": (REINFORCE, dict(policy_kwargs=dict(TINY, preset="paper"))),
    "ppo": (PPO, dict(learning_rate=LinearSchedule(1e-3, 0.0, 1.0), clip_range=LinearSchedule(0.2, 0.1, 0.5))),
    "episodes": (PPO, dict(rollout_buffer_class=EpisodeRolloutBuffer)),
    "ppo_mask": (MaskablePPO, dict(policy_kwargs=dict(TINY, preset="paper"))),
    "a2c": (A2C, {}),
    "a2c_adam": (A2C, dict(use_rms_prop=False)),
}


@pytest.mark.parametrize("case", CASES)
def test_it_goes_on_as_after_sb3s_load(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cls, kwargs = CASES[case]
    model = make_model(cls, **kwargs)
    model.learn(32)
    model.save(tmp_path / "model.zip")
    expected = cls.load(tmp_path / "model.zip", env=make_vec(), device="cpu")
    with monkeypatch.context() as patch, safe_zips(REMEDY):
        patch.setattr(cloudpickle, "loads", None)
        found = cls.load(tmp_path / "model", env=make_vec(), device="cpu")
    assert vars(found).keys() == vars(expected).keys() and found.ep_info_buffer == expected.ep_info_buffer
    assert type(found.rollout_buffer) is type(expected.rollout_buffer)
    assert type(found.policy.optimizer) is type(expected.policy.optimizer)
    for each in (expected, found):
        each.set_random_seed(5)
        each.learn(64, reset_num_timesteps=False)
    assert found.num_timesteps == expected.num_timesteps
    for name, parameter in expected.policy.state_dict().items():
        assert th.equal(parameter, found.policy.state_dict()[name]), name


@pytest.mark.usefixtures("never_unpickled")
def test_pickles_are_not_looked_at(good: Path, tmp_path: Path) -> None:
    proof = tmp_path / "executed"
    data = json.loads(contents(good)["data"])
    evil = base64.b64encode(pickle.dumps(Touch(proof))).decode()
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = evil
    path = write(tmp_path / "evil.zip", {**contents(good), "data": json.dumps(data).encode()})
    with safe_zips(REMEDY):
        PPO.load(path, device="cpu")
    assert not proof.exists()


TAMPERED: dict[str, dict[str, Any]] = {
    "n_steps is 0": {"n_steps": 0},
    "n_steps is 1.5": {"n_steps": 1.5},
    "n_envs is True": {"n_envs": True},
    "gamma is nan": {"gamma": float("nan")},
    "gamma is 'x'": {"gamma": "x"},
    "use_sde is 1": {"use_sde": 1},
    "n_steps 1000000000000": {"n_steps": 10**12},
    "replaces 'env'": {"env": "os:x"},
    "replaces 'learn'": {"learn": 1},
    "replaces '__class__'": {"__class__": "x"},
    "its 'more' is a Python object": {"more": {":type:": "<class 'x.Y'>", ":serialized:": "gAU="}},
    "its 'clip_range' is a Python object": {"clip_range": {":serialized:": "gAU=", "value_schedule": "eval('1')"}},
    "its 'rollout_buffer_class' is": {"rollout_buffer_class": {":serialized:": "gAU=", "__module__": "os"}},
    "its 'observation_space' is": {"observation_space": {":serialized:": "gAU=", "spaces": "{'a': MultiBinary(999999999)}"}},
    "its action_space is not described": {"action_space": 3},
}


@pytest.mark.parametrize("message", TAMPERED)
@pytest.mark.usefixtures("never_unpickled")
def test_attributes_that_were_tampered_with(message: str, good: Path, tmp_path: Path) -> None:
    data = {**json.loads(contents(good)["data"]), **TAMPERED[message]}
    path = write(tmp_path / "evil.zip", {**contents(good), "data": json.dumps(data).encode()})
    with safe_zips(REMEDY), pytest.raises(ValueError) as error:
        PPO.load(path, device="cpu")
    assert message in str(error.value) and str(path) in str(error.value)


def test_states_that_were_tampered_with(good: Path, tmp_path: Path) -> None:
    proof = tmp_path / "executed"
    members = contents(good)
    optimizer = read_model(good)[1]["policy.optimizer"]
    group = optimizer["param_groups"][0]
    moments = {"step": th.tensor(1.0), "exp_avg": th.zeros(3, 4, 5, 6)}
    system = torch_zip(pickle.dumps(Touch(proof), 2), {})
    last = optimizer["state"][max(optimizer["state"])]
    for name, content in {
        "policy.optimizer.pth": system,
        "pytorch_variables.pth": system,
        "baseline_policy.pth": system,
        "policy.optimizer.pth 1": saved({**optimizer, "state": {0: moments}}),
        "policy.optimizer.pth 2": saved({**optimizer, "param_groups": [{**group, "lr": float("nan")}]}),
        "policy.optimizer.pth 3": saved({**optimizer, "param_groups": 3}),
        "policy.optimizer.pth 4": saved([optimizer]),
        "policy.optimizer.pth 5": saved({**optimizer, "state": {0: {"step": th.tensor(float("inf"))}}}),
        "policy.optimizer.pth 6": saved({**optimizer, "state": {0: 3}}),
        "policy.optimizer.pth 7": saved({**optimizer, "param_groups": []}),
        "policy.optimizer.pth 8": saved({**optimizer, "param_groups": [{**group, "params": 3}]}),
        "policy.optimizer.pth 9": saved({**optimizer, "param_groups": [{**group, "lr": 10**400}]}),
        "policy.optimizer.pth 10": saved({**optimizer, "param_groups": [{**group, "betas": 5}]}),
        "policy.optimizer.pth 11": saved({**optimizer, "param_groups": [{**group, "capturable": True}]}),
        "policy.optimizer.pth 12": saved({**optimizer, "state": {10**6: {}}}),
        "policy.optimizer.pth 13": saved({**optimizer, "state": {n: last for n in optimizer["state"]}}),
        "pytorch_variables.pth 1": saved({"a": th.zeros(1)}),
        "pytorch_variables.pth 2": saved(th.zeros(2)),
        "baseline_policy.pth 1": saved({"a": th.zeros(1)}),
    }.items():
        member = name.split()[0]
        path = write(tmp_path / "evil.zip", {**members, member: content})
        with safe_zips(REMEDY), pytest.raises(ValueError, match=rf"evil\.zip: '{member}' in it"):
            PPO.load(path, device="cpu")
    assert not proof.exists()


def test_others_need_trust(tmp_path: Path) -> None:
    PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu").save(tmp_path / "cart.zip")
    with safe_zips(REMEDY), pytest.raises(ValueError, match=r"cart\.zip: holds the policy of another kind .* Add --trust\."):
        PPO.load(tmp_path / "cart.zip", device="cpu")
    with safe_zips():
        assert PPO.load(tmp_path / "cart.zip", device="cpu").n_steps == 8
    with safe_zips(REMEDY), safe_zips(), pytest.raises(ValueError, match="Add --trust"):
        PPO.load(tmp_path / "cart.zip", device="cpu")
    make_model(A2C, policy_kwargs=dict(TINY, net_arch=[8], activation_fn=th.nn.ReLU)).save(tmp_path / "relu.zip")
    with safe_zips(REMEDY), pytest.raises(ValueError, match=r"'activation_fn'.* Add --trust"):
        A2C.load(tmp_path / "relu.zip", device="cpu")


@pytest.mark.parametrize("env", [TaskAllocationEnv(7, 3), TaskAllocationEnv(7, 3, distribution="world"), RoutePlanningEnv(5)])
def test_spaces_are_read_from_their_text(env: Any) -> None:
    assert observation_space_of(str(env.observation_space.spaces)) == env.observation_space
    assert observation_space_of(str(env.observation_space)) == env.observation_space


@pytest.mark.parametrize(
    "space",
    [
        spaces.Dict(a=spaces.Text(3)),
        spaces.Dict(a=spaces.Box(0, 1, (2**24,))),
        spaces.Dict(a=spaces.Discrete(3), b=spaces.Dict()),
    ],
)
def test_spaces_that_are_not(space: spaces.Dict) -> None:
    assert observation_space_of(str(space.spaces)) is None


def test_an_allocator_too(tmp_path: Path) -> None:
    env = BatchedVecEnv([lambda: TaskAllocationEnv(6, 2)] * 2)
    REINFORCE(AllocatorPolicy, env, policy_kwargs=dict(TINY), device="cpu").save(tmp_path / "allocator.zip")
    with safe_zips(REMEDY):
        larger = BatchedVecEnv([lambda: TaskAllocationEnv(9, 3)] * 2)
        loaded = REINFORCE.load(tmp_path / "allocator.zip", env=larger, device="cpu")
    assert loaded.action_space == larger.action_space

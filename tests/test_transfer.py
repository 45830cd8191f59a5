"""Our zips on environments of other sizes and in other algorithms: the same decisions, and learning goes on."""

from __future__ import annotations

import base64
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav import pretrained
from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, nearest_feasible
from sb3_uav.policies import AllocatorExtractor, AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import NotOurPolicyError, load_policy
from sb3_uav.reinforce import REINFORCE, transfer

ALGORITHMS = {"reinforce": REINFORCE, "ppo": PPO, "a2c": A2C, "ppo_mask": MaskablePPO}
TINY: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)


def make_env(level: str, n_tasks: int, n_uavs: int = 3, n_envs: int = 3) -> Any:
    if level == "allocator":
        return BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks, n_uavs, max_distance=1.5)] * n_envs)
    return BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks, max_distance=1.5)] * n_envs)


def make_model(level: str, algorithm: Any, n_tasks: int = 6, n_uavs: int = 3, **policy_kwargs: Any) -> Any:
    policy: Any = AllocatorPolicy if level == "allocator" else RouterPolicy
    small = {} if algorithm is REINFORCE else {"n_steps": 12}
    small |= {"batch_size": 36} if issubclass(algorithm, PPO | MaskablePPO) else {}
    kwargs = dict(TINY, **policy_kwargs)
    return algorithm(policy, make_env(level, n_tasks, n_uavs), policy_kwargs=kwargs, device="cpu", seed=0, **small)


def state(model: Any) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def equal(a: dict[str, th.Tensor], b: dict[str, th.Tensor]) -> bool:
    return a.keys() == b.keys() and all(th.equal(value, b[name]) for name, value in a.items())


def play_greedily(model: Any, instances: Any) -> np.ndarray:
    """Actions of `predict` in the environment's step loop, one row per instance, 0 after the end."""
    env = model.get_env()
    env.set_options([{"instance": instances[row]} for row in range(env.num_envs)])
    observation, done, actions = env.reset(), np.zeros(env.num_envs, dtype=bool), []
    while not done.all():
        action, _ = model.predict(observation, deterministic=True)
        actions.append(np.where(done, 0, action))
        observation, _, dones, infos = env.step(action)
        assert all(info["illegal_actions"] == 0 for info in infos)
        done |= dones
    return np.stack(actions, axis=1)


def numbered(assignment: np.ndarray) -> np.ndarray:
    """UAVs numbered in the order of their first tasks."""
    return np.array([[list(dict.fromkeys(row)).index(uav) for uav in row] for row in assignment.tolist()])


def check_plays_as_the_zip(model: Any, path: Path, level: str, n_tasks: int, n_uavs: int) -> None:
    """Step loop at the new size = fused decoding of the policy that `load_policy` reads."""
    instances = UniformGenerator(n_tasks, n_uavs, 1.5)(3, np.random.default_rng(5))
    policy = load_policy(path, "cpu")
    expected = policy.decode_episodes(policy.arrange(instances))[:, 0].numpy()
    found = play_greedily(model, instances)
    if level == "allocator":
        # UAVs are alike before the first task, so that rounding decides which one gets it.
        found, expected = numbered(found), numbered(expected)
    assert np.array_equal(found, expected[:, : found.shape[1]]) and not expected[:, found.shape[1] :].any()


def check_learns(model: Any, n_steps: int = 100) -> None:
    before = state(model)
    model.learn(n_steps)
    after = state(model)
    assert all(th.isfinite(value).all() for value in after.values()) and not equal(before, after)


@pytest.mark.parametrize("level", ["allocator", "router"])
@pytest.mark.parametrize(("saved", "new"), [(s, n) for s in ALGORITHMS for n in ALGORITHMS if "reinforce" in (s, n)])
def test_weights_in_another_algorithm(saved: str, new: str, level: str, tmp_path: Path) -> None:
    make_model(level, ALGORITHMS[saved]).save(tmp_path / "model.zip")
    env = make_env(level, 9, 2)
    settings = transfer.fine_tuning_settings(new, env)
    model = transfer.load(tmp_path / "model", env, new, device="cpu", seed=1, **settings)
    assert type(model) is ALGORITHMS[new] and model.learning_rate == 1e-4 and model.num_timesteps == 0
    old = load_policy(tmp_path / "model.zip", "cpu").state_dict()
    kept = {name: value for name, value in old.items() if new != "reinforce" or not name.startswith("value_net.")}
    assert equal(kept, {name: value for name, value in state(model).items() if name in kept})
    if new == "reinforce":
        assert all(not value.any() for name, value in state(model).items() if name.startswith("value_net."))
    check_plays_as_the_zip(model, tmp_path / "model.zip", level, 9, 2)
    check_learns(model)


def test_rollout_baseline_starts_from_the_weights(tmp_path: Path) -> None:
    make_model("router", REINFORCE).save(tmp_path / "model.zip")
    kwargs: Any = dict(baseline="rollout", baseline_kwargs=dict(n_test_instances=4), instances_per_epoch=6)
    model = transfer.load(tmp_path / "model.zip", make_env("router", 8), device="cpu", **kwargs)
    assert equal({name: value.clone() for name, value in model.baseline_policy.state_dict().items()}, state(model))
    critic = transfer.load(tmp_path / "model.zip", make_env("router", 8), baseline="critic", device="cpu")
    assert equal(state(critic), load_policy(tmp_path / "model.zip", "cpu").state_dict())


def test_policy_kwargs_of_the_zip_and_others(tmp_path: Path) -> None:
    make_model("allocator", PPO, net_arch=[8], use_values=False).save(tmp_path / "model.zip")
    model = transfer.load(tmp_path / "model.zip", make_env("allocator", 7), policy_kwargs=dict(sweep=False), device="cpu")
    assert model.policy.settings.embed_dim == 16 and not model.policy.settings.use_values and not model.policy.sweep
    assert model.get_env().get_attr("problem")[0].task_order == "input"
    with pytest.raises(ValueError, match=r"model\.zip: parameters and policy_kwargs .*'embed_dim': 32.* do not fit together"):
        transfer.load(tmp_path / "model.zip", make_env("allocator", 7), policy_kwargs=dict(embed_dim=32), device="cpu")


def test_foreign_environments_are_refused_as_by_sb3(tmp_path: Path) -> None:
    make_model("allocator", REINFORCE).save(tmp_path / "model.zip")
    foreign = gym.make("CartPole-v1")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        REINFORCE.load(tmp_path / "model.zip", env=foreign)
    assert transfer.own_spaces(tmp_path / "model.zip", foreign) == {}
    with pytest.raises(ValueError, match=r"model\.zip: AllocatorPolicy needs a TaskAllocation environment, found the space"):
        transfer.load(tmp_path / "model.zip", "CartPole-v1")

    # Like ours, but with another key: not the environment that the policy was made for.
    class Extended(TaskAllocationEnv):
        def __init__(self) -> None:
            super().__init__(8)
            known = self.problem.observation_space.spaces
            self.observation_space = gym.spaces.Dict({**known, "wind": gym.spaces.Box(0, 1, (2,))})

    with pytest.raises(ValueError, match="Observation spaces do not match"):
        REINFORCE.load(tmp_path / "model.zip", env=Extended())
    with pytest.raises(ValueError, match="found the spaces"):
        transfer.load(tmp_path / "model.zip", Extended())


def test_foreign_zips_keep_sb3s_check(tmp_path: Path) -> None:
    """A stock policy on our extractor, whose layers may be bound to a size, and CartPole's."""
    kwargs = dict(features_extractor_class=AllocatorExtractor)
    stock = REINFORCE("MultiInputPolicy", make_env("allocator", 6), policy_kwargs=kwargs)
    stock.save(tmp_path / "stock.zip")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        REINFORCE.load(tmp_path / "stock.zip", env=make_env("allocator", 8))
    assert REINFORCE.load(tmp_path / "stock.zip", env=make_env("allocator", 6)).n_envs == 3
    REINFORCE("MlpPolicy", "CartPole-v1").save(tmp_path / "cart.zip")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        REINFORCE.load(tmp_path / "cart.zip", env=make_env("allocator", 8))
    with pytest.raises(NotOurPolicyError, match="policy of another kind"):
        transfer.load(tmp_path / "cart.zip", make_env("allocator", 8))


def test_other_level_and_other_fleet_are_refused_by_name(tmp_path: Path) -> None:
    make_model("allocator", REINFORCE, preset="paper").save(tmp_path / "paper.zip")
    make_model("router", PPO).save(tmp_path / "router.zip")
    wrong = [
        ("paper.zip", make_env("router", 8), r"paper\.zip: holds AllocatorPolicy, which needs a TaskAllocation environment, "),
        (
            "router.zip",
            make_env("allocator", 8),
            r"router\.zip: holds RouterPolicy, .* this one is a TaskAllocation env",
        ),
        ("paper.zip", make_env("allocator", 8, 2), "bound to the 3 UAVs .* but the environment has 2; make one with n_uavs=3"),
    ]
    for name, env, message in wrong:
        with pytest.raises(ValueError, match=message):
            REINFORCE.load(tmp_path / name, env=env)
        with pytest.raises(ValueError, match=message):
            transfer.load(tmp_path / name, env)
    # Another number of tasks, of the same fleet.
    model = REINFORCE.load(tmp_path / "paper.zip", env=make_env("allocator", 8))
    check_plays_as_the_zip(model, tmp_path / "paper.zip", "allocator", 8, 3)


def test_custom_objects_and_file_objects_are_sb3s(tmp_path: Path) -> None:
    model = make_model("router", REINFORCE)
    model.save(tmp_path / "model.zip")
    loaded = REINFORCE.load(tmp_path / "model.zip", env=make_env("router", 8), custom_objects={"learning_rate": 0.5})
    assert loaded.learning_rate == 0.5 and loaded.n_envs == 3
    with (tmp_path / "model.zip").open("rb") as file:
        assert equal(state(REINFORCE.load(file, env=make_env("router", 6), device="cpu")), state(model))
    assert equal(state(REINFORCE.load(tmp_path / "model", device="cpu")), state(model))
    with pytest.raises(FileNotFoundError):
        REINFORCE.load(tmp_path / "none.zip", env=make_env("router", 6))


def test_transfer_unpickles_nothing(tmp_path: Path) -> None:
    proof = tmp_path / "executed"

    class Malicious:
        def __reduce__(self) -> Any:
            return Path.touch, (proof,)

    make_model("router", PPO).save(tmp_path / "model.zip")
    payload = base64.b64encode(pickle.dumps(Malicious())).decode()
    with zipfile.ZipFile(tmp_path / "model.zip") as old, zipfile.ZipFile(tmp_path / "evil.zip", "w") as new:
        data = json.loads(old.read("data"))
        for value in data.values():
            if isinstance(value, dict) and ":serialized:" in value:
                value[":serialized:"] = payload
        for name in old.namelist():
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    model = transfer.load(tmp_path / "evil.zip", make_env("router", 8), device="cpu")
    assert not proof.exists()
    assert equal(
        load_policy(tmp_path / "model.zip", "cpu").state_dict(),
        state(model)
        | {
            name: value
            for name, value in load_policy(tmp_path / "model.zip", "cpu").state_dict().items()
            if "value_net" in name
        },
    )
    pickle.loads(base64.b64decode(payload))
    assert proof.exists()


# ------------------------------------------------------------------------------------------------------------- shipped


@pytest.mark.parametrize("algorithm", ["reinforce", "ppo", "a2c", "ppo_mask"])
def test_shipped_pair_predicts_and_learns(algorithm: str) -> None:
    env = make_env("allocator", 12, 3)
    short: dict[str, Any] = dict(n_epochs=1) if algorithm.startswith("ppo") else {}
    model = pretrained.load("universal", level="allocator", env=env, algorithm=algorithm, device="cpu", seed=0, **short)
    check_plays_as_the_zip(model, pretrained.files()[0], "allocator", 12, 3)
    router = env.get_attr("problem")[0].router
    assert router is not nearest_feasible
    assert equal(router.__self__.state_dict(), load_policy(pretrained.files()[1], "cpu").state_dict())
    check_learns(model, 36)
    tours = pretrained.load(level="router", env=make_env("router", 30), algorithm=algorithm, device="cpu", seed=0, **short)
    assert isinstance(tours.policy, RouterPolicy)
    check_learns(tours, 90)


def test_shipped_pair_with_another_router_and_settings(tmp_path: Path) -> None:
    other = make_model("router", PPO)
    other.save(tmp_path / "router.zip")
    env = make_vec_env("TaskAllocation-U3-N20-v0", 2)  # a DummyVecEnv with monitors
    model = pretrained.load(env=env, router=tmp_path / "router.zip", learning_rate=5e-4, n_samples=2, device="cpu")
    assert (model.learning_rate, model.n_samples, model.baseline) == (5e-4, 2, "shared")
    assert pretrained.load(level="router", env="RoutePlanning-N20-v0", device="cpu").get_env().num_envs == 1
    for router in env.get_attr("problem"):
        assert equal(router.router.__self__.state_dict(), state(other))


def test_settings_for_fine_tuning() -> None:
    """The numbers of the documentation."""
    on_policy = dict(learning_rate=1e-4, gamma=1.0, gae_lambda=0.98, vf_coef=0.05)
    for env, n_steps, batch_size in ((TaskAllocationEnv(30), 30, 10), (RoutePlanningEnv(30), 40, 10)):
        a2c = dict(on_policy, n_steps=n_steps)
        assert transfer.fine_tuning_settings("a2c", env) == a2c
        assert transfer.fine_tuning_settings("ppo", env) == dict(a2c, n_epochs=4, batch_size=batch_size)
        expected = dict(learning_rate=1e-4, n_samples=8, baseline="shared", normalize_advantage=True, max_grad_norm=1.0)
        assert transfer.fine_tuning_settings("reinforce", env) == expected
    with pytest.raises(ValueError, match="env has the spaces of no environment of this package"):
        transfer.fine_tuning_settings("ppo", gym.make("CartPole-v1"))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(level="pilot"), "level is 'pilot'; choose 'allocator' or 'router'"),
        (dict(name="magic"), "There is no trained pair 'magic'"),
        (dict(env=None), "env is missing; give the environment"),
        (dict(level="router"), "needs a RoutePlanning environment, but this one is a TaskAllocation environment"),
        (dict(level="router", router="r.zip"), "router is 'r.zip', but only the rewards of an allocator"),
        (dict(env="CartPole-v1"), "needs a TaskAllocation environment, found the spaces"),
        (dict(algorithm="magic"), "algorithm is 'magic'; choose one of reinforce, ppo, ppo_mask, a2c or give a dotted path"),
        (dict(algorithm="sb3_uav.envs.TaskAllocationEnv"), "is not an on-policy algorithm of SB3"),
    ],
)
def test_wrong_arguments_are_named(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pretrained.load(**{"env": "TaskAllocation-U3-N20-v0", **kwargs})

"""Reading policies from zips: of every algorithm, of damaged files, and without executing what a file contains."""

from __future__ import annotations

import base64
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.envs import BatchedVecEnv, UniformGenerator
from sb3_uav.policies import AllocatorExtractor, AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE

TINY = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)


def make_model(
    algorithm: Any,
    policy: Any = AllocatorPolicy,
    env_id: str = "TaskAllocation-U3-N20-v0",
    policy_kwargs: dict[str, Any] | None = None,
) -> Any:
    env = make_vec_env(env_id, 4, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
    small = {} if algorithm is REINFORCE else {"n_steps": 16}
    return algorithm(policy, env, policy_kwargs=dict(TINY if policy_kwargs is None else policy_kwargs), device="cpu", **small)


@pytest.fixture(scope="module")
def allocator_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("zips") / "allocator.zip"
    make_model(REINFORCE).save(path)
    return path


def rewrite(source: Path, target: Path, **replaced: bytes) -> Path:
    """Copy a zip, with some of its members replaced."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, replaced.get(name.replace(".", "_"), old.read(name)))
    return target


def error_of(path: Path, **kwargs: Any) -> str:
    with pytest.raises(ValueError) as error:
        load_policy(path, "cpu", **kwargs)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("algorithm", [REINFORCE, PPO, A2C, MaskablePPO])
def test_zip_of_every_algorithm(algorithm: type[BaseAlgorithm], tmp_path: Path) -> None:
    """The loaded policy decides as the saved one, on instances of any size."""
    model = make_model(algorithm)
    model.save(tmp_path / "model.zip")
    policy = load_policy(tmp_path / "model", "cpu", AllocatorPolicy)
    assert type(policy) is AllocatorPolicy and not policy.training and policy.n_uavs is None
    for name, parameter in model.policy.state_dict().items():
        assert th.equal(parameter, policy.state_dict()[name])
    instances = UniformGenerator(33, n_uavs=3)(5, np.random.default_rng(0))
    model.policy.set_training_mode(False)
    generators = [th.Generator().manual_seed(1) for _ in range(2)]
    expected, found = (
        each.decode_episodes(instances, 4, False, generator)
        for each, generator in zip((model.policy, policy), generators, strict=True)
    )
    assert th.equal(expected, found)


@pytest.mark.parametrize("policy_kwargs", [dict(TINY, preset="paper"), dict(TINY, net_arch=dict(pi=[8], vf=[4]))])
def test_plain_policy_kwargs_are_honored(policy_kwargs: dict[str, Any], tmp_path: Path) -> None:
    model = make_model(REINFORCE, policy_kwargs=policy_kwargs)
    model.save(tmp_path / "model.zip")
    policy = load_policy(tmp_path / "model.zip", "cpu")
    assert [p.shape for p in policy.parameters()] == [p.shape for p in model.policy.parameters()]


def test_router_and_exchanged_zips(allocator_zip: Path, tmp_path: Path) -> None:
    make_model(REINFORCE, RouterPolicy, "RoutePlanning-N20-v0").save(tmp_path / "router.zip")
    router = load_policy(tmp_path / "router.zip", "cpu")
    assert type(router) is RouterPolicy
    instances = UniformGenerator(7)(3, np.random.default_rng(0))
    assert router.plan(instances).shape[0] == 3
    message = error_of(tmp_path / "router.zip", expected=AllocatorPolicy)
    assert "RouterPolicy" in message and "AllocatorPolicy is needed" in message and "exchanged" in message
    assert "RouterPolicy is needed" in error_of(allocator_zip, expected=RouterPolicy)


def test_nothing_in_the_zip_is_executed(allocator_zip: Path, tmp_path: Path) -> None:
    """Pickles in the zip are not even looked at; one in place of the tensors is refused."""
    proof = tmp_path / "executed"

    class Malicious:
        def __reduce__(self) -> Any:
            return Path.touch, (proof,)

    payload = pickle.dumps(Malicious(), protocol=2)
    pickle.loads(payload)
    assert proof.exists(), "the payload of this test does not work"
    proof.unlink()

    with zipfile.ZipFile(allocator_zip) as archive:
        data = json.loads(archive.read("data"))
    pickled = [value for value in data.values() if isinstance(value, dict) and ":serialized:" in value]
    assert len(pickled) > 3
    for value, text in zip(pickled, [payload, b"garbage"] * len(pickled), strict=False):
        value[":serialized:"] = base64.b64encode(text).decode()
    poisoned = rewrite(allocator_zip, tmp_path / "poisoned.zip", data=json.dumps(data).encode())
    expected = load_policy(allocator_zip, "cpu").state_dict()
    assert all(th.equal(value, expected[name]) for name, value in load_policy(poisoned, "cpu").state_dict().items())

    tensors = io.BytesIO()
    th.save({"features_extractor.project_context.weight": Malicious()}, tensors)
    for content in (payload, tensors.getvalue()):
        message = error_of(rewrite(allocator_zip, tmp_path / "evil.zip", policy_pth=content))
        assert "cannot be read safely" in message
    assert not proof.exists()


def test_python_objects_in_policy_kwargs(tmp_path: Path) -> None:
    """Only a pickle could bring them back, so the message says what to train with instead."""
    model = make_model(A2C, policy_kwargs=dict(TINY, net_arch=[8], activation_fn=th.nn.ReLU))
    model.save(tmp_path / "model.zip")
    message = error_of(tmp_path / "model.zip")
    assert "['activation_fn']" in message and "plain numbers" in message
    stock = make_model(PPO, "MultiInputPolicy", policy_kwargs=dict(features_extractor_class=AllocatorExtractor))
    stock.save(tmp_path / "stock.zip")
    assert "features_extractor_class" in error_of(tmp_path / "stock.zip")


def test_foreign_and_damaged_files(allocator_zip: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip: no such file"):
        load_policy(tmp_path / "nowhere.zip")
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_policy(tmp_path)

    PPO("MlpPolicy", "CartPole-v1", n_steps=16, batch_size=16, device="cpu").save(tmp_path / "cartpole.zip")
    assert "policy of another kind" in error_of(tmp_path / "cartpole.zip")

    content = allocator_zip.read_bytes()
    truncated = tmp_path / "truncated.zip"
    for size in (0, 100, len(content) // 2, len(content) - 10):
        truncated.write_bytes(content[:size])
        assert "not an intact zip" in error_of(truncated)
    flipped = tmp_path / "flipped.zip"
    middle = content.index(b"policy.pth") + 5000
    flipped.write_bytes(content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :])
    assert "not an intact zip" in error_of(flipped)

    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert "['data', 'policy.pth'] missing" in error_of(tmp_path / "other.zip")
    assert "cannot be read safely" in error_of(rewrite(allocator_zip, tmp_path / "text.zip", data=b"{not json"))
    assert "'policy_kwargs' is 3" in error_of(rewrite(allocator_zip, tmp_path / "kwargs.zip", data=b'{"policy_kwargs": 3}'))


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_parameters_that_are_not_finite(number: float, tmp_path: Path) -> None:
    model = make_model(REINFORCE)
    with th.no_grad():
        model.policy.features_extractor.encoder.embed_task.bias[3] = number
    # REINFORCE refuses to write it.
    BaseAlgorithm.save(model, tmp_path / "diverged.zip")
    message = error_of(tmp_path / "diverged.zip")
    assert f"'features_extractor.encoder.embed_task.bias' holds {number}" in message and "earlier checkpoint" in message


def test_policy_kwargs_that_do_not_fit(allocator_zip: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(allocator_zip) as archive:
        data = json.loads(archive.read("data"))
    for policy_kwargs in (
        {**TINY, "embed_dim": 32},
        {**TINY, "wings": 2},
        {**TINY, "n_heads": 3},
        {**TINY, "embed_dim": "16"},
    ):
        edited = json.dumps({**data, "policy_kwargs": policy_kwargs}).encode()
        assert "do not fit together" in error_of(rewrite(allocator_zip, tmp_path / "edited.zip", data=edited))


def test_unusable_device(allocator_zip: Path) -> None:
    with pytest.raises(ValueError, match=r"device is 'gpu', which cannot be used .*; try 'cpu'"):
        load_policy(allocator_zip, "gpu")

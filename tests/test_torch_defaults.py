"""Programs that change torch's defaults get the same networks and schedules."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch as th
from policy_helpers import LEVELS, SMALL, draw, make_policy, make_vec
from stable_baselines3 import PPO

from sb3_uav import pretrained
from sb3_uav.envs import Instances
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy


@pytest.fixture(params=["float64", "meta"])
def other_defaults(request: pytest.FixtureRequest) -> Iterator[None]:
    """Another default dtype or device; the device stands for a GPU, and nothing can be computed on it."""
    if request.param == "float64":
        th.set_default_dtype(th.float64)
    else:
        th.set_default_device("meta")
    yield
    th.set_default_dtype(th.float32)
    th.set_default_device(None)


def state_of(policy: EpisodicPolicy) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy() for name, value in policy.state_dict().items()}


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    """Instances and observations of each level, drawn with the usual defaults."""
    return {level: (draw(4, n_uavs=3 if level == "allocator" else 1), make_vec(level).reset()) for level in LEVELS}


def decisions(level: str, preset: str, instances: Instances, observation: Any) -> Any:
    """Initial parameters, fused episodes, log-probabilities and one step of SB3's loop."""
    policy = make_policy(level, preset=preset)
    actions = policy.decode_episodes(instances, 3, False, th.Generator("cpu").manual_seed(0))
    evaluation = policy.evaluate_episodes(instances, actions)
    return (
        state_of(policy),
        policy.predict(observation, deterministic=True)[0],
        actions.numpy(),
        evaluation.log_prob.detach().numpy(),
        policy.predict_values(policy.obs_to_tensor(observation)[0]).detach().numpy(),
        state_of(policy.untrained_copy(3)),
    )


@pytest.fixture(scope="module")
def usual(given: dict[str, Any]) -> dict[tuple[str, str], Any]:
    return {(level, preset): decisions(level, preset, *given[level]) for level in LEVELS for preset in ("default", "paper")}


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_networks_do_not_depend_on_torch_defaults(
    usual: dict[tuple[str, str], Any], given: dict[str, Any], other_defaults: None, level: str, preset: str
) -> None:
    """Bit-equal parameters and decisions, float32 on the CPU."""
    found = decisions(level, preset, *given[level])
    for one, two in zip(usual[level, preset], found, strict=True):
        np.testing.assert_equal(one, two)
    assert found[3].dtype == found[4].dtype == np.float32


def test_shipped_zips_do_not_depend_on_torch_defaults(other_defaults: None) -> None:
    allocator, router = pretrained.files()
    for policy in (load_policy(allocator, "cpu", AllocatorPolicy), load_policy(router, "cpu", RouterPolicy)):
        assert {(value.dtype, value.device.type) for value in policy.state_dict().values()} == {(th.float32, "cpu")}


@pytest.mark.parametrize("level", LEVELS)
def test_extractors_do_not_depend_on_torch_defaults(other_defaults: None, level: str) -> None:
    """Also when SB3's own policies make them."""
    extractor_class = make_policy(level).extractor_class
    extractor = extractor_class(make_policy(level).observation_space, **SMALL)
    assert {(value.dtype, value.device.type) for value in extractor.parameters()} == {(th.float32, "cpu")}


def test_stock_ppo_trains_with_float64_as_default() -> None:
    th.set_default_dtype(th.float64)
    try:
        kwargs: dict[str, Any] = dict(n_steps=7, batch_size=14, n_epochs=1, policy_kwargs=SMALL, device="cpu")
        policy: Any = AllocatorPolicy
        model = PPO(policy, make_vec("allocator"), **kwargs)
        model.learn(28)
        assert {parameter.dtype for parameter in model.policy.parameters()} == {th.float32}
    finally:
        th.set_default_dtype(th.float32)


def test_building_a_policy_leaves_the_defaults_alone(other_defaults: None) -> None:
    before = th.get_default_dtype(), th.get_default_device()
    make_policy("router")
    with pytest.raises(ValueError, match="preset is 'x'"):
        make_policy("router", preset="x")
    assert before == (th.get_default_dtype(), th.get_default_device())

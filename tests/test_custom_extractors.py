"""Extractors and policies of users for the two levels, in PPO and REINFORCE."""

from typing import Any

import pytest
import torch as th
from policy_helpers import LEVELS, SMALL, make_policy, make_vec
from stable_baselines3 import PPO
from test_policy_contracts import SUBCLASSES, GainAllocatorExtractor, GainRouterExtractor

from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE


class GainAllocator(AllocatorPolicy):
    extractor_class = GainAllocatorExtractor


class GainRouter(RouterPolicy):
    extractor_class = GainRouterExtractor


@pytest.mark.parametrize("algorithm", [PPO, REINFORCE])
@pytest.mark.parametrize("given", ["class", "dotted name", "subclass"])
@pytest.mark.parametrize("level", LEVELS)
def test_algorithms_train_save_and_load_them(level, given, algorithm: Any, tmp_path):
    extractor: Any = SUBCLASSES[level]
    subclass = GainAllocator if level == "allocator" else GainRouter
    named: Any = extractor if given == "class" else f"{extractor.__module__}.{extractor.__name__}"
    policy_kwargs: dict[str, Any] = {**SMALL, "sweep": False, "features_extractor_kwargs": dict(gain=2.0)}
    if given != "subclass":
        policy_kwargs["features_extractor_class"] = named
    policy: Any = subclass if given == "subclass" else subclass.__mro__[1]
    env = make_vec(level)
    settings: dict[str, Any] = dict(n_steps=8, batch_size=16, n_epochs=1) if algorithm is PPO else {}
    model = algorithm(policy, env, policy_kwargs=policy_kwargs, seed=0, device="cpu", **settings).learn(64)
    assert type(model.policy.features_extractor) is extractor
    learned: Any = model.policy.features_extractor
    assert learned.gain.item() != 2
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env, device="cpu")
    assert type(loaded.policy) is policy and type(loaded.policy.features_extractor) is extractor
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name])
    loaded.learn(32)
    # It would act as the plain policy there.
    with pytest.raises(ValueError, match="algorithm's own load"):
        load_policy(tmp_path / "model.zip")


@pytest.mark.parametrize("level", LEVELS)
def test_extractors_of_the_other_level_are_refused(level):
    other = SUBCLASSES["router" if level == "allocator" else "allocator"]
    required = "allocator.AllocatorExtractor" if level == "allocator" else "router.RouterExtractor"
    with pytest.raises(ValueError, match=rf"is {other.__name__}; it must be a subclass of sb3_uav.policies.{required}"):
        make_policy(level, features_extractor_class=other)


def test_an_extractor_class_that_does_not_fit_a_subclass_is_refused():
    class Wrong(RouterPolicy):
        extractor_class = SUBCLASSES["allocator"]  # type: ignore[assignment]

    policy = make_policy("router")
    with pytest.raises(ValueError, match="extractor_class of Wrong is GainAllocatorExtractor; it must be a subclass of"):
        Wrong(policy.observation_space, policy.action_space, lambda _: 1e-3)

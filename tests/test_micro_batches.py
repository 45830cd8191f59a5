"""Micro-batches: the same update with less memory."""

from typing import Any

import pytest
import torch as th
from reinforce_models import SMALL, make_env, make_model

from sb3_uav.reinforce import REINFORCE


def gradient(level: str, baseline: str, micro_batch_size: int | None, **kwargs: Any) -> tuple[th.Tensor, Any]:
    """The gradient of the first update, and what was logged."""
    env = make_env(level, n_envs=7)
    settings: dict[str, Any] = dict(max_grad_norm=1e9, ent_coef=0.1, micro_batch_size=micro_batch_size, **kwargs)
    model = make_model(level, baseline, env, **settings).learn_instances(7)
    parameters = [parameter for parameter in model.policy.parameters() if parameter.grad is not None]
    return th.cat([parameter.grad.flatten() for parameter in parameters]), model.logger.name_to_value


@pytest.mark.parametrize("size", [1, 3, 6])
@pytest.mark.parametrize(
    ("level", "baseline", "normalize"),
    [
        *(("allocator", "shared", True), ("allocator", "rollout", False), ("router", "shared", "instance")),
        *(("router", "critic", True), ("router", "critic", False), ("allocator", "exponential", True)),
    ],
)
def test_the_gradient_is_that_of_the_whole_batch(level, baseline, normalize, size):
    """7 instances, so that the last micro-batch is smaller; advantages, critic and entropy weigh as in the whole batch."""
    whole, whole_log = gradient(level, baseline, None, normalize_advantage=normalize)
    parts, parts_log = gradient(level, baseline, size, normalize_advantage=normalize)
    assert whole.abs().max() > 1e-2
    assert (parts - whole).abs().max() <= 1e-6 * whole.abs().max()
    assert parts_log.keys() == whole_log.keys()
    for name, value in whole_log.items():
        if name.startswith("train/"):
            assert parts_log[name] == pytest.approx(value, rel=1e-4, abs=1e-5), name


def test_training_goes_on_as_with_whole_batches():
    whole, parts = (make_model("router", micro_batch_size=size).learn_instances(40) for size in (None, 3))
    for name, value in whole.policy.state_dict().items():
        th.testing.assert_close(parts.policy.state_dict()[name], value, atol=1e-4, rtol=1e-3)


def test_batch_normalization_is_refused():
    paper = dict(SMALL, preset="paper")
    with pytest.raises(ValueError, match=r"micro_batch_size is 2, but the network has batch normalization.*lower n_envs"):
        make_model(policy_kwargs=paper, micro_batch_size=2).learn_instances(4)
    # As large as the batch is no micro-batch.
    make_model(policy_kwargs=paper, micro_batch_size=4).learn_instances(4)


@pytest.mark.parametrize("size", [0, -1, 2.5, "2", True])
def test_a_size_must_be_a_count(size):
    with pytest.raises(ValueError, match=r"micro_batch_size is .*; it must be a whole number of at least 1, or None"):
        make_model(micro_batch_size=size)


def test_it_is_kept_in_zips(tmp_path):
    model = make_model(micro_batch_size=3)
    model.save(tmp_path / "model.zip")
    assert REINFORCE.load(tmp_path / "model.zip", env=make_env()).micro_batch_size == 3

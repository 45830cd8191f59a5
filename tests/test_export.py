"""Traced and exported policies equal the original on instances that they have not seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from policy_helpers import LEVELS, make_policy, make_vec

from sb3_uav.envs import UniformGenerator
from sb3_uav.policies.export import ExportablePolicy

N_TASKS = 7
# The default network, the paper's (with batch normalization), and one with other ingredients left out.
NETWORKS: dict[str, dict[str, Any]] = {
    "default": dict(n_layers=1),
    "paper": dict(n_layers=1, preset="paper"),
    "one scorer per UAV": dict(n_layers=1, shared_scorer=False, geometry=False, normalization="layer"),
}


def observe(level: str, n_envs: int, n_tasks: int, n_steps: int, seed: int) -> dict[str, th.Tensor]:
    """Observations after some steps: other depots, tasks, values, masks and maximum flight distances for every seed."""
    generator = UniformGenerator(n_tasks, 3 if level == "allocator" else 1, max_distance=1.0 + 0.3 * seed)
    instances = generator(n_envs, np.random.default_rng(seed))
    instances.values.mul_(1.0 + seed)
    env = make_vec(level, n_envs, N_TASKS)
    env.set_options([{"instance": instances[i]} for i in range(n_envs)])
    observation = env.reset()
    for _ in range(n_steps):
        masks = env.action_masks()
        observation, *_ = env.step(masks.shape[1] - 1 - masks[:, ::-1].argmax(1))
    return {key: th.as_tensor(value) for key, value in observation.items()}


def make_exportable(level: str, network: str, output: str = "logits") -> ExportablePolicy:
    """Of a policy that has already acted, so that it keeps encodings."""
    policy = make_policy(level, **{"sweep": False, **NETWORKS[network]})
    with th.no_grad():
        for parameter in policy.parameters():
            if (parameter == 0).all():
                # Scores that start at 0 leave ties between UAVs without tasks, which rounding would break.
                parameter.normal_(std=0.3)
    policy.predict({key: value.numpy() for key, value in observe(level, 2, N_TASKS, 0, 0).items()})
    return ExportablePolicy(policy, output)


def unseen(level: str, n_envs: int = 2) -> list[dict[str, th.Tensor]]:
    return [observe(level, n_envs, n_tasks, n_steps, seed) for n_tasks, n_steps, seed in ((N_TASKS, 0, 1), (4, 2, 2))]


def assert_equal(exported: Any, exportable: ExportablePolicy, observation: dict[str, th.Tensor]) -> None:
    """The original with a cache, which must not have changed, and in SB3's own way."""
    found = exported(*(observation[name] for name in exportable.input_names)).detach()
    with th.no_grad():
        expected = exportable.policy.masked_logits(observation)
        distribution: Any = exportable.policy.get_distribution(observation).distribution
    legal = observation["action_mask"].bool()
    assert th.equal(found == -th.inf, ~legal)
    th.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    th.testing.assert_close(found.log_softmax(-1)[legal], distribution.logits[legal], atol=1e-5, rtol=0)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("network", sorted(NETWORKS))
@pytest.mark.parametrize("gradients", [False, True])
def test_jit_trace(level: str, network: str, gradients: bool) -> None:
    """Encodings that are kept from earlier steps are not baked in, nor is anything of the example."""
    exportable = make_exportable(level, network)
    with th.set_grad_enabled(gradients):
        traced = th.jit.trace(exportable, tuple(observe(level, 2, N_TASKS, 0, 0).values()))
        for observation in [*unseen(level), *unseen(level, 5)]:
            assert_equal(traced, exportable, observation)


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("network", sorted(NETWORKS))
def test_export(level: str, network: str) -> None:
    """With a batch of any size."""
    exportable = make_exportable(level, network)
    example, shapes = exportable.example_inputs(), exportable.dynamic_shapes
    exported = th.export.export(exportable, example, dynamic_shapes=shapes).module()
    for observation in [*unseen(level), *unseen(level, 5)]:
        assert_equal(exported, exportable, observation)


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_export_and_trace_of_the_policy_itself(level: str) -> None:
    """As in SB3's documentation: forward with deterministic actions."""
    policy = make_exportable(level, "default").policy
    example = observe(level, 2, N_TASKS, 0, 0)
    exported = th.export.export(policy, (example,), {"deterministic": True}).module()
    traced = th.jit.trace(policy, (example,), check_trace=False, strict=False)
    for observation in unseen(level):
        with th.no_grad():
            actions, values, log_prob = policy(observation, deterministic=True)
        found = exported(observation, deterministic=True)
        assert th.equal(found[0], actions)
        th.testing.assert_close(found[1], values, atol=1e-5, rtol=0)
        th.testing.assert_close(found[2], log_prob, atol=1e-5, rtol=0)
        sampled, traced_values, _ = traced(observation)
        assert observation["action_mask"].gather(1, sampled[:, None]).all()
        th.testing.assert_close(traced_values, values, atol=1e-5, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_onnx(level: str, tmp_path: Path) -> None:
    """ONNX Runtime chooses the same actions, for a batch of any size."""
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    exportable = make_exportable(level, "default", "action")
    names, shapes = exportable.input_names, exportable.dynamic_shapes
    example = exportable.example_inputs()
    kwargs: dict[str, Any] = dict(input_names=names, output_names=["action"], dynamic_shapes=shapes, dynamo=True)
    th.onnx.export(exportable, example, tmp_path / "policy.onnx", **kwargs)
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    # The exporter leaves out inputs that the network does not use.
    used = {value.name for value in session.get_inputs()}
    for observation in [*unseen(level), *unseen(level, 5)]:
        arrays = {name: observation[name].numpy() for name in names}
        (found,) = session.run(["action"], {name: array for name, array in arrays.items() if name in used})
        assert found.tolist() == exportable.policy.predict(arrays, deterministic=True)[0].tolist()


def test_exportable_policies_give_actions_or_logits() -> None:
    policy = make_policy("allocator")
    observation = observe("allocator", 3, N_TASKS, 1, 0)
    exportable = ExportablePolicy(policy)
    assert exportable.input_names == list(policy.observation_space.spaces)
    example = exportable.example_inputs(3)
    for name, tensor in zip(exportable.input_names, example, strict=True):
        assert tensor.shape == observation[name].shape and tensor.dtype == observation[name].dtype
    actions = exportable(*(observation[name] for name in exportable.input_names))
    assert actions.tolist() == policy.predict({k: v.numpy() for k, v in observation.items()}, deterministic=True)[0].tolist()
    with pytest.raises(ValueError, match="output is 'probabilities'; choose one of"):
        ExportablePolicy(policy, "probabilities")

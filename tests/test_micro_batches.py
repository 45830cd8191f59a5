"""Micro-batches: the same update with less memory."""

import gc
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from reinforce_models import SMALL, assert_equal_parameters, make_env, make_model
from stable_baselines3.common.logger import Logger

from sb3_uav.envs import UniformGenerator
from sb3_uav.policies import memory
from sb3_uav.reinforce import REINFORCE, memory_estimate, micro_batches
from sb3_uav.training.fixed_set_returns import draw_fixed_set, evaluate_fixed_set


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


# ------------------------------------------------------------------------------------------ memory


def test_micro_batches_are_chosen_when_the_batch_does_not_fit(monkeypatch):
    """Said in one line before the first update; the update is the same."""
    env = make_env("router", n_envs=40, n_tasks=30)
    whole = make_model("router", env=env).learn_instances(80)
    needed = memory_estimate.update_bytes(whole._micro_batches.per_instance, 40)
    monkeypatch.setattr(micro_batches, "available_memory", lambda device: round(0.99 * needed / 0.8))
    tight = make_model("router", env=make_env("router", n_envs=40, n_tasks=30))
    message = (
        r"^router: an update of 40 instances of 30 tasks, 3 samples each, needs about 0\.\d\d GiB of memory; 0\.\d\d GiB "
    )
    with pytest.warns(
        UserWarning, match=message + r"are available; its gradient is computed in micro-batches of \d+, which"
    ) as w:
        tight.learn_instances(80)
    assert len(w) == 1
    for name, value in whole.policy.state_dict().items():
        th.testing.assert_close(tight.policy.state_dict()[name], value, atol=1e-4, rtol=1e-3)


def test_batch_normalization_gets_another_remedy(monkeypatch):
    monkeypatch.setattr(micro_batches, "available_memory", lambda device: 2**20)
    model = make_model("router", env=make_env("router", 40, 30), policy_kwargs=dict(SMALL, preset="paper"))
    with pytest.warns(UserWarning, match="batch normalization forbids micro-batches: lower n_envs to about 1"):
        model.learn_instances(40)


def test_the_estimate_is_printed_and_changes_nothing(capsys, monkeypatch):
    spoken = make_model("allocator", env=make_env("allocator", 40, 30), verbose=1)
    spoken.set_logger(Logger(None, []))
    spoken.learn_instances(40)
    assert re.search(
        r"^allocator: an update of 40 instances of 30 tasks, .* GiB are available\.$", capsys.readouterr().out, re.M
    )
    monkeypatch.setattr(micro_batches, "_SMALL", 10**9)
    silent = make_model("allocator", env=make_env("allocator", 40, 30)).learn_instances(40)
    assert_equal_parameters(spoken, silent)
    assert spoken.policy.features_extractor.n_encoded_rows == silent.policy.features_extractor.n_encoded_rows


@pytest.mark.parametrize("level", ["allocator", "router"])
def test_the_estimate_counts_what_the_gradient_pass_keeps(level):
    """Twice the samples keep about twice as much; parameters are not counted."""
    policy = make_model(level).policy
    instances = UniformGenerator(30, 2 if level == "allocator" else 1)(4, np.random.default_rng(0))
    few, many = (memory_estimate.bytes_per_instance(policy, instances, n) for n in (16, 32))
    assert 1.6 * few < many < 2.4 * few
    # At least one float32 of a node embedding for each sample and step of the allocator.
    assert many > 32 * 30 * 16 * 4


def test_the_limits_of_a_container_count(tmp_path, monkeypatch):
    (tmp_path / "memory.max").write_text("max\n")
    assert memory._free_of_the_group(tmp_path) is None
    (tmp_path / "memory.max").write_text("3000\n")
    (tmp_path / "memory.current").write_text("1000\n")
    assert memory._free_of_the_group(tmp_path) == 2000
    monkeypatch.setattr(memory, "_free_of_the_group", lambda: 2000)
    monkeypatch.setattr(memory, "_free_of_the_system", lambda: None)
    assert memory.available_memory(th.device("cpu")) == 2000
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert memory.available_memory(th.device("cpu")) == 1000
    monkeypatch.setattr(memory, "_free_of_the_group", lambda: None)
    assert memory.available_memory(th.device("cpu")) is None


def test_the_benchmark_measures(capsys):
    """Its text names sizes, estimates and peaks."""
    benchmark = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "memory.py"))
    threads = th.get_num_threads()
    benchmark["measure_peak"]("router:12:4:2", 2)
    benchmark["print_estimate"]("allocator:6:4", 2)
    th.set_num_threads(threads)
    peak, estimated = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"router:12:4:2: estimated \d\.\d\d GiB, measured \d\.\d\d GiB, ratio \S+", peak)
    assert re.match(r"allocator:6:4: estimated 0\.\d\d GiB, available ", estimated)


def n_tensors() -> int:
    gc.collect()
    return sum(issubclass(type(found), th.Tensor) for found in gc.get_objects())


@pytest.mark.parametrize(("level", "size"), [("allocator", 2), ("router", None)])
def test_no_tensors_pile_up(level, size):
    """After the first updates, the optimizer has its state, and nothing is added."""
    model = make_model(level, micro_batch_size=size).learn_instances(8)
    before = n_tensors()
    model.learn_instances(40)
    assert n_tensors() == before
    problem, policy = model.problem, model.policy
    evaluate_fixed_set(policy, problem, draw_fixed_set(problem, 4, 0), 2)
    before = n_tensors()
    for seed in range(4):
        evaluate_fixed_set(policy, problem, draw_fixed_set(problem, 4, seed), 2)
    assert n_tensors() == before

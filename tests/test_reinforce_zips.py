"""Reproducibility of REINFORCE: same seeds, zips, and resumed runs."""

import io
import json
import subprocess
import sys
import zipfile
from typing import Any

import numpy as np
import pytest
import torch as th
from reinforce_models import BASELINES, SMALL, assert_equal_parameters, make_env, make_model
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_uav.reinforce import REINFORCE


@pytest.mark.parametrize("level", ["allocator", "router"])
def test_same_seed_same_parameters(level):
    first, second, other = (make_model(level, seed=seed).learn_instances(24) for seed in (0, 0, 1))
    assert_equal_parameters(first, second)
    assert any(not th.equal(a, b) for a, b in zip(first.policy.parameters(), other.policy.parameters(), strict=True))


@pytest.mark.parametrize("baseline", BASELINES)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_save_load_continue_equals_no_break(baseline, preset, tmp_path):
    kwargs: dict[str, Any] = dict(policy_kwargs={**SMALL, "preset": preset}, lr_decay=0.9)
    unbroken = make_model(baseline=baseline, **kwargs).learn_instances(40)
    broken = make_model(baseline=baseline, **kwargs).learn_instances(20)
    broken.save(tmp_path / "model")
    # Another seed given at loading must not matter either: the streams go on.
    resumed = REINFORCE.load(tmp_path / "model", env=make_env(), seed=7).learn_instances(20)
    assert_equal_parameters(unbroken, resumed)
    assert (resumed.n_instances, resumed.epoch, resumed.num_timesteps) == (40, 5, unbroken.num_timesteps)
    assert resumed.baseline_state == unbroken.baseline_state


def test_zip_holds_the_baseline_and_no_surprises(tmp_path):
    model = make_model(baseline="rollout", learning_rate=5e-2).learn_instances(40)
    model.save(tmp_path / "model.zip")
    data, parameters, _ = load_from_zip_file(tmp_path / "model.zip")
    assert set(parameters) == {"policy", "policy.optimizer", "baseline_policy"}
    assert data is not None
    assert data["baseline"] == "rollout" and "_batch" not in data and "_baseline" not in data
    raw = json.loads(zipfile.ZipFile(tmp_path / "model.zip").read("data"))
    ours = ("n_samples", "baseline", "baseline_kwargs", "instances_per_epoch", "lr_decay", "stream_seed", "baseline_state")
    for name in (*ours, "n_batches", "n_instances", "epoch", "policy_kwargs"):
        assert not (isinstance(raw[name], dict) and ":serialized:" in raw[name]), name
    loaded = REINFORCE.load(tmp_path / "model.zip")
    assert_equal_parameters(model, loaded)
    assert loaded.baseline_policy is not None
    for parameter in loaded.baseline_policy.parameters():
        assert not parameter.requires_grad


def test_zip_loads_in_a_fresh_process(tmp_path):
    model = make_model().learn_instances(8)
    model.save(tmp_path / "model")
    env = make_env()
    env.seed(3)
    observation = env.reset()
    expected = model.predict(observation, deterministic=True)[0].tolist()
    np.savez(tmp_path / "observation.npz", **observation)
    code = (
        "import sys, numpy as np; from sb3_uav.reinforce import REINFORCE; "
        "observation = dict(np.load(sys.argv[2])); model = REINFORCE.load(sys.argv[1]); "
        "print(model.predict(observation, deterministic=True)[0].tolist())"
    )
    arguments = [sys.executable, "-c", code, str(tmp_path / "model"), str(tmp_path / "observation.npz")]
    printed = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    assert json.loads(printed) == expected


def test_failed_save_keeps_the_old_zip(tmp_path, monkeypatch):
    model = make_model()
    model.save(tmp_path / "model.zip")
    before = (tmp_path / "model.zip").read_bytes()

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stable_baselines3.common.save_util.th.save", full_disk)
    with pytest.raises(OSError, match="No space left"):
        model.learn_instances(4).save(tmp_path / "model.zip")
    assert (tmp_path / "model.zip").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


def test_saves_to_a_buffer():
    buffer = io.BytesIO()
    model = make_model()
    model.save(buffer)
    assert_equal_parameters(model, REINFORCE.load(io.BytesIO(buffer.getvalue())))


@pytest.mark.parametrize(("before", "after"), [("rollout", "shared"), ("shared", "rollout")])
def test_another_baseline_after_loading(before, after, tmp_path):
    """A new rollout baseline starts as a copy of the policy."""
    model = make_model(baseline=before).learn_instances(8)
    model.save(tmp_path / "model")
    loaded: Any = REINFORCE.load(tmp_path / "model", env=make_env(), baseline=after, baseline_kwargs={})
    if after == "rollout":
        loaded._baseline.n_test_instances = 8
        for mine, copied in zip(loaded.policy.parameters(), loaded.baseline_policy.parameters(), strict=True):
            assert th.equal(mine, copied)
    assert loaded.learn_instances(8).n_instances == 16


def test_environment_can_be_set_after_loading_and_be_larger(tmp_path):
    model = make_model().learn_instances(8)
    model.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model")
    loaded.set_env(make_env())
    assert loaded.learn_instances(8).n_instances == 16
    larger = REINFORCE.load(tmp_path / "model", env=make_env(n_envs=12))
    assert larger.learn_instances(12).n_instances == 20


def test_no_instance_is_drawn_twice():
    """Reset of the environment, training batches and test of the baseline use disjoint streams, for seed 0 too."""
    model = make_model(baseline="rollout")
    drawn = []
    generator = model.problem.generator

    class Recorder:
        n_tasks, n_uavs = generator.n_tasks, generator.n_uavs

        def __call__(self, batch_size, rng):
            instances = generator(batch_size, rng)
            drawn.append(instances.depot)
            return instances

    model.problem.generator = Recorder()
    model.learn_instances(16)
    points = th.cat(drawn)
    assert len(points) == 4 + 16 + 2 * 16
    assert len(points.unique(dim=0)) == len(points)

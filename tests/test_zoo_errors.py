"""What a user of `sb3-uav train` reads when the YAML or an argument is wrong."""

import re
from typing import Any

import pytest

from sb3_uav.reinforce import REINFORCE

pytest.importorskip("rl_zoo3")
from tiny_zoo import ENV, its_with, run, write_config

from sb3_uav.zoo.configs import check_keys, read_yaml


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(learnin_rate=1), "unknown key 'learnin_rate'; did you mean 'learning_rate'?"),
        (dict(baseline="rollout", frobnicate=1), "unknown key 'frobnicate'; known keys:"),
        (dict(learning_rate="fast"), "learning_rate is 'fast'; write a number, lin_X or const_X."),
        (dict(baseline="rolout"), "baseline is 'rolout'; choose one of"),
        (dict(policy_kwargs=dict(preset="papper")), "preset is 'papper'"),
        (its_with(n_epoch=3), "an argument of 'callback' does not fit"),
        (its_with(strategy="none"), "strategy is 'none'"),
        (dict(policy_kwargs=dict(embed_dims=8)), "embed_dims"),
        (dict(policy="sb3_uav.policies.AlocatorPolicy"), "AlocatorPolicy"),
        (its_with(router=dict(policy="RouterPolicy", n_stepz=3)), "these arguments do not fit algorithm 'reinforce'"),
    ],
)
def test_typos_in_the_yaml_are_named(tmp_path, capsys, changes, message):
    config = write_config(tmp_path, **changes)
    assert run(tmp_path, config, "--eval-freq", "-1") == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.zip"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(n_envs="four"), "n_envs is 'four' (str); write a whole number, at least 1."),
        (dict(n_envs=0), "n_envs is 0 (int); write a whole number"),
        (dict(n_envs=True), "n_envs is True (bool); write a whole number"),
        (dict(n_timesteps=float("nan")), "n_timesteps is nan (float); write a whole number"),
        (dict(n_timesteps=[1]), "n_timesteps is [1] (list); write a whole number"),
        (dict(policy=None), "policy is nothing; write the name of a policy."),
        (dict(policy_kwargs="a2c"), "policy_kwargs is 'a2c' (str); write a mapping."),
        (dict(policy_kwargs="dict(embed_dim=a2c)"), "NameError: name 'a2c' is not defined"),
        (dict(policy_kwargs=[1]), "policy_kwargs is [1] (list); write a mapping."),
        (dict(env_kwargs=3), "env_kwargs is 3 (int); write a mapping."),
        (dict(env_kwargs=dict(n_tasks="many")), "TaskAllocation-U3-N20-v0: "),
        (dict(callback=5), "callback holds 5 (int); write a dotted name, or one with its arguments."),
        (dict(callback=[dict(a={}, b={})]), "callback holds {'a': {}, 'b': {}} (dict); write a dotted name"),
        (dict(callback=[{"sb3_uav.training.ITSCallback": "no"}]), "the arguments of a callback are 'no' (str)"),
        (dict(callback="nowhere.Callback"), "No module named 'nowhere'"),
        (dict(callback="no_dots"), "tiny.yml, TaskAllocation-U3-N20-v0: "),
        (dict(learning_rate=[1e-3]), "tiny.yml, TaskAllocation-U3-N20-v0: "),
    ],
)
def test_values_of_the_wrong_kind_are_named(tmp_path, capsys, changes, message):
    """The fault was a traceback, of `policy_kwargs: a2c` for one."""
    config = write_config(tmp_path, **changes)
    assert run(tmp_path, config, "--eval-freq", "-1") == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-uav train: error: ") and error.count("\n") == 1
    assert str(config) in error and message in error


def test_values_that_training_stumbles_over_are_named(tmp_path, capsys, monkeypatch):
    """The fault was a traceback, of `mixed_precision: .inf` for one, which only the first forward pass uses."""

    def refuse(self: Any, *args: Any, **kwargs: Any) -> None:
        raise TypeError("argument 'enabled' must be bool, not float")

    monkeypatch.setattr(REINFORCE, "learn", refuse)
    config = write_config(tmp_path)
    assert run(tmp_path, config, "--eval-freq", "-1") == 2
    error = capsys.readouterr().err
    assert f"{config}, {ENV}: training failed: argument 'enabled' must be bool" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"- 1\n- 2\n", "holds [1, 2] (list) instead of a mapping"),
        (b"", "holds nothing instead of a mapping"),
        (b"text", "holds 'text' (str) instead of a mapping"),
        (b"\xff\xfe\x00", "cannot be read as YAML"),
        (b"a: 2020-13-45", "cannot be read as YAML"),
        (b"[" * 3000, "cannot be read as YAML"),
        (b"a: !!python/object:os.system {}", "cannot be read as YAML"),
    ],
)
def test_files_that_hold_no_mapping_are_named(tmp_path, capsys, content, message):
    config = tmp_path / "broken.yml"
    config.write_bytes(content)
    assert run(tmp_path, config) == 2
    assert f"{config}: {message}" in capsys.readouterr().err
    with pytest.raises(ValueError, match=re.escape(f"{config}: {message}")):
        read_yaml(config)


def test_wrong_arguments_of_rl_zoo3_are_errors(tmp_path, capsys):
    """rl_zoo3 asserts that the agent to go on from is a zip."""
    agent = tmp_path / "agent.txt"
    agent.write_text("")
    assert run(tmp_path, write_config(tmp_path), "-i", str(agent)) == 2
    assert "sb3-uav train: error: The trained_agent must be a valid path to a .zip file" in capsys.readouterr().err


def test_broken_configs_are_named(tmp_path, capsys):
    config = tmp_path / "broken.yml"
    for text, message in (
        ("a: [1", "cannot be read as YAML"),
        ("other: {policy: MlpPolicy}", "Hyperparameters not found"),
        (f"{ENV}: {{policy: MlpPolicy}}", "needs at least n_timesteps and policy"),
    ):
        config.write_text(text)
        assert run(tmp_path, config) == 2
        error = capsys.readouterr().err
        assert message in error and "broken.yml" in error
    assert run(tmp_path, tmp_path / "missing.yml") == 2
    assert "missing.yml" in capsys.readouterr().err


def test_keys_that_are_no_text_are_named():
    with pytest.raises(ValueError, match="here: unknown key 3; known keys:"):
        check_keys({"policy", 3}, REINFORCE, "here")  # type: ignore[arg-type]


@pytest.mark.parametrize("router", ["nowhere.zip", dict(zip="nowhere.zip")])
def test_a_file_that_the_yaml_names_and_that_is_missing(tmp_path, capsys, router):
    config = write_config(tmp_path, **its_with(router=router))
    assert run(tmp_path, config, "--eval-freq", "-1") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert str(config) in error and ENV in error and "nowhere.zip: no such file" in error

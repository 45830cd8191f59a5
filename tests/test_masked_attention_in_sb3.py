"""The masked attention policy in zips, YAML files and the hands of users."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch as th
from foreign_envs import ALGORITHMS, POLICY, SMALL, make_env, make_model, make_policy
from stable_baselines3 import PPO
from torch import nn

from sb3_uav.policies import MaskedAttentionExtractor, MaskedAttentionPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy

# ------------------------------------------------------------------------------------------------------ save and load


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_zips_keep_the_policy(algo, tmp_path):
    names = {"nodes": "items", "context": "count", "action_mask": "legal", "padding_mask": "there"}
    env = make_env(n_real=5, n_others=1, names=names)
    kwargs = dict(node_key="items", mask_key="legal", context_key="count", padding_key="there")
    model = make_model(algo, env, policy_kwargs={**SMALL, **kwargs}).learn(64)
    model.save(tmp_path / "model")
    loaded, observation = type(model).load(tmp_path / "model", env=env, device="cpu"), env.reset()
    assert (loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]).all()
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name])
    loaded.learn(64)
    model.policy.save(tmp_path / "policy.pth")
    again = MaskedAttentionPolicy.load(tmp_path / "policy.pth", device="cpu")
    assert again.features_extractor.keys == model.policy.features_extractor.keys
    with pytest.raises(ValueError, match=r"holds a MaskedAttentionPolicy.*the algorithm's own load"):
        load_policy(tmp_path / "model.zip")


def test_trace_and_export_serve_padded_nodes():
    from sb3_uav.policies.export import ExportablePolicy

    env = make_env(3, n_real=5, n_others=1)
    policy, observation = make_policy(env), env.reset()
    exportable = ExportablePolicy(policy, "logits")
    inputs = tuple(th.as_tensor(observation[key]) for key in exportable.input_names)
    ones = exportable.example_inputs(2)
    recorded = th.jit.trace(exportable, ones, check_trace=False)
    th.testing.assert_close(recorded(*inputs), exportable(*inputs))
    exported = th.export.export(exportable, ones, dynamic_shapes=exportable.dynamic_shapes).module()
    th.testing.assert_close(exported(*inputs), exportable(*inputs))


# ---------------------------------------------------------------------------------------------------- customization


class GainExtractor(MaskedAttentionExtractor):
    """An extractor of a user, with an argument of its own."""

    def __init__(self, observation_space: Any, gain: float = 1.0, **settings: Any) -> None:
        super().__init__(observation_space, **settings)
        self.gain = nn.Parameter(th.tensor(gain))

    def decode(self, cache: Any, state: Any) -> th.Tensor:
        return self.gain * super().decode(cache, state)


class GainPolicy(MaskedAttentionPolicy):
    """A policy of a user, with another extractor."""

    extractor_class = GainExtractor


@pytest.mark.parametrize("algo", ["ppo", "reinforce"])
@pytest.mark.parametrize("given", ["class", "dotted name", "subclass"])
def test_an_extractor_of_ones_own(algo, given, tmp_path):
    named: Any = GainExtractor if given == "class" else f"{__name__}.GainExtractor"
    kwargs = {} if given == "subclass" else dict(features_extractor_class=named)
    policy_kwargs = dict(features_extractor_kwargs={**SMALL, "gain": 2.0}, **kwargs)
    env = make_env()
    model = make_model(algo, env, GainPolicy if given == "subclass" else POLICY, policy_kwargs=policy_kwargs)
    assert type(model.policy.features_extractor) is GainExtractor and model.policy.settings.embed_dim == 16
    assert model.policy.features_extractor.gain.item() == 2
    model.learn(64).save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=env, device="cpu")
    assert type(loaded.policy.features_extractor) is GainExtractor
    assert loaded.policy.features_extractor.gain.item() == model.policy.features_extractor.gain.item() != 2
    loaded.learn(64)


def test_a_setting_given_twice_is_an_error():
    with pytest.raises(ValueError, match="embed_dim is 16 in policy_kwargs and 8 in features_extractor_kwargs; give it once"):
        make_policy(make_env(), features_extractor_kwargs=dict(embed_dim=8))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (nn.Linear, r"is Linear; it must be a subclass of sb3_uav.policies.masked_attention.MaskedAttentionExtractor"),
        (RouterPolicy.extractor_class, r"is RouterExtractor; it must be a subclass of"),
        ("torch.nn.Linear", r"is Linear; it must be a subclass of"),
        (
            "no_such_package.Extractor",
            r"is .*, which cannot be imported \(No module named 'no_such_package'\); give the class",
        ),
        ("Extractor", r"is 'Extractor', which cannot be imported"),
        (3, r"is 3; it must be a subclass of"),
    ],
)
def test_extractors_that_do_not_fit_are_refused(given, message):
    with pytest.raises(ValueError, match=f"features_extractor_class of MaskedAttentionPolicy {message}"):
        make_policy(make_env(), features_extractor_class=given)


# ------------------------------------------------------------------------------------------------- the documentation

PAGE = Path(__file__).parents[1] / "docs" / "foreign_environments.md"


def test_python_of_the_documentation():
    first, second = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert "learn(20_000)" in first
    variables: dict[str, Any] = {}
    exec(first.replace("learn(20_000)", "learn(64)").replace("n_layers=1)", "n_layers=1), n_steps=64"), variables)
    assert variables["model"].policy.features_extractor.keys.node == "items" and variables["model"].num_timesteps == 64
    exec(second, variables)
    assert type(variables["model"].policy.features_extractor) is variables["Sharper"]
    assert variables["model"].policy.features_extractor.gain.item() == 1.5


@pytest.mark.slow
def test_yaml_entry_of_the_documentation(tmp_path, monkeypatch):
    """`sb3-uav train` and `enjoy` with an environment of another package."""
    pytest.importorskip("rl_zoo3")
    from sb3_uav.cli import main as cli

    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    (tmp_path / "my_package.py").write_text(
        "from gymnasium import register\nregister('Pick-v0', 'foreign_envs:PickEnv', max_episode_steps=20)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = PAGE.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0].replace("MyEnv-v0", "Pick-v0")
    (tmp_path / "my.yml").write_text(entry.replace("n_timesteps: 100000", "n_timesteps: 512"))
    command = ["--algo", "ppo", "--env", "Pick-v0", "--gym-packages", "my_package"]
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", *command, "--conf-file", "my.yml", "-f", "logs", "--eval-freq", "256"]) == 0
    (found,) = (tmp_path / "logs" / "ppo").glob("Pick-v0_1/Pick-v0.zip")
    assert isinstance(PPO.load(found, device="cpu").policy, MaskedAttentionPolicy)
    assert cli.main(["enjoy", *command, "-f", "logs", "-n", "50", "--no-render", "--trust"]) == 0

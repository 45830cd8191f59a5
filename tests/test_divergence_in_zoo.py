"""Divergence under `sb3-uav train`: exit code, message, and files."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from tiny_zoo import ENV, entry, run, write_config

pytestmark = pytest.mark.filterwarnings("ignore:.*has grown to")


class SpoilGradients(BaseCallback):
    """Turns the allocator's gradients to NaN after some steps."""

    def __init__(self, after: int = 100) -> None:
        super().__init__()
        self.after = after

    def _on_step(self) -> bool:
        if self.num_timesteps == self.after:
            for parameter in self.model.policy.parameters():
                parameter.register_hook(lambda gradient: gradient * float("nan"))
        return True


class SpoilWeights(BaseCallback):
    """As an algorithm may leave them that steps without an optimizer of torch."""

    def _on_training_end(self) -> None:
        with th.no_grad():
            next(self.model.policy.parameters()).fill_(float("nan"))

    def _on_step(self) -> bool:
        return True


def settings(algo: str, *callbacks: Any) -> dict[str, Any]:
    found = entry(callback=[{f"{__name__}.{name}": kwargs} for name, kwargs in callbacks], n_timesteps=320)
    if algo != "reinforce":
        del found["instances_per_epoch"]
        found["n_steps"] = 10
    return found


def train(tmp_path: Path, capsys: Any, algo: str, *callbacks: Any, flags: tuple[str, ...] = ()) -> tuple[int, str, list[Path]]:
    config = tmp_path / "tiny.yml"
    config.write_text(yaml.safe_dump({ENV: settings(algo, *callbacks)}))
    code = run(tmp_path, config, "--algo", algo, "--eval-freq", "-1", *flags)
    return code, capsys.readouterr().err.splitlines()[-1], sorted((tmp_path / "logs").rglob("*.zip"))


@pytest.mark.parametrize("algo", ["reinforce", "ppo", "a2c", "ppo_mask"])
def test_an_allocator_that_diverges_ends_with_code_2_and_its_last_checkpoint(algo, tmp_path, capsys):
    flags = ("--save-freq", "80")
    code, error, zips = train(tmp_path, capsys, algo, ("SpoilGradients", {}), flags=flags)
    assert code == 2
    found = re.search(r"allocator: The gradient norm is nan in update .* The last good checkpoint is (\S+\.zip);", error)
    assert found is not None and Path(found[1]).is_file() and Path(found[1]).name.startswith("rl_model_")
    assert f"{ENV}.zip" not in [path.name for path in zips], "the last zip looks final"


@pytest.mark.parametrize("algo", ["reinforce", "ppo"])
def test_the_last_zip_is_not_written_with_nan(algo, tmp_path, capsys):
    code, error, zips = train(tmp_path, capsys, algo, ("SpoilWeights", {}))
    assert code == 2 and "was not written" in error and "holds nan" in error
    assert not zips


@pytest.mark.parametrize("algo", ["reinforce", "a2c"])
def test_a_router_that_diverges_ends_with_code_2(algo, tmp_path, capsys):
    changed = entry()
    router = changed["callback"][0]["sb3_uav.training.ITSCallback"]["router"]
    router.update(dict(algo=algo, learning_rate=1e30), **({} if algo == "reinforce" else dict(n_steps=5)))
    code = run(tmp_path, write_config(tmp_path, **changed), "--eval-freq", "-1")
    error = capsys.readouterr().err.splitlines()[-1]
    assert code == 2 and "Router epoch 1 (pre-training), router: The " in error and "No checkpoint has been saved yet" in error
    assert not list((tmp_path / "logs").rglob("*.zip"))

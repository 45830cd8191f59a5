"""Training that goes on from a router or a pair that was trained before: `ITSCallback(router=...)` and `sb3-uav train -i`."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from gymnasium.envs.registration import EnvSpec
from its_runs import N_TASKS, SMALL, equal, learn, make_allocator, make_env, make_its, trace
from stable_baselines3.common.callbacks import BaseCallback
from tiny_zoo import ENV, EPOCH, NETWORK, entry, run, write_config

from sb3_uav import pretrained
from sb3_uav.envs import RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained.router_source import router_source
from sb3_uav.reinforce import REINFORCE, transfer
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT, CHECKPOINT_FOLDER, STATE_FILE, read_state

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of both levels: allocator.zip, router.zip and the checkpoint."""
    folder = tmp_path_factory.mktemp("pair")
    model = make_allocator()
    learn(model, make_its(save_path=str(folder), n_epochs=1))
    model.save(folder / "allocator.zip")
    return folder


def zips_of(folder: Path) -> tuple[dict[str, th.Tensor], dict[str, th.Tensor]]:
    checkpoint = folder / CHECKPOINT_FOLDER
    state = read_state(checkpoint)
    return tuple(load_policy(checkpoint / state[level], "cpu").state_dict() for level in ("allocator", "router"))  # type: ignore


# ------------------------------------------------------------------------------------------------------ ITSCallback


def test_router_by_zip_by_name_or_with_settings(pair: Path) -> None:
    """Its weights, the settings for fine-tuning or those given, no pre-training unless asked for."""
    expected = load_policy(pair / "router.zip", "cpu").state_dict()
    shipped = load_policy(pretrained.files()[1], "cpu").state_dict()
    zip_file = str(pair / "router.zip")
    cases: list[tuple[Any, dict[str, th.Tensor], float]] = [
        (zip_file, expected, 1e-4),
        (pair / "router.zip", expected, 1e-4),
        ("universal", shipped, 1e-4),
        ({"zip": zip_file, "learning_rate": 1e-2, "n_envs": 2}, expected, 1e-2),
        ({"pretrained": "universal", "policy": "RouterPolicy", "learning_rate": 1e-3}, shipped, 1e-3),
    ]
    for router, weights, learning_rate in cases:
        its = ITSCallback(router, n_epochs=2, n_intensive_epochs=0)
        assert its.schedule.n_pretraining_epochs == 0

        def check(its: ITSCallback = its, weights: Any = weights) -> None:
            assert equal(weights, its.router.policy.state_dict())
            assert its.training_env.get_attr("problem")[0].router == its.router.policy.plan

        its._begin_epoch = lambda original=its._begin_epoch, check=check: (check(), original())  # type: ignore
        make_allocator().learn(8 * N_TASKS, callback=its)
        made: Any = its.router
        assert (made.learning_rate, made.n_samples, made.baseline) == (learning_rate, 8, "shared")
    assert ITSCallback("universal", n_pretraining_epochs=2).schedule.n_pretraining_epochs == 2
    assert ITSCallback({"policy": "RouterPolicy"}).schedule.n_pretraining_epochs == 5


@pytest.mark.parametrize("algo", ["ppo", "a2c", "ppo_mask", "reinforce"])
def test_given_router_learns_with_any_algorithm(algo: str, pair: Path) -> None:
    before = load_policy(pair / "router.zip", "cpu").state_dict()
    # With the mean of 8 samples as the baseline, nothing would be learned where all visit all of so few tasks.
    single: dict[str, Any] = dict(n_samples=1, baseline="none") if algo == "reinforce" else {}
    its = ITSCallback({"zip": str(pair / "router.zip"), "algo": algo, **single}, n_epochs=1, strategy="alternate-only")
    learn(make_allocator(), its)
    after = its.router.policy.state_dict()
    assert trace(its) == "at" and before.keys() == after.keys() and not equal(before, after)
    assert all(th.isfinite(value).all() for value in after.values())


def set_to_one(router: Any, allocator: Any, generator: Any, rng: Any, suffix: str) -> None:
    """A warm start."""
    for name, parameter in router.named_parameters():
        if name.endswith(suffix):
            parameter.data.fill_(1.0)


def test_warm_start_of_a_given_router_when_asked_for(pair: Path) -> None:
    bias = "embed_task.bias"
    its = ITSCallback(str(pair / "router.zip"), n_epochs=1, warm_start={f"{__name__}.set_to_one": {"suffix": bias}})
    learn(make_allocator(), its, Interrupt())
    given = load_policy(pair / "router.zip", "cpu").state_dict()
    expected = {name: th.ones(8) if name.endswith(bias) else value for name, value in given.items()}
    assert equal(expected, its.router.policy.state_dict()) and not equal(given, expected)


@pytest.mark.parametrize("reset", [True, False])
@pytest.mark.parametrize("n_uavs", [2, 3])
def test_trained_allocator_with_a_given_router_starts_anew(n_uavs: int, reset: bool, pair: Path, tmp_path: Path) -> None:
    """Its zip names the checkpoint of the finished run, which a router of another run or size does not continue."""
    model = REINFORCE.load(pair / "allocator.zip", env=make_env(n_uavs=n_uavs), device="cpu")
    assert model.n_instances == 8 and getattr(model, CHECKPOINT)["folder"] == str((pair / CHECKPOINT_FOLDER).resolve())
    kwargs: dict[str, Any] = dict(n_epochs=2, strategy="alternate-only", save_path=str(tmp_path))
    its = ITSCallback("universal", **kwargs)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    new_run = rf"a new run starts at epoch 0 with it and the router {re.escape(str(pretrained.files()[1]))}\. To go on"
    with warnings.catch_warnings(), pytest.warns(UserWarning, match=new_run):
        warnings.filterwarnings("error", message="This run has")
        model.learn(16 * N_TASKS, callback=its, reset_num_timesteps=reset)
    assert trace(its) == "atat" and [record.n_instances for record in its.records] == [8] * 4
    assert (its.epoch, model.epoch, model.n_instances) == (2, 2, 16) and not equal(before, model.policy.state_dict())
    shipped = load_policy(pretrained.files()[1], "cpu").state_dict()
    assert shipped.keys() == its.router.policy.state_dict().keys()

    # That of the same router and size is continued, as by stock rl_zoo3, which tells callbacks nothing.
    folder = tmp_path / CHECKPOINT_FOLDER
    state = read_state(folder)
    again = REINFORCE.load(folder / state["allocator"], env=make_env(n_uavs=n_uavs), device="cpu")
    longer = ITSCallback("universal", **{**kwargs, "n_epochs": 3})
    again.learn(8 * N_TASKS, callback=longer, reset_num_timesteps=False)
    assert trace(longer) == "atatat" and longer.resume_from == folder
    # But not on another size.
    other = REINFORCE.load(folder / read_state(folder)["allocator"], env=make_env(n_uavs=5 - n_uavs), device="cpu")
    fresh = ITSCallback("universal", **{**kwargs, "n_epochs": 1, "save_path": None})
    with pytest.warns(UserWarning, match=new_run):
        other.learn(8 * N_TASKS, callback=fresh)
    assert trace(fresh) == "at" and fresh.resume_from is None


@pytest.mark.filterwarnings("ignore:The allocator has been trained before")
def test_instances_of_a_run_that_starts_anew(pair: Path) -> None:
    model = REINFORCE.load(pair / "allocator.zip", env=make_env(), device="cpu")
    its = ITSCallback("universal", n_epochs=4, strategy="alternate-only")
    model.learn_instances(16, callback=its)
    assert trace(its) == "atat" and model.n_instances == 16


class Interrupt(BaseCallback):
    """Ends the training at its first step, before any update."""

    def _on_step(self) -> bool:
        return False


def test_resumed_fine_tuning_equals_an_unbroken_one(pair: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = dict(n_envs=4, learning_rate=1e-2)
    router = {"zip": str(pair / "router.zip"), **settings}
    kwargs: dict[str, Any] = dict(n_epochs=3, strategy="alternate-only")

    def tuned(folder: Path | None, n_instances: int) -> tuple[Any, ITSCallback]:
        model = transfer.load(
            pair / "allocator.zip", make_env(), learning_rate=1e-2, instances_per_epoch=8, seed=3, device="cpu"
        )
        its = ITSCallback(router, save_path=None if folder is None else str(folder), **kwargs)
        model.learn(n_instances * N_TASKS, callback=its)
        return model, its

    unbroken, unbroken_its = tuned(None, 24)
    tuned(tmp_path, 8)
    checkpoint = tmp_path / CHECKPOINT_FOLDER
    state = read_state(checkpoint)
    assert state["epoch"] == 1
    resumed = REINFORCE.load(checkpoint / state["allocator"], env=make_env(), device="cpu")
    its = ITSCallback(router, resume_from=str(checkpoint), save_path=str(tmp_path), **kwargs)
    resumed.learn(16 * N_TASKS, callback=its, reset_num_timesteps=False)
    assert trace(its) == trace(unbroken_its) == "atatat"
    assert equal(unbroken.policy.state_dict(), resumed.policy.state_dict())
    assert equal(unbroken_its.router.policy.state_dict(), its.router.policy.state_dict())


@pytest.mark.parametrize(
    ("router", "error", "message"),
    [
        (7, ValueError, r"router must be the zip of a router, the name of a trained pair, or a mapping .* found 7"),
        ({"learning_rate": 1}, ValueError, "at least one of the keys 'policy', 'zip' and 'pretrained', found"),
        ("none.zip", FileNotFoundError, r"router: none\.zip: no such file; .* or one of \['universal', 'world'\]"),
        ({"zip": "none.zip"}, FileNotFoundError, r"none\.zip: no such file"),
        ({"pretrained": "magic"}, ValueError, "There is no trained pair 'magic'"),
        (
            {"zip": "a.zip", "pretrained": "universal"},
            ValueError,
            "'zip' is 'a.zip' and 'pretrained' is 'universal'",
        ),
    ],
)
def test_wrong_sources_are_named(router: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        router_source(router)
    with pytest.raises(error, match=message):
        ITSCallback(router)


def test_zips_that_are_no_router(pair: Path) -> None:
    with pytest.raises(ValueError, match=r"allocator\.zip: holds AllocatorPolicy, which needs a TaskAllocation environment"):
        learn(make_allocator(), ITSCallback(str(pair / "allocator.zip"), n_epochs=1))
    with pytest.raises(ValueError, match=r"router: policy is 'MlpPolicy', but .*router\.zip has its own; leave it out"):
        learn(make_allocator(), ITSCallback({"zip": str(pair / "router.zip"), "policy": "MlpPolicy"}, n_epochs=1))
    trained: Any = REINFORCE.load(pair / "allocator.zip", env=make_env())
    trained.its_checkpoint = None
    with pytest.raises(ValueError, match="or router to the zip of a router, to start a new run with both"):
        learn(trained, make_its())


# ------------------------------------------------------------------------------------------------------------ zoo

pytest.importorskip("rl_zoo3")


def zoo_folder(folder: Path, number: int = 1, env_id: str = ENV) -> Path:
    return folder / "logs" / "reinforce" / f"{env_id}_{number}"


def fine_tuning_config(folder: Path, **its: Any) -> Path:
    """An entry with a warm start that would take hours, which a given router does not need."""
    settings = entry()
    arguments = settings["callback"][0]["sb3_uav.training.ITSCallback"]
    # The networks are those of the pair, whatever the entry says.
    arguments["router"]["policy_kwargs"] = dict(NETWORK, embed_dim=32)
    arguments.update(warm_start={"n_subsets": 10**9, "n_updates": 10**9}, strategy="alternate-only", **its)
    return write_config(folder, policy_kwargs=dict(NETWORK, embed_dim=32), callback=settings["callback"])


@pytest.mark.slow
def test_pair_of_another_size_starts_a_new_run(pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The router is found beside it; then the new run's own checkpoint resumes exactly."""
    config = fine_tuning_config(tmp_path)
    assert run(tmp_path, config, "-i", str(pair / "allocator.zip"), "-n", str(EPOCH), "--eval-freq", "-1") == 0
    printed = capsys.readouterr().out
    assert f"Starting a new run with the weights of {pair / 'allocator.zip'} and the router {pair / 'router.zip'}" in printed
    folder = zoo_folder(tmp_path)
    model = REINFORCE.load(folder / f"{ENV}.zip", device="cpu")
    assert model.num_timesteps == EPOCH and model.n_instances == 8 and model.policy_kwargs == SMALL
    assert read_state(folder / CHECKPOINT_FOLDER)["epoch"] == 1
    for old, new in zip(zips_of(pair), zips_of(folder), strict=True):
        assert old.keys() == new.keys() and not equal(old, new)
        assert all(value.shape == new[name].shape for name, value in old.items())

    # Three epochs at once, and one with two more from its checkpoint.
    checkpoint = folder / CHECKPOINT_FOLDER
    allocator = checkpoint / read_state(checkpoint)["allocator"]
    assert run(tmp_path, config, "-i", str(allocator), "-n", str(2 * EPOCH), "--eval-freq", "-1") == 0
    assert "Starting a new run" not in capsys.readouterr().out
    assert run(tmp_path, config, "-i", str(pair / "allocator.zip"), "-n", str(3 * EPOCH), "--eval-freq", "-1") == 0
    for resumed, unbroken in zip(zips_of(zoo_folder(tmp_path, 2)), zips_of(zoo_folder(tmp_path, 3)), strict=True):
        assert equal(resumed, unbroken)


@pytest.mark.slow
def test_shipped_pair_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = fine_tuning_config(tmp_path)
    assert run(tmp_path, config, "-i", "universal", "-n", str(EPOCH), "--eval-freq", "-1") == 0
    assert f"the router {pretrained.files()[1]}" in capsys.readouterr().out
    allocator = load_policy(zoo_folder(tmp_path) / f"{ENV}.zip", "cpu")
    assert allocator.settings.mixed_precision and not allocator.settings.use_values
    assert run(tmp_path, config, "-i", "magic", "-n", str(EPOCH)) == 2
    assert (
        "-i magic: no such file; give the zip of a trained agent, or one of ['universal', 'world']" in capsys.readouterr().err
    )


class OwnRoutes(RoutePlanningEnv):
    """A router's environment of a user, whose name does not say so."""


def test_the_zip_of_a_pair_is_that_of_the_level(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fault was the allocator's zip for a user's environment."""
    from sb3_uav.zoo.fine_tuning import zip_of_pair

    for name, env_class in (("Fleet-v0", TaskAllocationEnv), ("Tours-v0", OwnRoutes)):
        monkeypatch.setitem(gym.registry, name, EnvSpec(name, entry_point=f"{env_class.__module__}:{env_class.__name__}"))
    allocator, router = pretrained.files()
    assert all(zip_of_pair("universal", env_id) == allocator for env_id in (ENV, "Fleet-v0", "CartPole-v1", None))
    assert all(zip_of_pair("universal", env_id) == router for env_id in ("RoutePlanning-N20-v0", "Tours-v0"))
    assert zip_of_pair("no pair", ENV) is None


@pytest.mark.slow
def test_routers_and_runs_without_its(pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A router's zip on tours of another size; an allocator without ITS gets its rewards from the router of the pair."""
    routing = "RoutePlanning-N20-v0"
    settings = dict(policy="sb3_uav.policies.RouterPolicy", n_envs=4, n_timesteps=80, learning_rate=1e-3)
    alone = {key: value for key, value in entry().items() if key != "callback"}
    config = tmp_path / "two.yml"
    config.write_text(yaml.safe_dump({routing: settings, ENV: alone}))
    flags = ("--eval-freq", "-1", "-n", "160")
    assert run(tmp_path, config, "--env", routing, "-i", str(pair / "router.zip"), *flags) == 0
    assert "Starting a new run with the weights of" in capsys.readouterr().out
    assert REINFORCE.load(zoo_folder(tmp_path, env_id=routing) / f"{routing}.zip").policy_kwargs == SMALL
    assert run(tmp_path, config, "--env", routing, "-i", "universal", *flags) == 0
    assert f"weights of {pretrained.files()[1]}" in capsys.readouterr().out
    assert run(tmp_path, config, "-i", str(pair / "allocator.zip"), *flags) == 0
    assert (zoo_folder(tmp_path) / "router.zip").read_bytes() == (pair / "router.zip").read_bytes()
    checkpoint = tmp_path / "rl_model_100_steps.zip"
    for source, name in (("allocator", checkpoint.name), ("router", "router_100_steps.zip"), ("router", "router.zip")):
        (tmp_path / name).write_bytes((pair / f"{source}.zip").read_bytes())
    assert run(tmp_path, config, "-i", str(checkpoint), *flags) == 0
    assert f"weights of {checkpoint} and the router {tmp_path / 'router_100_steps.zip'}" in capsys.readouterr().out
    assert run(tmp_path, config, "-i", str(pair / "router.zip"), *flags) == 2
    assert "needs a RoutePlanning environment, but this one is a TaskAllocation environment" in capsys.readouterr().err


@pytest.mark.parametrize("folder", ["", CHECKPOINT_FOLDER])
def test_the_router_of_an_allocators_zip(folder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The fault was the last router beside a checkpoint of --save-freq, in `-i` only."""
    from sb3_uav.zoo.checkpoints import find_router

    assert find_router(tmp_path / "any.zip") is None
    last = tmp_path / folder / "router.zip"
    last.parent.mkdir(exist_ok=True)
    for path in (last, tmp_path / "router_100_steps.zip", tmp_path / "best_router.zip"):
        path.touch()
    if folder:
        state = {"epoch": 1, "allocator": "allocator.zip", "router": "router.zip", "warm_started": True, "records": []}
        (last.parent / STATE_FILE).write_text(json.dumps(state))
        assert find_router(last.parent / "allocator.zip") == last
    assert find_router(tmp_path / "rl_model_100_steps.zip") == tmp_path / "router_100_steps.zip"
    assert find_router(tmp_path / "best_model.zip") == tmp_path / "best_router.zip"
    assert find_router(tmp_path / "any.zip") == last
    assert capsys.readouterr().out == ""
    assert find_router(tmp_path / "rl_model_200_steps.zip") == last
    assert "rl_model_200_steps.zip has no router of its own" in capsys.readouterr().out


@pytest.mark.slow
def test_zip_without_its_router(pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lonely = tmp_path / "lonely" / "allocator.zip"
    lonely.parent.mkdir()
    lonely.write_bytes((pair / "allocator.zip").read_bytes())
    assert run(tmp_path, fine_tuning_config(tmp_path), "-i", str(lonely), "-n", str(EPOCH)) == 2
    assert "holds its_state.json, which names its router, and there is no router.zip beside it" in capsys.readouterr().err
    # Unless the entry names one.
    settings = entry()
    settings["callback"][0]["sb3_uav.training.ITSCallback"].update(router="universal", n_pretraining_epochs=0)
    config = write_config(tmp_path, callback=settings["callback"])
    assert run(tmp_path, config, "-i", str(lonely), "-n", str(EPOCH), "--eval-freq", "-1") == 0

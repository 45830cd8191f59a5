"""Doors for the files of strangers: whatever zip, run folder or checkpoint comes in, nothing in it is executed."""

from __future__ import annotations

import base64
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from malicious_zips import FIRST, Touch, contents, one_tensor, saved, torch_zip, write
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import files
from sb3_uav.reinforce import REINFORCE, transfer
from sb3_uav.solvers import make_solver
from sb3_uav.training import PretrainedRouterCallback
from sb3_uav.training.its_checkpoint import read_state

ENV = "RoutePlanning-N20-v0"
TINY = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=16)
STATE = {"epoch": 1, "allocator": "allocator_1.zip", "router": "router_1.zip", "records": []}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("zips") / "router.zip"
    REINFORCE(RouterPolicy, ENV, policy_kwargs=dict(TINY), device="cpu").save(path)
    return path


def evil_zips(good: Path, proof: Path) -> dict[str, dict[str, bytes]]:
    """One of each kind; all of them go through the first door in ``test_malicious_zips.py``."""
    members = contents(good)
    data = json.loads(members["data"])
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = base64.b64encode(pickle.dumps(Touch(proof))).decode()
    system = torch_zip(pickle.dumps(Touch(proof), 2), {})
    layers = {**data, "policy_kwargs": {**TINY, "n_layers": 10**5}}
    return {
        "policy": {**members, "policy.pth": system},
        "raw_pickle": {**members, "policy.pth": pickle.dumps(Touch(proof))},
        "data": {**members, "data": json.dumps(data).encode()},
        "optimizer": {**members, "policy.optimizer.pth": system},
        "variables": {**members, "pytorch_variables.pth": system},
        "object": {**members, "policy.pth": saved({FIRST: Touch(proof)})},
        "stride": {**members, "policy.pth": torch_zip(one_tensor(2, (10**12,), (0,)), {"0": bytes(8)})},
        "layers": {**members, "data": json.dumps(layers).encode()},
    }


def start_with_router(path: Path) -> None:
    callback = PretrainedRouterCallback(str(path))
    model = PPO("MultiInputPolicy", "TaskAllocation-U3-N20-v0", device="cpu", n_steps=8, batch_size=8)
    model.set_logger(Logger(None, []))
    callback.init_callback(model)
    callback.on_training_start({}, {})


# Those that read the tensors of the policy only, so that what else is evil in a zip does not matter to them.
HARMLESS = {"data", "optimizer", "variables"}
DOORS: dict[str, Callable[[Path], Any]] = {
    "load_policy": lambda path: load_policy(path, "cpu", RouterPolicy),
    "dl-drl": lambda path: make_solver(f"dl-drl:allocator={files('universal')[0]},router={path}"),
    "kmeans-am": lambda path: make_solver(f"kmeans-am:router={path}"),
    "sb3": lambda path: make_solver(f"sb3:zip={path}"),
    "transfer": lambda path: transfer.load(path, BatchedVecEnv([lambda: RoutePlanningEnv(7)] * 2), device="cpu"),
    "callback": start_with_router,
}


@pytest.mark.parametrize("door", DOORS)
def test_doors_that_read_policies(door: str, good: Path, tmp_path: Path) -> None:
    proof = tmp_path / "executed"
    for name, members in evil_zips(good, proof).items():
        path = write(tmp_path / "evil.zip", members)
        if name in HARMLESS:
            DOORS[door](path)
        else:
            with pytest.raises(ValueError, match=r"evil\.zip: "):
                DOORS[door](path)
        assert not proof.exists(), name


def run_folder(folder: Path, members: dict[str, bytes]) -> Path:
    """A log folder with one run, as somebody may send it."""
    run = folder / "logs" / "reinforce" / f"{ENV}_1"
    (run / ENV).mkdir(parents=True, exist_ok=True)
    write(run / f"{ENV}.zip", members)
    (run / ENV / "config.yml").write_text("policy: RouterPolicy\n")
    (run / ENV / "args.yml").write_text(f"env: {ENV}\nenv_kwargs: null\n")
    return run


@pytest.mark.slow
def test_replaying_and_continuing_execute_nothing(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_uav.zoo import enjoy, train

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)
    proof = tmp_path / "executed"
    (tmp_path / "router.yml").write_text(
        f"{ENV}:\n  policy: RouterPolicy\n  n_timesteps: 40\n  n_envs: 2\n  instances_per_epoch: 4\n"
    )
    run_folder(tmp_path, contents(good))
    replay = ["--env", ENV, "-f", "logs", "-n", "20", "--no-render", "--device", "cpu"]
    further = ["--env", ENV, "-conf", "router.yml", "--eval-freq", "-1", "--device", "cpu", "-f", "more"]
    for name, members in {"good": contents(good), **evil_zips(good, proof)}.items():
        model = run_folder(tmp_path, members) / f"{ENV}.zip"
        harmless = name in {"good", "data"}
        capsys.readouterr()
        assert enjoy.main(replay) == (0 if harmless else 2), name
        assert harmless or f"{model.name}: " in capsys.readouterr().err
        assert train.main([*further, "-i", str(model)]) == (0 if harmless else 2), name
        assert harmless or f"{model.name}: " in capsys.readouterr().err
        assert not proof.exists(), name


HOSTILE = {
    "config.yml": {
        "!!python/object/apply:os.system ['touch executed']": "cannot be read as YAML",
        "a: !!python/name:os.system": "cannot be read as YAML",
        "env_wrapper: subprocess.Popen": "env_wrapper names code",
        "vec_env_wrapper: [{os.system: {}}]": "vec_env_wrapper names code",
        "normalize: \"__import__('os').system('touch executed')\"": "normalize is code",
        "env_kwargs: {generator: {subprocess.Popen: {args: 'touch executed', shell: true}}}": "env_kwargs names code",
        "env_kwargs: {reward: [os.system]}": "env_kwargs names code",
        "env_kwargs: {distribution: sb3_uav.common.files.write_atomically}": "env_kwargs names code",
    },
    "args.yml": {
        "env_kwargs: {generator: os.system}": "env_kwargs names code",
        "env_kwargs: !!python/object/apply:os.system ['touch executed']": "cannot be read as YAML",
    },
}


@pytest.mark.parametrize(("file", "text"), [(file, text) for file, texts in HOSTILE.items() for text in texts])
def test_settings_of_a_run_that_name_code(
    file: str, text: str, good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_uav.zoo import benchmark, enjoy

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)
    run = run_folder(tmp_path, contents(good))
    (run / ENV / file).write_text(f"env: {ENV}\n{text}\n" if ":" in text and not text.startswith("!!") else f"{text}\n")
    for command, arguments in (
        (enjoy.main, ["--env", ENV, "-f", "logs", "--no-render", "-n", "5"]),
        (benchmark.main, ["--log-dir", "logs", "-n", "5"]),
    ):
        assert command(arguments) == 2
        error = capsys.readouterr().err
        assert HOSTILE[file][text] in error and file in error and "Add --trust if you trust whoever made it" in error
    assert not (tmp_path / "executed").exists()


def test_what_the_user_names_is_his(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_uav.zoo.trust import require_plain_neighbors, require_plain_run

    (tmp_path / ENV).mkdir()
    for text in ("my_fleet.maps.River", "my_fleet.maps", "instances.npz", "sb3_uav.distributions.layouts.clustered", "1.5"):
        (tmp_path / ENV / "config.yml").write_text(f"env_kwargs: {{distribution: '{text}'}}")
        require_plain_run(tmp_path, ENV, False, ["my_fleet.envs"])
    require_plain_neighbors(tmp_path / "model.zip", ENV, False)
    (tmp_path / "replay_buffer.pkl").write_bytes(b"")
    with pytest.raises(ValueError, match=r"replay_buffer\.pkl is a pickle\. Add --trust"):
        require_plain_neighbors(tmp_path / "model.zip", ENV, False)
    require_plain_neighbors(tmp_path / "model.zip", ENV, True)


@pytest.mark.parametrize(
    "name", ["/etc/model.zip", "../model.zip", "a/../../model.zip", "..\\model.zip", "", "router_1.zip\n", "~/x.zip"]
)
def test_states_name_files_of_their_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / "its_state.json").write_text(json.dumps({**STATE, "router": name}))
    with pytest.raises(ValueError, match=r"its_state\.json: not an intact state file \(router is .*not the name of a zip"):
        read_state(tmp_path)


def test_states_name_no_links_out_of_their_folder(good: Path, tmp_path: Path) -> None:
    folder = tmp_path / "its_checkpoint"
    folder.mkdir()
    (folder / "its_state.json").write_text(json.dumps(STATE))
    assert read_state(folder)["router"] == "router_1.zip"
    try:
        os.symlink(good, folder / "router_1.zip")
    except OSError:
        pytest.skip("this system has no links")
    with pytest.raises(ValueError, match=r"router is 'router_1\.zip', a link that leads out of the folder"):
        read_state(folder)
    # The folder itself may be one.
    (folder / "router_1.zip").unlink()
    os.symlink(folder, tmp_path / "linked")
    assert read_state(tmp_path / "linked")["epoch"] == 1


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"epoch": ' + "[" * 10_000, "nested more than 64 deep"),
        ('{"epoch": ' + "9" * 5000 + "}", "a number of 100 digits or more"),
        ('{"records": [' + "{}," * 3_000_000 + "1]}", "more than the 2000000 that are read"),
        ('{"records": "' + "x" * (33 * 2**20) + '"}', "more than the 33554432 that are read"),
    ],
)
def test_states_that_are_bombs(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "its_state.json").write_text(text)
    with pytest.raises(ValueError, match=rf"its_state\.json: not an intact state file \(.*{reason}"):
        read_state(tmp_path)

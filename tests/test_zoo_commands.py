"""rl_zoo3's other commands on our run folders: videos, benchmark, plots, the Hub and Weights & Biases."""

from __future__ import annotations

import contextlib
import json
import pickle
import re
import shutil
import sys
import types
import zipfile
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from stable_baselines3.common.results_plotter import load_results

pytest.importorskip("rl_zoo3")
from tiny_zoo import ENV, EPOCH, run, write_config
from zoo_hub import Hub

from sb3_uav.cli import main as cli
from sb3_uav.envs import TaskAllocationEnv
from sb3_uav.reinforce import REINFORCE
from sb3_uav.zoo import enjoy
from sb3_uav.zoo.saved import read_saved
from sb3_uav.zoo.trust import require_plain_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log folder of two runs of both levels."""
    folder = tmp_path_factory.mktemp("commands")
    config = write_config(folder)
    for seed in ("1", "2"):
        flags = ["--eval-freq", str(EPOCH), "--eval-episodes", "4", "--save-freq", "320", "--seed", seed]
        assert run(folder, config, *flags) == 0
    return folder / "logs"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def last_run(logs: Path) -> Path:
    return logs / "reinforce" / f"{ENV}_2"


# --------------------------------------------------------------------------------------------------------------- videos


def frames_of(video: Path) -> np.ndarray:
    """``(n_frames, height, width, 3)``."""
    editor = pytest.importorskip("moviepy")
    with contextlib.closing(editor.VideoFileClip(str(video))) as clip:
        return np.stack([frame.astype(int) for frame in clip.iter_frames()])


@pytest.mark.parametrize(
    ("flags", "router", "name"),
    [
        ([], "router.zip", "final-model-reinforce"),
        (["--load-checkpoint", "320"], "router_320_steps.zip", "checkpoint-320-reinforce"),
    ],
)
def test_a_video_shows_an_episode_and_its_tours(
    logs: Path, here: Path, capsys: Any, flags: Any, router: str, name: str
) -> None:
    pytest.importorskip("moviepy")
    assert cli.main(["record-video", "--env", ENV, "-f", str(logs), "-o", "videos", *flags]) == 0
    assert f"Rewards come from the router {last_run(logs) / router}" in capsys.readouterr().out
    frames = frames_of(here / "videos" / f"{name}-{ENV}-step-0-to-step-20.mp4")
    # The start and 20 steps. Each step colors one task; the last one also draws the tours.
    assert len(frames) == 21 and frames.shape[3] == 3
    changes = [int((np.abs(after - before).max(-1) > 60).sum()) for before, after in pairwise(frames)]
    assert changes[-1] == max(changes) > 20 * np.median(changes[:-1]) > 0


def test_a_missing_agent_is_named(here: Path, capsys: Any) -> None:
    pytest.importorskip("moviepy")
    assert cli.main(["record-video", "--env", ENV]) == 2
    assert capsys.readouterr().err == "sb3-uav record-video: error: The logs/reinforce folder was not found\n"


@pytest.mark.parametrize(
    ("module", "flag"),
    [
        *(("record_video", "--load-best"), ("benchmark", "--benchmark-dir"), ("push_to_hub", "--organization")),
        *(("load_from_hub", "--force"), ("train", "--trained-agent"), ("enjoy", "--trust")),
    ],
)
def test_help_names_our_commands(module: str, flag: str, capsys: Any) -> None:
    """As modules, too."""
    main = import_module(f"sb3_uav.zoo.{module}").main
    with pytest.raises(SystemExit) as done:
        main(["--help"])
    printed = capsys.readouterr().out
    assert done.value.code == 0 and flag in printed and ("reinforce" in printed or module == "benchmark")
    assert printed.startswith(f"usage: sb3-uav {module.replace('_', '-')} ")


# ------------------------------------------------------------------------------------------------------------ benchmark


def test_benchmark_replays_with_the_router(logs: Path, here: Path, capsys: Any) -> None:
    assert cli.main(["benchmark", "--log-dir", str(logs), "-n", "60", "--benchmark-dir", "bench"]) == 0
    assert f"Rewards come from the router {last_run(logs) / 'router.zip'}" in capsys.readouterr().out
    table = (here / "bench" / "benchmark.md").read_text()
    assert (here / "benchmark.md").read_text() == table
    (row,) = [line.strip("|\n").split("|") for line in table.splitlines() if ENV in line]
    cells = [cell.strip() for cell in row]
    returns = load_results(str(here / "bench" / f"reinforce-{ENV}"))["r"]
    assert cells[:2] == ["reinforce", ENV] and cells[-2:] == ["60", "3"] and len(returns) == 3
    assert float(cells[2]) == pytest.approx(returns.mean(), abs=0.01) and 0 < returns.mean() <= 20


def test_benchmark_fails_if_an_agent_cannot_be_replayed(logs: Path, here: Path, capsys: Any) -> None:
    shutil.copytree(last_run(logs), here / "logs" / "reinforce" / f"{ENV}_1")
    (here / "logs" / "reinforce" / f"{ENV}_1" / f"{ENV}.zip").unlink()
    assert cli.main(["benchmark", "-n", "20", "--test-mode"]) == 2
    error = capsys.readouterr().err
    assert "No model found for reinforce" in error and "1 of 1 agents could not be replayed; see above." in error
    assert not (here / "benchmark.md").exists()


# ---------------------------------------------------------------------------------------------------------------- plots


@pytest.fixture
def plotting(here: Path) -> Path:
    pytest.importorskip("seaborn")
    pytest.importorskip("scipy.spatial")
    return here


def check_picture(path: Path) -> None:
    with Image.open(path) as picture:
        assert min(picture.size) > 200 and len(picture.convert("RGB").getcolors(2**24) or ()) > 20


def test_all_plots_gathers_the_evaluations(logs: Path, plotting: Path, capsys: Any) -> None:
    arguments = ["-a", "reinforce", "-e", ENV, "-f", str(logs), "-l", "pair"]
    assert cli.main(["all-plots", *arguments, "-o", "curves", "--figure", "curves.png", "--no-million"]) == 0
    printed = capsys.readouterr().out
    assert "|REINFORCE|" in printed and printed.endswith("curves.png\n")
    check_picture(plotting / "curves.png")
    with (plotting / "curves.pkl").open("rb") as file:
        found = pickle.load(file)[ENV]["REINFORCE-pair"]
    evaluations = [np.load(logs / "reinforce" / f"{ENV}_{number}" / "evaluations.npz")["results"] for number in (1, 2)]
    assert found["timesteps"].tolist() == [160, 320, 480]
    assert found["mean"] == pytest.approx(np.mean(evaluations, axis=(0, 2)))
    # From that file.
    assert cli.main(["plot-from-file", "-i", "curves", "-b", "-o", "boxes.svg", "--figure", "figure.png"]) == 0
    assert (plotting / "boxes.svg").read_text().lstrip().startswith("<?xml")
    check_picture(plotting / "figure.png")
    check_picture(plotting / "figure-2.png")


@pytest.mark.parametrize("what", ["reward", "success", "length"])
def test_plot_train_reads_the_monitor_files(logs: Path, plotting: Path, what: str) -> None:
    arguments = ["-a", "reinforce", "-e", ENV, "-f", str(logs), "-y", what, "-w", "5"]
    assert cli.main(["plot-train", *arguments, "--figure", "train.png"]) == 0
    check_picture(plotting / "train.png")


def test_plots_say_what_is_missing(logs: Path, plotting: Path, capsys: Any) -> None:
    for arguments, message in (
        (["all-plots", "-a", "reinforce"], "--env is missing; see sb3-uav all-plots --help."),
        (["plot-from-file"], "--input is missing"),
        (["all-plots", "-a", "ppo", "-e", ENV, "-f", str(logs), "--figure", "a.png"], "there is nothing to draw: no run"),
        (["plot-train", "-a", "reinforce", "-e", ENV, "-f", str(logs), "--figure", "a.png"], "there is nothing to draw"),
    ):
        assert cli.main(arguments) == 2
        assert message in capsys.readouterr().err
    assert not (plotting / "a.png").exists()


# -------------------------------------------------------------------------------------------------------------- the Hub


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)
    return Hub.install(tmp_path / "hub", monkeypatch)


PUSH = ["push-to-hub", "--env", ENV, "-orga", "me", "--n-eval-episodes", "5", "--no-render"]
REPOSITORY = {"README.md", "args.yml", "config.yml", "env_kwargs.yml", "results.json", "router.zip", "train_eval_metrics.zip"}


def test_both_levels_go_to_the_hub_and_come_back(logs: Path, here: Path, hub: Hub, capsys: Any) -> None:
    assert cli.main([*PUSH, "-f", str(logs), "-m", "a pair"]) == 0
    assert "Pushed to https://huggingface.co/me/reinforce-" in capsys.readouterr().out and hub.messages == ["a pair"]
    repository = hub.folder / "me" / f"reinforce-{ENV}"
    assert {path.name for path in repository.iterdir()} == {*REPOSITORY, f"reinforce-{ENV}.zip"}
    first = last_run(logs)
    assert (repository / "router.zip").read_bytes() == (first / "router.zip").read_bytes()
    assert (repository / f"reinforce-{ENV}.zip").read_bytes() == (first / f"{ENV}.zip").read_bytes()
    results = json.loads((repository / "results.json").read_text())
    assert 0 < results["mean_reward"] <= 20 and results["n_episodes"] == 5 and 0 <= results["success_rate"] <= 1

    assert cli.main(["load-from-hub", "--env", ENV, "-orga", "me", "-f", "mine"]) == 0
    second = here / "mine" / "reinforce" / f"{ENV}_1"
    assert f"into {Path('mine') / 'reinforce' / f'{ENV}_1'}." in capsys.readouterr().out
    for name in (f"{ENV}.zip", "router.zip", "0.monitor.csv", "evaluations.npz", "its_log.csv"):
        assert (second / name).read_bytes() == (first / name).read_bytes()
    assert read_saved(second / ENV / "config.yml") == read_saved(first / ENV / "config.yml")
    # Safe without trust.
    test_set = here / "test.npz"
    TaskAllocationEnv(20, 3, 1.5).problem.generator(2, np.random.default_rng(0)).save(test_set)
    pair = ["--allocator", str(second / f"{ENV}.zip"), "--router", str(second / "router.zip")]
    assert cli.main(["evaluate", *pair, "--instances", str(test_set), "--out", "results"]) == 0
    assert len((here / "results" / "results.csv").read_text().splitlines()) == 3
    assert enjoy.main(["--env", ENV, "-f", "mine", "-n", "20", "--no-render"]) == 0
    printed = capsys.readouterr().out
    assert "1 Episodes" in printed and f"router {Path('mine') / 'reinforce' / f'{ENV}_1' / 'router.zip'}" in printed


def test_the_model_card_says_how_to_use_it(logs: Path, here: Path, capsys: Any) -> None:
    pytest.importorskip("moviepy")
    push = [flag for flag in PUSH if flag != "--no-render"]
    assert cli.main([*push, "-f", str(logs), "--local-dir", "out", "--load-best"]) == 0
    assert "Written to out; nothing was pushed." in capsys.readouterr().out
    assert len(frames_of(here / "out" / "replay.mp4")) == 21
    assert (here / "out" / "router.zip").read_bytes() == (last_run(logs) / "best_router.zip").read_bytes()
    _, front, body = (here / "out" / "README.md").read_text().split("---\n", 2)
    results = json.loads((here / "out" / "results.json").read_text())
    card = yaml.safe_load(front)
    (result,) = card["model-index"][0]["results"]
    assert card["library_name"] == "stable-baselines3" and {ENV, "sb3_uav"} <= set(card["tags"])
    assert card["model-index"][0]["name"] == "REINFORCE" and result["dataset"]["name"] == ENV
    assert result["metrics"][0]["value"] == f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    assert f"**{results['mean_reward']:.2f}** (standard deviation {results['std_reward']:.2f})" in body
    assert "A pair of networks for the task scheduling of UAV fleets" in body and "`router.zip`" in body
    assert "**Only replay agents whose owner you trust.**" in body and "instances_per_epoch: 8" in body
    for command in re.findall(r"```bash\n(.*?)```", body, flags=re.DOTALL)[0].splitlines():
        words = command.split()
        assert words[0] == "sb3-uav" and words[1] in cli._FORWARDED
    assert (
        f"--solvers dl-drl:allocator=logs/reinforce/{ENV}_1/{ENV}.zip,router=logs/reinforce/{ENV}_1/router.zip ortools" in body
    )


@pytest.mark.parametrize("flags", [[], ["-name", "fleet"]])
def test_the_commands_of_the_model_card_run(
    flags: list[str], logs: Path, here: Path, hub: Hub, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also beside runs of the reader, which are the last ones then."""
    assert cli.main([*PUSH, "-f", str(logs), *flags]) == 0
    repository = hub.folder / "me" / (flags[1] if flags else f"reinforce-{ENV}")
    body = (repository / "README.md").read_text()
    runs = here / "logs" / "reinforce"
    shutil.copytree(last_run(logs), runs / f"{ENV}_3")
    TaskAllocationEnv(20, 3, 1.5).problem.generator(2, np.random.default_rng(0)).save(here / "my_instances.npz")
    commands = re.findall(r"```bash\n(.*?)```", body, flags=re.DOTALL)[0].splitlines()
    assert [command.split()[1] for command in commands] == ["load-from-hub", "evaluate", "enjoy"]
    for command in commands:
        name, *arguments = command.split()[1:]
        small = {
            "evaluate": [word for word in arguments if word != "ortools"],
            "enjoy": [*arguments, "-n", "20", "--no-render"],
        }
        assert cli.main([name, *small.get(name, arguments)]) == 0, capsys.readouterr().err
    assert (here / "results" / "results.csv").is_file()
    assert f"Rewards come from the router {Path('logs') / 'reinforce' / f'{ENV}_1' / 'router.zip'}" in capsys.readouterr().out


def test_the_hub_is_not_reached(here: Path, logs: Path, hub: Hub, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise RuntimeError("401 Unauthorized\nInvalid username or password.")

    monkeypatch.setattr(Hub, "create_repo", refuse)
    assert cli.main([*PUSH, "-f", str(logs)]) == 2
    error = capsys.readouterr().err
    assert f"me/reinforce-{ENV} on the Hugging Face Hub: 401 Unauthorized; log in with `hf auth login`" in error
    assert cli.main(["load-from-hub", "--env", ENV, "-orga", "nobody"]) == 2
    assert "404 Client Error; check its name and the connection." in capsys.readouterr().err
    assert not (here / "logs").exists()


def test_arguments_of_the_hub_commands(here: Path, logs: Path, hub: Hub, capsys: Any) -> None:
    (here / "full").mkdir()
    (here / "full" / "file").write_text("")
    for arguments, message in (
        ([*PUSH, "-f", str(logs), "--local-dir", "full"], "--local-dir full: is not empty; choose another folder."),
        ([*PUSH, "-f", str(logs), "--n-eval-episodes", "0"], "--n-eval-episodes is 0; it must be at least 1."),
        (["load-from-hub", "--env", ENV], "give either --organization, the owner of the repository, or --local-dir."),
        (["load-from-hub", "--env", ENV, "--local-dir", "full"], "args.yml, config.yml, reinforce-"),
    ):
        assert cli.main(arguments) == 2
        assert message in capsys.readouterr().err
    assert cli.main([*PUSH, "-f", str(logs), "--local-dir", "out"]) == 0
    load = ["load-from-hub", "--env", ENV, "--local-dir", "out"]
    assert cli.main(load) == cli.main(load) == 0
    assert (here / "logs" / "reinforce" / f"{ENV}_2").is_dir()
    assert cli.main([*load, "--exp-id", "1"]) == 2
    assert "exists; replace it with --force, or leave --exp-id out for a new run." in capsys.readouterr().err
    (here / "logs" / "reinforce" / f"{ENV}_1" / "old").write_text("")
    assert cli.main([*load, "--exp-id", "1", "--force"]) == 0
    assert not (here / "logs" / "reinforce" / f"{ENV}_1" / "old").exists()


def test_a_hostile_repository_does_nothing(here: Path, logs: Path, capsys: Any) -> None:
    """Objects in its YAML are not created, and no file leaves the run folder."""
    assert cli.main([*PUSH, "-f", str(logs), "--local-dir", "out"]) == 0
    good = (here / "out" / "config.yml").read_text()
    (here / "out" / "config.yml").write_text("callback: !!python/object/apply:os.system ['touch created']\n")
    load = ["load-from-hub", "--env", ENV, "--local-dir", "out"]
    assert cli.main(load) == 2
    assert "config.yml: cannot be read as YAML" in capsys.readouterr().err
    assert not (here / "created").exists() and not list((here / "logs").rglob("*.zip"))
    (here / "out" / "config.yml").write_text(good)
    with zipfile.ZipFile(here / "out" / "train_eval_metrics.zip", "a") as archive:
        archive.writestr("../../../../evaluations_evil.npz", "")
        archive.writestr("evil.sh", "")
        archive.writestr("nested/evaluations.npz", "")
    assert cli.main(load) == 0
    names = {path.name for path in here.rglob("*")}
    assert not names & {"evaluations_evil.npz", "evil.sh", "nested"}
    (here / "out" / "router.zip").write_bytes(b"not a zip")
    assert cli.main(load) == 2
    assert "router.zip is not a zip; it is damaged." in capsys.readouterr().err
    assert len(list((here / "logs" / "reinforce").iterdir())) == 1


def test_own_runs_need_no_trust(logs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    require_plain_run(last_run(logs), ENV, trust=False)
    (tmp_path / "downloaded_from_hub.json").write_text('{"repo_id": "a/b"}')
    require_plain_run(tmp_path, ENV, trust=False)
    (tmp_path / ENV).mkdir()
    (tmp_path / ENV / "vecnormalize.pkl").write_bytes(b"")
    with pytest.raises(ValueError, match=r"is a pickle. .* comes from a/b on the Hugging Face Hub. Add --trust"):
        require_plain_run(tmp_path, ENV, trust=False)
    require_plain_run(tmp_path, ENV, trust=True)
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    require_plain_run(tmp_path, ENV, trust=False)


# ----------------------------------------------------------------------------------------------------- Weights & Biases


def test_track_reports_to_weights_and_biases(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its name, and the hyperparameters that the training used."""
    calls: list[dict[str, Any]] = []
    later: list[dict[str, Any]] = []

    def init(**kwargs: Any) -> Any:
        calls.append(kwargs)
        return types.SimpleNamespace(config=types.SimpleNamespace(setdefaults=later.append))

    fake = types.ModuleType("wandb")
    fake.init = init  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", fake)
    config = write_config(here)
    flags = ["--track", "--wandb-project-name", "uavs", "-tags", "tiny", "--eval-freq", "-1", "-n", str(EPOCH)]
    assert run(here, config, *flags) == 0
    (call,), (noted,) = calls, later
    assert call["name"].startswith(f"{ENV}__reinforce__1__") and call["project"] == "uavs" and call["sync_tensorboard"]
    assert call["tags"][0] == "tiny" and noted["saved_hyperparams"]["instances_per_epoch"] == 8
    assert list((here / "runs" / call["name"]).rglob("events.out.tfevents.*"))
    assert REINFORCE.load(here / "logs" / "reinforce" / f"{ENV}_1" / f"{ENV}.zip").num_timesteps == EPOCH


def test_track_without_wandb_starts_nothing(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    config = write_config(here)
    assert run(here, config, "--track") == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-uav train: error: --track needs wandb") and "[track]" in error and error.count("\n") == 1
    assert {path.name for path in here.iterdir()} == {"tiny.yml"}


def test_track_without_an_account(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def init(**kwargs: Any) -> None:
        raise type("UsageError", (Exception,), {"__module__": "wandb.errors"})("No API key configured. Use `wandb login`.")

    fake = types.ModuleType("wandb")
    fake.init = init  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", fake)
    assert run(here, write_config(here), "--track") == 2
    message = "--track: No API key configured. Use `wandb login`. Or set WANDB_MODE=offline."
    assert message in capsys.readouterr().err and not (here / "logs").exists()

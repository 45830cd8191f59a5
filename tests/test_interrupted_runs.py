"""Interrupted runs of the zoo without ITS, interrupted studies, and processes whose parent is gone."""

from __future__ import annotations

import multiprocessing
import os
import shlex
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

from stable_baselines3.common.callbacks import BaseCallback
from tiny_zoo import ENV, EPOCH, run, write_config

from sb3_uav.cli.main import main
from sb3_uav.common.child_process import end_all, end_with_parent, start_module
from sb3_uav.training.fixed_set_history import EvaluationHistory
from sb3_uav.zoo.interrupted import steps_of, with_changes


def test_the_options_that_continue_replace_those_of_before() -> None:
    given = ["--env", "E", "-n", "500", "--trained-agent", "a.zip"]
    assert with_changes(given, ("-i", "b.zip")) == ["--env", "E", "-n", "500", "-i", "b.zip"]
    assert with_changes(given, ("-i", "b.zip", "-n", "20")) == ["--env", "E", "-i", "b.zip", "-n", "20"]
    assert with_changes(given, ()) == given


# -------------------------------------------------------------------------------------------------------------- trainings


class At(BaseCallback):
    """Does something at a step of the training."""

    step, act = 0, staticmethod(lambda: None)

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.step:
            self.act()
        return True


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """A callback list for the YAML, which calls a function at a step."""

    def prepare(step: int, act: Callable[[], None], *others: Any) -> dict[str, Any]:
        monkeypatch.setattr(At, "step", step)
        monkeypatch.setattr(At, "act", staticmethod(act))
        return {"callback": [*others, f"{At.__module__}.At"]}

    return prepare


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c_works")
def test_a_run_without_its_continues_where_it_was_interrupted(
    tmp_path: Path, at: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is evaluated after Ctrl-C; the state is saved under the name of a checkpoint, never under the final one."""
    evaluation = {"sb3_uav.training.FixedSetEvalCallback": {"n_instances": 4, "n_samples": 0}}
    config = write_config(tmp_path, **at(EPOCH + 1, interrupt, evaluation))
    folder = tmp_path / "logs" / "reinforce" / f"{ENV}_1"
    assert run(tmp_path, config) == 130
    line = capsys.readouterr().err.splitlines()[-1]
    (checkpoint,) = folder.glob("rl_model_*_steps.zip")
    steps = steps_of(checkpoint)
    assert not (folder / f"{ENV}.zip").exists() and EPOCH < steps < 2 * EPOCH
    assert EvaluationHistory.load(folder / "evaluations.npz").timesteps.tolist() == [0, EPOCH]
    words = shlex.split(line.partition("; continue with ")[2])
    assert words[-4:] == ["-i", str(checkpoint), "-n", str(3 * EPOCH - steps)]
    at(10**9, lambda: None)
    assert main(words[1:]) == 0
    final = folder.with_name(f"{ENV}_2") / f"{ENV}.zip"
    assert zipfile.is_zipfile(final) and steps_of(final) >= 3 * EPOCH - steps
    timesteps = EvaluationHistory.load(final.parent / "evaluations.npz").timesteps.tolist()
    assert timesteps[:2] == [0, EPOCH] and timesteps[-1] >= 3 * EPOCH


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c_works")
def test_an_interrupted_study_reports_nothing(
    tmp_path: Path, at: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    import optuna
    from optuna.storages.journal import JournalFileBackend

    config = write_config(tmp_path, **at(1, interrupt))
    storage = tmp_path / "study.log"
    flags = ["-optimize", "--n-trials", "2", "--storage", str(storage), "--study-name", "s", "--n-jobs", "1"]
    assert run(tmp_path, config, *flags) == 130
    out, err = capsys.readouterr()
    assert "Best trial" not in out and not list(tmp_path.rglob("report_*"))
    assert shlex.split(err.splitlines()[-1].partition("; continue with ")[2])[-len(flags) :] == flags
    study = optuna.load_study(study_name="s", storage=optuna.storages.JournalStorage(JournalFileBackend(str(storage))))
    assert [trial.state.name for trial in study.trials] == ["FAIL"]


# -------------------------------------------------------------------------------------------------------------- processes

needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="the kill of a parent is tried with signals")


def gone(pid: int) -> bool:
    """Whether a process, maybe of somebody else, ends within a while."""
    for _ in range(600):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
            if state == "Z":
                return True
            os.kill(pid, 0)
        except FileNotFoundError:
            return True
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def parent_of_module(folder: Path) -> None:
    os.chdir(folder)
    start_module(["sleeper"])
    time.sleep(600)


def child(folder: Path) -> None:
    end_with_parent()
    (folder / "pid").write_text(str(os.getpid()))
    time.sleep(600)


def parent_of_process(folder: Path) -> None:
    multiprocessing.get_context("spawn").Process(target=child, args=(folder,)).start()
    time.sleep(600)


@needs_signals
@pytest.mark.slow
@pytest.mark.parametrize("parent", [parent_of_module, parent_of_process])
def test_no_child_survives_a_killed_parent(parent: Callable[[Path], None], tmp_path: Path) -> None:
    (tmp_path / "sleeper.py").write_text("import os, time\nopen('pid', 'w').write(str(os.getpid()))\ntime.sleep(600)\n")
    process = multiprocessing.get_context("fork").Process(target=parent, args=(tmp_path,))
    process.start()
    note = tmp_path / "pid"
    while not note.exists() or not note.read_text():
        assert process.is_alive()
        time.sleep(0.05)
    process.kill()
    assert gone(int(note.read_text()))


@needs_signals
def test_processes_that_do_not_end_are_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_uav.common import child_process

    monkeypatch.setattr(child_process, "_PATIENCE", 0.1)
    stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", stubborn], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout as ready:
        ready.readline()
    end_all([process])
    assert process.returncode == -signal.SIGKILL

"""The trainings of `sb3-uav reproduce`: interrupted, in parallel processes, failed, and of other settings."""

from __future__ import annotations

import csv
import json
import multiprocessing
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch as th

from sb3_uav.policies.loading import load_policy
from sb3_uav.reproduce import training_processes
from sb3_uav.reproduce.pair_training import PairTraining, TrainingError, train_pair, training_entry
from sb3_uav.reproduce.pairs import Models
from sb3_uav.reproduce.scales import _SMOKE, Scenario
from sb3_uav.reproduce.training_processes import _train_in_process, _TrainingProcess, train_pairs
from sb3_uav.training.its_checkpoint import read_state, write_checkpoint
from sb3_uav.training.its_schedule import INDEPENDENT, ITS

pytest.importorskip("rl_zoo3")


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    yield
    th.set_num_threads(1)


def job(folder: Path, strategy: str = ITS, **its: Any) -> PairTraining:
    assert _SMOKE.ablation is not None
    entry = training_entry(_SMOKE, _SMOKE.ablation, Scenario(4, 80), strategy)
    entry["callback"][0]["sb3_uav.training.ITSCallback"].update(its)
    return PairTraining(Scenario(4, 80), strategy, entry, folder / "training", folder / "models" / strategy, 0, "cpu", 1)


@pytest.mark.slow
def test_an_interrupted_training_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same result as if it had not been interrupted."""
    unbroken = job(tmp_path / "unbroken")
    train_pair(unbroken)

    def interrupted(folder: Path, *args: Any) -> None:
        write_checkpoint(folder, *args)
        if read_state(folder)["epoch"] == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sb3_uav.training.its.write_checkpoint", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train_pair(job(tmp_path))
    assert not (tmp_path / "models").exists()
    with pytest.raises(TrainingError, match="holds an unfinished training with other settings; delete it"):
        train_pair(job(tmp_path, n_epochs=5))
    train_pair(job(tmp_path))
    for name in ("allocator.zip", "router.zip"):
        resumed, whole = (load_policy(folder / name) for folder in (tmp_path / "models/its", unbroken.model_folder))
        assert all(th.equal(value, resumed.state_dict()[key]) for key, value in whole.state_dict().items()), name
    columns = ("epoch", "level", "phase", "n_instances", "objective")
    logs = []
    for path in (tmp_path / "models/its/its_log.csv", unbroken.model_folder / "its_log.csv"):
        with path.open() as file:
            logs.append([[row[column] for column in columns] for row in csv.DictReader(file)])
    assert logs[0] == logs[1]
    about = json.loads((tmp_path / "models/its/training.json").read_text())
    assert about["strategy"] == ITS and about["seed"] == 0 and "torch" in about["versions"]


@pytest.mark.slow
def test_trainings_in_parallel(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jobs = [job(tmp_path / str(index), strategy, n_epochs=1) for index, strategy in enumerate((ITS, INDEPENDENT))]
    train_pairs(jobs, 2)
    assert all((j.model_folder / "allocator.zip").is_file() and (j.model_folder / "its_log.csv").is_file() for j in jobs)
    assert "2 trainings, 2 at once: U4-80, independent: allocator epoch 1 of 1" in capsys.readouterr().err


@pytest.mark.slow
def test_a_failed_training_says_where_to_look(tmp_path: Path) -> None:
    broken = job(tmp_path)
    broken.entry["learning_rat"] = 1.0
    with pytest.raises(TrainingError, match=r"Training U4-80, its failed: .*did you mean 'learning_rate'.*output\.txt"):
        train_pair(broken)


@pytest.mark.slow
def test_a_failed_process_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = job(tmp_path)
    broken.entry["learning_rat"] = 1.0
    over = SimpleNamespace(join=lambda: None, exitcode=1)
    receiver, sender = multiprocessing.Pipe(duplex=False)
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(signal, "signal", lambda *_: None)
        _train_in_process(broken, sender)
    with pytest.raises(TrainingError, match=r"failed: .*did you mean 'learning_rate'"):
        _TrainingProcess(broken, over, receiver).check()  # type: ignore[arg-type]
    sender.close()
    with pytest.raises(TrainingError, match="U4-80, its failed: its process died; was it out of memory"):
        _TrainingProcess(broken, over, receiver).check()  # type: ignore[arg-type]


def test_a_process_that_the_main_one_ends_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A KeyboardInterrupt that leaves a process of multiprocessing is printed with its traceback."""

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training_processes, "train_pair", interrupted)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    receiver, sender = multiprocessing.Pipe(duplex=False)
    with receiver, sender, pytest.raises(SystemExit) as end:
        _train_in_process(job(tmp_path), sender)
    assert end.value.code == 130


@pytest.mark.slow
def test_pairs_of_other_settings_are_not_used(tmp_path: Path) -> None:
    scenario = Scenario(4, 80)
    trained = replace(job(tmp_path), model_folder=tmp_path / "ablation/U4-N80/ITS/seed0")
    train_pair(trained)
    kwargs: dict[str, Any] = {"device": "cpu", "num_threads": 1, "training": False}
    models = Models(replace(_SMOKE, n_ablation_seeds=1), tmp_path, **kwargs)
    (model,) = models.ablation(scenario, (ITS,)).values()
    assert model.folder == trained.model_folder and model.its_log is not None
    about = trained.model_folder / "training.json"
    about.write_text(about.read_text().replace('"seed": 0', '"seed": 1'))
    with pytest.raises(TrainingError, match="was trained with other settings or another seed; delete it"):
        models.ablation(scenario, (ITS,))
    about.write_text("{")
    with pytest.raises(TrainingError, match=r"training\.json: is damaged"):
        models.ablation(scenario, (ITS,))

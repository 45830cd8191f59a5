"""`-optimize` by several workers at once, with a journal file or a database."""

import os
import pickle
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from stable_baselines3.common.callbacks import BaseCallback

pytest.importorskip("rl_zoo3")
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from sb3_uav.zoo import shared_study, train
from sb3_uav.zoo.rl_zoo3_compat import created_studies
from sb3_uav.zoo.shared_study import SeedPerTrial, fail_trials_of_dead_workers, note_worker, with_heartbeat

ENV = "RoutePlanning-N20-v0"


def open_study(storage: Any, seed: int = 1, sampler: Any = optuna.samplers.RandomSampler) -> optuna.Study:
    """What one worker has; each opens the storage itself."""
    make = SeedPerTrial(lambda seed: sampler(seed=seed), seed)
    return optuna.create_study(storage=storage(), study_name="one", load_if_exists=True, sampler=make)


@pytest.fixture(params=["journal", "sqlite"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    if request.param == "journal":
        return lambda: JournalStorage(JournalFileBackend(str(tmp_path / "study.log")))
    return lambda: with_heartbeat(f"sqlite:///{tmp_path}/study.db")


@pytest.mark.parametrize("sampler", [optuna.samplers.RandomSampler, optuna.samplers.TPESampler])
def test_workers_with_one_seed_draw_different_trials(storage: Any, sampler: Any) -> None:
    """And a single worker with the same seed draws the same again."""
    workers = [open_study(storage, sampler=sampler), open_study(storage, sampler=sampler)]
    drawn = []
    for _ in range(3):
        trials = [worker.ask() for worker in workers]
        assert trials[0].number != trials[1].number
        drawn += [(trial.suggest_float("x", 0, 1), trial.suggest_float("y", 0, 1)) for trial in trials]
        for worker, trial in zip(workers, trials, strict=True):
            worker.tell(trial, 1.0)
    assert len(set(drawn)) == 6 and all(x != y for x, y in drawn)
    alone = open_study(lambda: None)
    again = open_study(lambda: None)
    for study in (alone, again):
        study.optimize(lambda trial: trial.suggest_float("x", 0, 1) + trial.suggest_float("y", 0, 1), n_trials=3)
    assert [trial.params for trial in alone.trials] == [trial.params for trial in again.trials]


def test_reports_hold_the_sampler_itself(storage: Any) -> None:
    """rl_zoo3 pickles the study."""
    study = open_study(storage)
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1), n_trials=1)
    assert type(pickle.loads(pickle.dumps(study)).sampler) is optuna.samplers.RandomSampler


def test_trials_of_dead_workers_fail(
    storage: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of living workers, of other machines and of nobody stay."""
    study = open_study(storage)
    dead = subprocess.Popen(["true"])
    dead.wait()
    living, lost, elsewhere, unknown = (study.ask() for _ in range(4))
    note_worker(living)
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: dead.pid)
        note_worker(lost)
        patch.setattr(socket, "gethostname", lambda: "another")
        note_worker(elsewhere)
    unknown.set_user_attr("worker", "x y z")
    fail_trials_of_dead_workers(open_study(storage))
    assert [trial.state for trial in study.trials] == [
        TrialState.RUNNING,
        TrialState.FAIL,
        TrialState.RUNNING,
        TrialState.RUNNING,
    ]
    assert capsys.readouterr().out == "Trial 1 failed: its worker was killed\n"


def test_databases_have_a_heartbeat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker on another machine that tells nothing any more fails when the next trial begins."""
    monkeypatch.setattr(shared_study, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(shared_study, "GRACE_SECONDS", 1)
    url = f"sqlite:///{tmp_path}/study.db"
    with shared_study.shared_studies():
        study = optuna.create_study(storage=url, study_name="one")
    lost = study.ask()
    inner: Any = study._storage
    inner.record_heartbeat(lost._trial_id)
    monkeypatch.setattr(inner._backend, "_get_stale_trial_ids", lambda _: [lost._trial_id])
    study.optimize(lambda trial: 0.0, n_trials=1)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL, TrialState.COMPLETE]
    # Other storages are left alone.
    with created_studies(lambda storage: storage, lambda study: None):
        assert optuna.create_study().trials == []


class Killed(BaseCallback):
    """Kills the process in its second trial, as the kernel does when memory runs out."""

    trials = 0

    def _on_training_start(self) -> None:
        type(self).trials += 1
        if type(self).trials == 2 and "KILL_ME" in os.environ:
            os.kill(os.getpid(), signal.SIGKILL)

    def _on_step(self) -> bool:
        return True


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_two_workers_and_a_kill(tmp_path: Path) -> None:
    """Two at once, with one seed: no trial twice; one is killed, and the others make up for its trial."""
    entry = dict(
        policy="sb3_uav.policies.RouterPolicy",
        policy_kwargs=dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8),
        n_envs=4,
        n_timesteps=160,
        instances_per_epoch=8,
        callback=f"{__name__}.Killed",
    )
    (tmp_path / "tiny.yml").write_text(yaml.safe_dump({ENV: entry}))
    arguments = [
        *("--algo", "reinforce", "--env", ENV, "--conf-file", str(tmp_path / "tiny.yml"), "--seed", "1", "-optimize"),
        *(
            "--max-total-trials",
            "5",
            "--pruner",
            "none",
            "--sampler",
            "random",
            "--n-evaluations",
            "1",
            "--eval-episodes",
            "2",
        ),
        *("--no-optim-plots", "--study-name", "one", "--storage", str(tmp_path / "study.log"), "-f", str(tmp_path / "logs")),
    ]
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    command = [sys.executable, "-m", "sb3_uav.zoo.train", *arguments]
    with (tmp_path / "out.txt").open("w") as out:
        environments = [dict(os.environ, PYTHONPATH=paths), dict(os.environ, PYTHONPATH=paths, KILL_ME="1")]
        workers = [subprocess.Popen(command, stdout=out, stderr=out, env=environment) for environment in environments]
        codes = [worker.wait(timeout=300) for worker in workers]
    assert codes == [0, -signal.SIGKILL], (tmp_path / "out.txt").read_text()
    # Whoever comes later finds the trial that the killed one left open, if no trial began after its end.
    assert train.main(arguments) == 0
    study = optuna.load_study(study_name="one", storage=JournalStorage(JournalFileBackend(str(tmp_path / "study.log"))))
    states = [trial.state for trial in study.trials]
    assert states.count(TrialState.COMPLETE) == 5 and states.count(TrialState.FAIL) == 1 and len(states) == 6
    assert len({trial.params["learning_rate"] for trial in study.trials}) == 6
    assert len({trial.user_attrs["worker"] for trial in study.trials}) >= 2

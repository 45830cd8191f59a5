"""
One study of ``-optimize`` that several workers share, on one machine or many.

rl_zoo3 opens the storage; this module sees to it that no two workers try the same hyperparameters, and that the trial of a
worker that was killed neither counts nor stays open.
"""

from __future__ import annotations

import os
import socket
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from typing import Any

from sb3_uav.common.random_streams import mixed_state
from sb3_uav.zoo.rl_zoo3_compat import created_studies, optuna

# Databases: a worker tells every so many seconds that it is alive, and is taken for dead after some more.
HEARTBEAT_SECONDS, GRACE_SECONDS = 60, 180
_WORKER = "worker"
_DEAD = "its worker was killed"


class SeedPerTrial(optuna.samplers.BaseSampler):
    """
    A sampler with a seed of its own for each trial, which depends on the number of the trial. Workers that were all given the
    same seed would otherwise draw the same hyperparameters.

    :param make: Makes a sampler from a seed below 2**32
    :param seed: The seed of the run
    """

    def __init__(self, make: Callable[[int], optuna.samplers.BaseSampler], seed: int) -> None:
        self._make = make
        self._seed = seed
        self._samplers: dict[int, optuna.samplers.BaseSampler] = {}

    def __reduce__(self) -> str | tuple[Any, ...]:
        # rl_zoo3 pickles the study. Nothing of this process goes into the file: a reader gets the sampler itself.
        return copy, (self._make(self._seed),)

    def _of(self, trial: optuna.trial.FrozenTrial) -> optuna.samplers.BaseSampler:
        if trial.number not in self._samplers:
            self._samplers[trial.number] = self._make(int(mixed_state(self._seed, trial.number)) % 2**32)
        return self._samplers[trial.number]

    def infer_relative_search_space(
        self, study: optuna.Study, trial: optuna.trial.FrozenTrial
    ) -> dict[str, optuna.distributions.BaseDistribution]:
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self,
        study: optuna.Study,
        trial: optuna.trial.FrozenTrial,
        search_space: dict[str, optuna.distributions.BaseDistribution],
    ) -> dict[str, Any]:
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self,
        study: optuna.Study,
        trial: optuna.trial.FrozenTrial,
        param_name: str,
        param_distribution: optuna.distributions.BaseDistribution,
    ) -> Any:
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def before_trial(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        self._of(trial).before_trial(study, trial)

    def after_trial(
        self, study: optuna.Study, trial: optuna.trial.FrozenTrial, state: optuna.trial.TrialState, values: Any
    ) -> None:
        self._of(trial).after_trial(study, trial, state, values)
        del self._samplers[trial.number]


@contextmanager
def shared_studies() -> Iterator[None]:
    """Open databases with heartbeats, and fail the trials of killed workers in every study that is opened."""

    def opened(storage: Any) -> Any:
        # Files are opened by rl_zoo3.
        return with_heartbeat(storage) if isinstance(storage, str) else storage

    with created_studies(opened, fail_trials_of_dead_workers):
        yield


def with_heartbeat(url: str) -> optuna.storages.RDBStorage:
    """
    :param url: A database
    :return: The storage; trials whose worker has told nothing for some minutes fail when another one begins
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # pool_pre_ping: https://optuna.readthedocs.io/en/stable/faq.html (connections that a server has closed)
        return optuna.storages.RDBStorage(
            url,
            engine_kwargs={"pool_pre_ping": True},
            heartbeat_interval=HEARTBEAT_SECONDS,
            grace_period=GRACE_SECONDS,
        )


def note_worker(trial: optuna.Trial) -> None:
    """
    :param trial: A trial of this process, which others can tell by it
    """
    trial.set_user_attr(_WORKER, f"{_machine()} {os.getpid()}")


def fail_trials_of_dead_workers(study: optuna.Study) -> None:
    """
    Fail trials that are still running by processes of this machine that have ended. Storages in files have no heartbeat.

    :param study: The study
    """
    if sys.platform == "win32":
        # There, signal 0 is Ctrl-C.
        return
    for trial in study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,)):
        if not _is_dead(trial.user_attrs):
            continue
        # Another worker may be faster.
        study.tell(trial.number, state=optuna.trial.TrialState.FAIL, skip_if_finished=True)
        print(f"Trial {trial.number} failed: {_DEAD}")


def _is_dead(attributes: Mapping[str, Any]) -> bool:
    """:return: Whether a worker was of this machine, and has ended"""
    machine, _, process = str(attributes.get(_WORKER, "")).rpartition(" ")
    if machine != _machine() or not process.isdecimal():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        pass
    return False


def _machine() -> str:
    """The machine, or the container in it: process numbers are of one namespace."""
    try:
        namespace = os.readlink("/proc/self/ns/pid")
    except OSError:
        namespace = "-"
    return f"{socket.gethostname()} {namespace}"

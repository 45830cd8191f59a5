"""Training several pairs, one after the other or in parallel processes."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Sequence
from multiprocessing import connection
from multiprocessing.context import SpawnProcess
from typing import NamedTuple

from sb3_uav.common.child_process import end_all, end_with_parent
from sb3_uav.common.interruption import exit_code
from sb3_uav.reproduce.epoch_lines import EpochLines
from sb3_uav.reproduce.pair_training import PairTraining, TrainingError, train_pair


def train_pairs(jobs: Sequence[PairTraining], n_jobs: int) -> None:
    """
    :param jobs: Trainings
    :param n_jobs: Number of trainings at once, each in a separate process if there are several
    :raises TrainingError: If one fails; running ones are stopped, and resume from their last epochs in the next call
    :raises KeyboardInterrupt: If one is interrupted
    """
    if n_jobs == 1 or len(jobs) < 2:
        for position, job in enumerate(jobs):
            with EpochLines([job], f"training {position + 1} of {len(jobs)}: ") as lines:
                lines.print(f"{job.title}: begins")
                train_pair(job)
        return
    waiting = deque(jobs)
    running: dict[int, _TrainingProcess] = {}
    try:
        with EpochLines(jobs, f"{len(jobs)} trainings, {n_jobs} at once: ") as lines:
            while waiting or running:
                while waiting and len(running) < n_jobs:
                    training = _TrainingProcess.start(waiting.popleft())
                    lines.print(f"{training.job.title}: begins")
                    running[training.process.sentinel] = training
                for sentinel in connection.wait(list(running)):
                    assert isinstance(sentinel, int)
                    running.pop(sentinel).check()
    finally:
        end_all([training.process for training in running.values()])


class _TrainingProcess(NamedTuple):
    """
    A training in a separate process.

    :param job: The training
    :param process: The process
    :param errors: Receives the error message
    """

    job: PairTraining
    process: SpawnProcess
    errors: connection.Connection

    @classmethod
    def start(cls, job: PairTraining) -> _TrainingProcess:
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_train_in_process, args=(job, sender), daemon=True)
        process.start()
        # Only the child keeps the sending end, so that its death closes the pipe.
        sender.close()
        return cls(job, process, receiver)

    def check(self) -> None:
        """
        :raises TrainingError: If the training, which is over, failed
        """
        self.process.join()
        if self.process.exitcode != 0:
            try:
                message = self.errors.recv()
            except EOFError:
                message = f"Training {self.job.title} failed: its process died; was it out of memory?"
            raise TrainingError(message)


def _train_in_process(job: PairTraining, errors: connection.Connection) -> None:
    # Ctrl-C reaches all processes of a terminal; the main one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    try:
        train_pair(job)
    except KeyboardInterrupt:
        # The main process says so.
        raise SystemExit(exit_code()) from None
    except Exception as error:
        errors.send(str(error))
        raise SystemExit(1) from error

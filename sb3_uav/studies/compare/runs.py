"""Running trainings of the zoo in separate processes, so that finished ones are never repeated."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_uav.common.child_process import end_all, start_module
from sb3_uav.common.files import write_atomically
from sb3_uav.common.interruption import interruptible
from sb3_uav.training.fixed_set_history import RESULTS_FILE, EvaluationHistory

FINISHED_FILE = "finished.json"
_LOG_FILE = "train.log"


class ZooTraining(NamedTuple):
    """
    One run.

    :param name: Name of the variant
    :param algo: rl_zoo3's name of the algorithm
    :param env_id: Id of the environment
    :param seed: The seed
    :param n_timesteps: Minimum number of environment steps
    :param config: The YAML
    :param folder: Output folder
    :param n_threads: Number of threads
    :param device: Device of the training
    """

    name: str
    algo: str
    env_id: str
    seed: int
    n_timesteps: int
    config: Path
    folder: Path
    n_threads: int = 1
    device: str = "cpu"

    @property
    def flags(self) -> list[str]:
        """Command line arguments after ``python``."""
        flags = ["-m", "sb3_uav.zoo.train", "--algo", self.algo, "--env", self.env_id, "--conf-file", str(self.config)]
        flags += ["--log-folder", str(self.folder), "--seed", str(self.seed), "--eval-freq", "-1", "--log-interval", "-2"]
        return [*flags, "--num-threads", str(self.n_threads), "--device", self.device]

    @property
    def is_finished(self) -> bool:
        return (self.folder / FINISHED_FILE).is_file()

    @property
    def history(self) -> EvaluationHistory:
        """
        The evaluations that FixedSetEvalCallback wrote.

        :raises FileNotFoundError: If there are none
        """
        return EvaluationHistory.load(self.folder / self.algo / f"{self.env_id}_1" / RESULTS_FILE)

    def start(self) -> subprocess.Popen[bytes]:
        """:return: The process of this training"""
        if self.folder.exists():
            # An interrupted run: half a curve is of no use in a comparison.
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True)
        environment = {**os.environ, "OMP_NUM_THREADS": str(self.n_threads)}
        with (self.folder / _LOG_FILE).open("wb") as log:
            # Without the -m of python.
            return start_module(self.flags[1:], stdout=log, stderr=subprocess.STDOUT, env=environment)

    def finish(self, exit_code: int, seconds: float) -> str | None:
        """
        Mark this run as finished, if it is.

        :param exit_code: Exit code of its process
        :param seconds: Wall time of its process
        :return: What went wrong, or None if the run is complete
        """
        log = self.folder / _LOG_FILE
        if exit_code != 0:
            lines = log.read_text(errors="replace").strip().splitlines()
            return f"{log}: {lines[-1] if lines else f'exit code {exit_code}'}"
        try:
            reached = int(self.history.timesteps[-1])
        except (FileNotFoundError, ValueError) as error:
            return f"{log}: {error}"
        if reached < self.n_timesteps:
            return f"{log}: stopped after {reached} of {self.n_timesteps} steps"
        note = {"command": shlex.join(["python", *self.flags]), "process_seconds": round(seconds, 1)}
        write_atomically(self.folder / FINISHED_FILE, json.dumps(note, indent=1))
        return None


def train_all(trainings: Sequence[ZooTraining], n_jobs: int) -> None:
    """
    Run trainings side by side. If this function ends early, its processes end too.

    :param trainings: What to run, in this order
    :param n_jobs: Number of trainings at once
    :raises ValueError: If some failed; raised after all others have finished
    """
    waiting = list(trainings)
    running: list[tuple[ZooTraining, subprocess.Popen[bytes], float]] = []
    failures: list[str] = []
    with interruptible():
        try:
            while waiting or running:
                while waiting and len(running) < n_jobs:
                    training = waiting.pop(0)
                    number = len(trainings) - len(waiting)
                    print(f"[{number}/{len(trainings)}] {training.name}, seed {training.seed}", flush=True)
                    running.append((training, training.start(), time.perf_counter()))
                for job in [job for job in running if job[1].poll() is not None]:
                    running.remove(job)
                    training, process, began = job
                    failure = training.finish(process.returncode, time.perf_counter() - began)
                    failures += [] if failure is None else [failure]
                time.sleep(0.1)
        finally:
            end_all([process for _, process, _ in running])
    if failures:
        raise ValueError(f"{len(failures)} of {len(trainings)} trainings failed: {'; '.join(failures)}")

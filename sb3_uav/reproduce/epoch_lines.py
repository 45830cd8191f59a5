"""A line on the standard error for every epoch of running trainings."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from types import TracebackType

from sb3_uav.reproduce.pair_training import PairTraining

# Seconds between two reads of the logs of running trainings.
_POLL_INTERVAL = 1.0


class EpochLines:
    """
    Prints a line for every epoch that ends while the ``with`` block lasts.

    :param jobs: The trainings
    :param prefix: Prefix of every line
    """

    def __init__(self, jobs: Sequence[PairTraining], prefix: str) -> None:
        self.jobs = jobs
        self.prefix = prefix
        self._n_lines = {job.title: len(self._lines(job)) for job in jobs}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        # Trainings in this process redirect sys.stderr to a file.
        self._stream = sys.stderr

    def __enter__(self) -> EpochLines:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(_POLL_INTERVAL):
            self._look()
        self._look()

    def _look(self) -> None:
        for job in self.jobs:
            lines = self._lines(job)
            for line in lines[self._n_lines[job.title] :]:
                epoch, level, phase, _, objective, seconds = line.split(",")[:6]
                n_epochs = f" of {job.schedule.n_epochs}" if level == "allocator" else ""
                text = f"{level} epoch {epoch}{n_epochs} ({phase}): {float(objective):.2f} tasks, {float(seconds):.0f} s"
                self.print(f"{job.title}: {text}")
            self._n_lines[job.title] = len(lines)

    @staticmethod
    def _lines(job: PairTraining) -> list[str]:
        """The lines of the log of its newest run, without the header."""
        from sb3_uav.common.epoch_log import LOG_FILE

        # By their numbers, because clocks are set and folders are copied.
        numbered = {log.parent.name.rpartition("_")[2]: log for log in job.run_folder.glob(f"reinforce/*/{LOG_FILE}")}
        newest = max((number for number in numbered if number.isdecimal()), key=int, default=None)
        return [] if newest is None else numbered[newest].read_text(encoding="utf-8").splitlines()[1:]

    def print(self, text: str) -> None:
        """
        :param text: A further line
        """
        print(self.prefix + text, file=self._stream, flush=True)

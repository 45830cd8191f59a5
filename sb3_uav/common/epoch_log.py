"""What is recorded of every epoch of either level."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

LOG_FILE = "its_log.csv"


class Moment(NamedTuple):
    """
    :param wall: Seconds of a clock that is never set
    :param cpu: CPU time of the process in seconds, of all its threads
    """

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> Moment:
        """:return: The present"""
        return cls(time.perf_counter(), time.process_time())

    def since(self) -> Moment:
        """:return: The times that have passed since this moment, rounded to milliseconds"""
        return Moment(*(round(now - then, 3) for now, then in zip(Moment.now(), self, strict=True)))


@dataclass(frozen=True)
class EpochRecord:
    """
    One finished epoch of one level.

    :param epoch: Number of the epoch of this level, from 1
    :param level: ``"allocator"`` or ``"router"``
    :param phase: ``"pre-training"``, ``"intensive"`` or ``"alternate"``; of the allocator, that of the router's next block
    :param n_instances: Instances trained on in this epoch
    :param objective: Mean return of its training episodes
    :param seconds: Wall time
    :param generation_seconds: The part of it that was spent on making the router's instances, that is on allocating tasks
    :param cpu_seconds: CPU time of the process, of all its threads
    """

    epoch: int
    level: str
    phase: str
    n_instances: int
    objective: float
    seconds: float
    generation_seconds: float = 0.0
    cpu_seconds: float = 0.0


def log_text(records: Sequence[EpochRecord]) -> str:
    """
    :param records: Epochs
    :return: The contents of ``its_log.csv``
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(EpochRecord.__annotations__))
    writer.writeheader()
    writer.writerows(asdict(record) for record in records)
    return text.getvalue()


class EpisodeStatistics(BaseCallback):
    """Mean return of the episodes since the last :meth:`reset_statistics`."""

    def __init__(self) -> None:
        super().__init__()
        self.reset_statistics()

    def reset_statistics(self) -> None:
        """Begin with no episodes."""
        self.n_episodes, self.total_return = 0, 0.0

    @property
    def mean_return(self) -> float:
        return self.total_return / self.n_episodes if self.n_episodes > 0 else float("nan")

    def count(self, variables: dict[str, Any]) -> None:
        """:param variables: The local variables of a rollout, as callbacks get them"""
        if not np.any(variables["dones"]):
            return
        returns = [info["episode"]["r"] for info in variables["infos"] if "episode" in info]
        self.n_episodes += len(returns)
        self.total_return += float(sum(returns))

    def _on_step(self) -> bool:
        self.count(self.locals)
        return True

"""Trainings that rl_zoo3 would take for finished although they were interrupted, and where they go on."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback

from sb3_uav.common.interruption import without_option
from sb3_uav.common.saving import save_atomically


class Watched:
    """
    An algorithm whose interruption is noted: rl_zoo3 takes Ctrl-C for the end of the training, and saves the final model.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L254

    :param model: The algorithm
    :param on_failure: Called when its training ends with an exception, before rl_zoo3 learns of it
    """

    def __init__(self, model: BaseAlgorithm, on_failure: Callable[[], None] = lambda: None) -> None:
        self.model = model
        self.on_failure = on_failure
        self.interruption: BaseException | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)

    def learn(self, *args: Any, **kwargs: Any) -> None:
        """:raises KeyboardInterrupt: After noting it"""
        try:
            self.model.learn(*args, **kwargs)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                self.interruption = error
            self.on_failure()
            raise

    def save(self, path: str, *args: Any, **kwargs: Any) -> None:
        """As the algorithm does, but the file is complete at any moment."""
        save_atomically(self.model, path, *args, **kwargs)


def open_bars(callbacks: list[BaseCallback]) -> list[BaseCallback]:
    """
    :param callbacks: Callbacks of a training
    :return: Those progress bars that are shown: rl_zoo3 ends them after a failure too, but other callbacks would evaluate
    """
    return [bar for bar in callbacks if isinstance(bar, ProgressBarCallback) and getattr(bar, "pbar", None) is not None]


def steps_of(zip_file: Path) -> int:
    """
    :param zip_file: A zip that this run has saved
    :return: Steps of the run up to then
    """
    with zipfile.ZipFile(zip_file) as archive:
        return int(json.loads(archive.read("data"))["num_timesteps"])


def with_changes(arguments: Sequence[str], changes: Sequence[str]) -> list[str]:
    """
    :param arguments: Arguments of an interrupted training
    :param changes: ``-i ZIP``, and maybe ``-n STEPS``, with which it continues
    :return: The arguments of the command that continues
    """
    kept = list(arguments)
    for names in (("-i", "--trained-agent"), ("-n", "--n-timesteps")):
        if names[0] in changes:
            kept = without_option(kept, names)
    return [*kept, *changes]

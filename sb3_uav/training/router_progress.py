"""The progress of a router's epoch on SB3's progress bar."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback, tqdm

from sb3_uav.common.callback_tree import siblings


class _RouterProgress(BaseCallback):
    """
    Shows the progress of the router's epoch on the allocator's progress bar, because two bars at a time would disturb each
    other.

    :param description: Text in front of the percentage
    :param bar: A tqdm bar
    :param n_instances: Instances of the epoch
    """

    def __init__(self, description: str, bar: Any, n_instances: int) -> None:
        super().__init__()
        self.description, self.bar, self.n_instances = description, bar, n_instances
        self.n_episodes = 0

    def _on_step(self) -> bool:
        n_finished = int(np.sum(self.locals["dones"]))
        if n_finished > 0:
            self.n_episodes += n_finished
            self.report(min(self.n_episodes / getattr(self.model, "n_samples", 1) / self.n_instances, 1.0))
        return True

    def report(self, done: float) -> None:
        """:param done: Fraction of the epoch that is done"""
        self.bar.set_description(f"{self.description} {done:4.0%}")


class _OwnProgress(_RouterProgress):
    """The same on a bar of its own, for pre-training, when the allocator has none yet."""

    def report(self, done: float) -> None:
        self.bar.update(round(done * self.n_instances) - self.bar.n)


def router_progress(callback: BaseCallback, description: str, n_instances: int) -> tuple[list[BaseCallback], Any]:
    """
    :param callback: A callback of the allocator's training, which has started
    :param description: What the router is doing
    :param n_instances: Instances of the epoch
    :return: A callback for the router's training that reports on the run's progress bar, if there is one, and a function to
        call afterwards
    """
    bars = siblings(callback, ProgressBarCallback)
    if not bars:
        return [], lambda: None
    if getattr(bars[0], "pbar", None) is None:
        # Pre-training: the allocator's bar does not exist yet.
        bar = tqdm(total=n_instances, desc=description)
        return [_OwnProgress(description, bar, n_instances)], bar.close
    bar = bars[0].pbar
    return [_RouterProgress(description, bar, n_instances)], lambda: bar.set_description("allocator")

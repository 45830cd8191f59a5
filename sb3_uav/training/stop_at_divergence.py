"""Stopping any training of SB3 at the first number that is not finite."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.common.divergence import diverged, first_bad, normalization_statistics
from sb3_uav.reinforce.finite import watch


class StopAtDivergence(BaseCallback):
    """
    Stops the training of any algorithm of SB3 at a reward, a gradient, a weight or a statistic of ``VecNormalize`` that is not
    finite. ``sb3-uav train`` adds it to every run; ``ITSCallback`` watches the updates of both levels by itself.

    A weight that grows beyond 1,000 is reported by a warning, and ``train/max_weight`` is logged.

    :raises DivergenceError: In training; it names the quantity, its value and the last good checkpoint
    """

    def _on_training_start(self) -> None:
        watch(self.model)

    def _on_step(self) -> bool:
        rewards: Any = self.locals.get("rewards")
        if rewards is not None:
            self._check("reward", th.as_tensor(rewards))
        normalization = self.model.get_vec_normalize_env()
        if normalization is not None:
            for name, value in normalization_statistics(normalization):
                self._check(name, value)
        return True

    def _check(self, name: str, value: th.Tensor) -> None:
        bad = first_bad(value)
        if bad is not None:
            raise diverged(self.model, name, bad, "an environment whose rewards and observations are finite")

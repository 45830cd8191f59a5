"""Checkpoints of ``--save-freq`` that hold both levels."""

from __future__ import annotations

import re
from pathlib import Path

from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.saving import save_atomically
from sb3_uav.training.best_pair import RouterCallback

_MODEL_FILE = re.compile(r"rl_model_(\d+)_steps\.zip")


class PairCheckpointCallback(CheckpointCallback):
    """
    SB3's callback, which saves ``rl_model_<steps>_steps.zip``. The router of that moment, if a callback trains one, goes into
    ``router_<steps>_steps.zip`` beside it.
    """

    @classmethod
    def of(cls, stock: CheckpointCallback) -> PairCheckpointCallback:
        """
        :param stock: A callback of rl_zoo3
        :return: One with the same settings
        """
        return cls(stock.save_freq, stock.save_path, stock.name_prefix, verbose=stock.verbose)

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/callbacks.py#L306
    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            # Before the allocator, so that none is without its router, however the process ends.
            model = Path(self._checkpoint_path(extension="zip"))
            # Abstract classes: https://github.com/python/mypy/issues/4717
            for training in siblings(self, RouterCallback):  # type: ignore[type-abstract]
                save_atomically(training.router, model.with_name(_router_file(model)))
        return super()._on_step()


def _router_file(model: Path) -> str:
    return f"router_{model.stem.removeprefix('rl_model_')}.zip"


def find_checkpoint_router(model: Path) -> Path | None:
    """
    :param model: Zip of an allocator
    :return: The router of the same moment, if the zip is a checkpoint of ``--save-freq`` and has one
    """
    router = model.with_name(_router_file(model))
    return router if _MODEL_FILE.fullmatch(model.name) and router.is_file() else None

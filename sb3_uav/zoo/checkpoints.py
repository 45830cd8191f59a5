"""Checkpoints of ``--save-freq`` that hold both levels, and which router belongs to an allocator's zip."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.divergence import note_saved, require_finite_model
from sb3_uav.common.files import remove_leftovers
from sb3_uav.common.saving import save_atomically
from sb3_uav.training.arguments import check_counts
from sb3_uav.training.best_pair import BEST_MODEL_FILE, RouterCallback, find_best_router
from sb3_uav.training.its import ROUTER_FILE
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, STATE_FILE, WARM_START_FOLDER, read_state, router_of
from sb3_uav.training.kept_checkpoints import oldest

_MODEL_FILE = re.compile(r"rl_model_(\d+)_steps\.zip")
_ROUTER_FILE = re.compile(r"router_(\d+)_steps\.zip")


class PairCheckpointCallback(CheckpointCallback):
    """
    SB3's callback, which saves ``rl_model_<steps>_steps.zip``. The router of that moment, if a callback trains one, goes into
    ``router_<steps>_steps.zip`` beside it. What is not finite is not saved.

    :param keep: Number of checkpoints to keep; older ones are removed when a new one is complete; all when None
    :raises ValueError: If ``keep`` is no whole number of at least 1
    """

    def __init__(self, *args: Any, keep: int | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        check_counts(1, keep=keep)
        self.keep = keep

    @classmethod
    def of(cls, stock: CheckpointCallback) -> PairCheckpointCallback:
        """
        :param stock: A callback of rl_zoo3
        :return: One with the same settings
        """
        return cls(stock.save_freq, stock.save_path, stock.name_prefix, verbose=stock.verbose)

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/callbacks.py#L306
    def _on_step(self) -> bool:
        is_due = self.n_calls % self.save_freq == 0
        model = Path(self._checkpoint_path(extension="zip"))
        if is_due:
            require_finite_model(self.model, model)
            # Before the allocator, so that none is without its router, however the process ends.
            # Abstract classes: https://github.com/python/mypy/issues/4717
            for training in siblings(self, RouterCallback):  # type: ignore[type-abstract]
                save_atomically(training.router, model.with_name(_router_file(model)))
        goes_on = super()._on_step()
        if is_due:
            note_saved(self.model, model)
            if self.keep is not None:
                for number in (_MODEL_FILE, _ROUTER_FILE):
                    for old in oldest(model.parent.iterdir(), number, self.keep):
                        old.unlink(missing_ok=True)
        return goes_on


def _router_file(model: Path) -> str:
    return f"router_{model.stem.removeprefix('rl_model_')}.zip"


def find_checkpoint(trained_agent: Path) -> Path | None:
    """
    :param trained_agent: The allocator's zip
    :return: The folder with the state of its interactive training, if there is one
    """
    beside, below = trained_agent.parent, trained_agent.parent / CHECKPOINT_FOLDER
    return next((folder for folder in (beside, below) if (folder / STATE_FILE).is_file()), None)


def newest_checkpoint(folder: Path) -> Path | None:
    """
    :param folder: rl_zoo3's folder of a run
    :return: The zip from which ``train -i`` continues it, if something has been saved: the allocator of the last epoch of ITS,
        else the last checkpoint of ``--save-freq``
    """
    try:
        below = folder / CHECKPOINT_FOLDER
        return below / read_state(below)["allocator"]
    except FileNotFoundError:
        numbered = {_MODEL_FILE.fullmatch(path.name): path for path in folder.glob("rl_model_*_steps.zip")}
        steps = {int(match.group(1)): path for match, path in numbered.items() if match is not None}
        return steps[max(steps)] if steps else None


def remove_leftovers_of(trained_agent: Path) -> None:
    """
    Remove what the run to which a zip belongs had not written to the end when it was killed.

    :param trained_agent: The zip
    """
    folder = trained_agent.parent.parent if trained_agent.parent.name == CHECKPOINT_FOLDER else trained_agent.parent
    for one in (folder, folder / CHECKPOINT_FOLDER, folder / CHECKPOINT_FOLDER / WARM_START_FOLDER):
        remove_leftovers(one)


def find_router(allocator: Path) -> Path | None:
    """
    :param allocator: The allocator's zip
    :return: The zip of the router that it was trained with: that of the checkpoint of the ITS that it lies in; of the best
        pair for the best model; of the same moment for a checkpoint of ``--save-freq``; else the run's last one; None if there
        is none near it
    """
    folder = allocator.parent
    if (folder / STATE_FILE).is_file():
        return folder / router_of(folder, allocator.name)
    is_checkpoint = _MODEL_FILE.fullmatch(allocator.name) is not None
    own = find_best_router(folder) if allocator.name == BEST_MODEL_FILE else None
    if is_checkpoint and (same_moment := allocator.with_name(_router_file(allocator))).is_file():
        own = same_moment
    if own is not None:
        return own
    last, checkpoint = folder / ROUTER_FILE, find_checkpoint(allocator)
    if not last.is_file():
        if checkpoint is None:
            return None
        last = checkpoint / read_state(checkpoint)["router"]
    if is_checkpoint:
        print(f"{allocator.name} has no router of its own: rewards come from the run's last one.")
    return last

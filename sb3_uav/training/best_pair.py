"""The best allocator of a run and the router that it was evaluated with: the only writer of their zips."""

from __future__ import annotations

import json
import os
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback

from sb3_uav.common.callback_tree import siblings, walk_callbacks
from sb3_uav.common.divergence import DivergenceError
from sb3_uav.common.files import file_hash, write_atomically
from sb3_uav.common.json_text import read_json_file
from sb3_uav.common.saving import save_atomically

BEST_MODEL_FILE = "best_model.zip"
_BEST_ROUTER_FILE = "best_router.zip"
_PAIR_FILE = "best_pair.json"
# Complete, but not yet in place.
_NEXT_MODEL_FILE = "best_model.next.zip"
_NEXT_ROUTER_FILE = "best_router.next.zip"


class BestPair:
    """
    ``best_model.zip`` and ``best_router.zip`` of a folder.

    Both zips are complete before either is put in place, and ``best_pair.json`` holds their digests, so that
    :func:`find_best_router` finds the router of ``best_model.zip`` even if the process ends between the two renames.

    :param folder: The folder
    :param copies: Names of files that get the bytes of ``best_model.zip`` too, after both renames
    """

    def __init__(self, folder: Path, copies: tuple[str, ...] = ()) -> None:
        self.folder = folder
        self.copies = copies

    def save(self, model: BaseAlgorithm, router: BaseAlgorithm | None, **about: Any) -> None:
        """
        :param model: What was evaluated
        :param router: The router that it was evaluated with; None if there is none that learns
        :param about: Plain data to note beside the digests
        :raises DivergenceError: If a number of either is not finite; the earlier pair is then untouched
        :raises OSError: If a file cannot be written; the earlier pair is then untouched
        """

        def save_router(path: Path) -> None:
            assert router is not None
            save_atomically(router, path)

        self._replace(lambda path: save_atomically(model, path), None if router is None else save_router, about)

    def copy(self, model: Path, router: Path | None) -> None:
        """
        :param model: Zip of the best model of an earlier run
        :param router: Zip of its router, if it has one
        :raises OSError: If a file cannot be read or written
        """

        def copy_router(path: Path) -> None:
            assert router is not None
            write_atomically(path, router.read_bytes())

        about = {"copied_from": str(model)}
        self._replace(lambda path: write_atomically(path, model.read_bytes()), None if router is None else copy_router, about)

    def _replace(
        self, write_model: Callable[[Path], None], write_router: Callable[[Path], None] | None, about: dict[str, Any]
    ) -> None:
        model, router, note = (self.folder / name for name in (BEST_MODEL_FILE, _BEST_ROUTER_FILE, _PAIR_FILE))
        next_model, next_router = self.folder / _NEXT_MODEL_FILE, self.folder / _NEXT_ROUTER_FILE
        # What an interruption has left comes first, because the file with the router's next name is overwritten below.
        if find_best_router(self.folder) == next_router:
            os.replace(next_router, router)
        try:
            if write_router is not None:
                write_router(next_router)
            write_model(next_model)
            if write_router is not None or router.is_file() or note.is_file():
                digests = {"model": file_hash(next_model), "router": None if write_router is None else file_hash(next_router)}
                write_atomically(note, json.dumps({**digests, **about}, indent=1))
        except (OSError, DivergenceError):
            for path in (next_model, next_router):
                path.unlink(missing_ok=True)
            raise
        # From this rename on the new pair is the best one.
        os.replace(next_model, model)
        if write_router is not None:
            os.replace(next_router, router)
        for name in self.copies:
            write_atomically(self.folder / name, model.read_bytes())


def find_best_router(folder: Path) -> Path | None:
    """
    :param folder: Where a run keeps its best pair
    :return: The zip of the router that ``best_model.zip`` was evaluated with; None if the run has none
    """
    plain = folder / _BEST_ROUTER_FILE
    try:
        note = read_json_file(folder / _PAIR_FILE)
        if note["model"] == file_hash(folder / BEST_MODEL_FILE):
            if note["router"] is None:
                return None
            for path in (plain, folder / _NEXT_ROUTER_FILE):
                if path.is_file() and file_hash(path) == note["router"]:
                    return path
    except (OSError, ValueError, LookupError, TypeError):
        # A folder of an earlier version, or files put there by hand: the names decide.
        pass
    return plain if plain.is_file() else None


class RouterCallback(BaseCallback):
    """A callback that trains a router beside the allocator."""

    @property
    @abstractmethod
    def router(self) -> BaseAlgorithm:
        """The router's algorithm."""

    def _on_step(self) -> bool:
        return True


class BestPairOwner(BaseCallback):
    """A callback whose evaluation decides which pair of a folder is the best."""

    @property
    @abstractmethod
    def owned_folder(self) -> Path | None:
        """The folder of its best pair; None if it leaves that to another callback."""

    def _on_step(self) -> bool:
        return True


class _SaveEvaluatedPair(BaseCallback):
    """
    Saves the pair when SB3's ``EvalCallback`` finds a new best model, unless another callback owns the folder.

    :param folder: Where the ``EvalCallback`` would save ``best_model.zip``
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        evaluation = self.parent
        assert isinstance(evaluation, EvalCallback)
        # Abstract classes: https://github.com/python/mypy/issues/4717
        owners = siblings(evaluation, BestPairOwner)  # type: ignore[type-abstract]
        owned = [owner.owned_folder for owner in owners]
        if not any(folder is not None and folder.resolve() == self.folder.resolve() for folder in owned):
            training = siblings(evaluation, RouterCallback)  # type: ignore[type-abstract]
            about = {"timesteps": self.model.num_timesteps, "mean_reward": evaluation.last_mean_reward}
            router = training[0].router if training else None
            BestPair(self.folder).save(self.model, router, evaluated_by=type(evaluation).__name__, **about)
        return True


def take_over(evaluation: EvalCallback, model: BaseAlgorithm) -> None:
    """
    Let an ``EvalCallback`` leave ``best_model.zip`` to :class:`BestPair`, which keeps the router beside it.

    It evaluates, reports and calls other callbacks as before. Taking it over twice changes nothing.

    :param evaluation: A callback of a training that has started
    :param model: What is being trained
    """
    folder = evaluation.best_model_save_path
    if folder is None:
        return
    evaluation.best_model_save_path = None
    # Before the user's own callback, which may read the zip.
    given = evaluation.callback_on_new_best
    saving = CallbackList([_SaveEvaluatedPair(Path(folder)), *([] if given is None else [given])])
    # The list passes it to its children: https://github.com/DLR-RM/stable-baselines3/issues/1791
    saving.parent = evaluation
    saving.init_callback(model)
    evaluation.callback_on_new_best = saving


def best_model_folder(evaluation: EvalCallback) -> Path | None:
    """
    :param evaluation: SB3's evaluation, taken over or not
    :return: Where it keeps, or would keep, its best model
    """
    if evaluation.best_model_save_path is not None:
        return Path(evaluation.best_model_save_path)
    taken_over = [c for c in walk_callbacks(evaluation.callback_on_new_best) if isinstance(c, _SaveEvaluatedPair)]
    return taken_over[0].folder if taken_over else None

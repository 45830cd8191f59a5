"""Saves algorithms so that an interruption or a full disk never destroys the previous file."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Iterable

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_uav.common.divergence import note_saved, require_finite_model
from sb3_uav.common.files import temporary_name


def save_atomically(
    model: BaseAlgorithm,
    path: str | pathlib.Path | io.BufferedIOBase,
    exclude: Iterable[str] | None = None,
    include: Iterable[str] | None = None,
) -> None:
    """
    Save as SB3's ``save`` does, under a temporary name that is replaced by the final one when the zip is complete.

    :param model: Any SB3 algorithm
    :param path: The zip to write; ``.zip`` is appended when missing
    :param exclude: Attributes to leave out
    :param include: Attributes to save although they are left out by default
    :raises DivergenceError: If the model holds a number that is not finite; an existing file is then left untouched
    :raises OSError: If the file cannot be written; an existing file of the same name is then left untouched
    """
    if not isinstance(path, str | pathlib.Path):
        BaseAlgorithm.save(model, path, exclude, include)
        return
    path = pathlib.Path(path)
    path = path if path.suffix == ".zip" else path.with_name(path.name + ".zip")
    require_finite_model(model, path)
    with temporary_name(path) as temporary:
        BaseAlgorithm.save(model, temporary, exclude, include)
    note_saved(model, path)

"""Creating and saving figures without pyplot's global state."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_uav.common.files import temporary_name
from sb3_uav.envs.render import require_matplotlib

_SUFFIXES = (".png", ".pdf", ".svg")


def checked_path(path: str | os.PathLike[str]) -> Path:
    """
    :param path: Output path of a figure
    :return: The path as a ``Path``
    :raises ValueError: If its suffix is not one of :data:`_SUFFIXES`
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"{path}: the suffix of a figure must be one of {_SUFFIXES}, found {path.suffix!r}.")
    return path


def new_figure(width: float, height: float) -> Any:
    """
    :param width: Width in inches
    :param height: Height in inches
    :return: An empty matplotlib figure that lays itself out
    :raises ImportError: If matplotlib is not installed
    """
    return require_matplotlib().figure.Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: Path, metadata: Mapping[str, str | None] | None = None) -> None:
    """
    Write a figure under a temporary name and rename it.

    :param figure: The figure
    :param path: From :func:`checked_path`; its folder is created if missing
    :param metadata: Written into the file, under keys that its format has; None leaves out what is written by default
    """
    with temporary_name(path) as temporary:
        # The layout does not always leave room for legends outside the axes.
        kind = path.suffix[1:].lower()
        figure.savefig(temporary, format=kind, dpi=150, bbox_inches="tight", pad_inches=0.12, metadata=metadata)

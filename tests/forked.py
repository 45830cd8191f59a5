"""Processes of their own, forked from one that has imported what takes seconds to import."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch as th

_FORKS = multiprocessing.get_context("forkserver")
# What is not installed is skipped.
_FORKS.set_forkserver_preload(
    ["sb3_contrib", "sb3_uav.training", "sb3_uav.solvers", "matplotlib.figure", "sb3_uav.zoo.experiment"]
)


def _play(function: Callable[..., None], folder: Path, files: tuple[Path, Path], arguments: tuple[Any, ...]) -> None:
    os.chdir(folder)
    th.set_num_threads(1)
    # Closed at the end of the process, after it has written what went wrong.
    sys.stdout, sys.stderr = (path.open("w", encoding="utf-8") for path in files)
    function(*arguments)


def run_forked(function: Callable[..., None], folder: Path, *arguments: Any, limit: float | None = None) -> str:
    """
    :param function: A function of a module, which may end the process
    :param folder: Its working directory
    :param arguments: Its arguments
    :param limit: Seconds that it may take
    :return: What it printed
    :raises AssertionError: With what it wrote to the standard error, if it ended with an error or took longer
    """
    printed, errors = (folder / f".{name}.txt" for name in ("printed", "errors"))
    process = _FORKS.Process(target=_play, args=(function, folder, (printed, errors), arguments))
    process.start()
    process.join(limit)
    is_late = process.is_alive()
    if is_late:
        process.terminate()
        process.join()
    assert not is_late, f"it takes more than {limit} s\n{printed.read_text()}\n{errors.read_text()}"
    assert process.exitcode == 0, f"exit code {process.exitcode}\n{printed.read_text()}\n{errors.read_text()}"
    return printed.read_text(encoding="utf-8")

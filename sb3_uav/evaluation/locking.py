"""Keeping a second evaluation out of a folder."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_uav.evaluation.results import RESULTS_FILE

if sys.platform != "win32":
    import fcntl


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """
    Keep a second evaluation out of the folder, as long as the ``with`` block or the process lasts.

    :param folder: The folder, created if missing
    :raises ValueError: If another process holds it, or it cannot be created
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        results = folder / RESULTS_FILE
        raise ValueError(f"{results}: cannot be written ({error.strerror}); choose another output folder.") from error
    if sys.platform == "win32":
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{folder}: another evaluation is writing there; wait for it, or choose another folder."
            ) from None
        except OSError:
            # Some network file systems have no locks.
            pass
        yield
    finally:
        os.close(descriptor)

"""Opening what should be a file, and may be a pipe without end, a device, or larger than memory."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

MAX_TEXT = 64 * 2**20


def open_regular(path: Path) -> BinaryIO:
    """
    :param path: A file
    :return: The file, opened to read
    :raises FileNotFoundError: If there is none
    :raises OSError: If it cannot be read, or is a folder, a pipe or a device, which may never end; the message names it
    """
    # Before it is opened: to open a pipe waits for whoever writes into it.
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise OSError(f"{path}: this is no regular file, but a folder, a pipe or a device; give the path of a file.")
    return path.open("rb")


def read_regular(path: Path, most: int = MAX_TEXT) -> bytes:
    """
    :param path: A file
    :param most: The largest size that it may have, in bytes
    :return: Its content
    :raises OSError: As of :func:`open_regular`
    :raises ValueError: If it is larger; no more of it is read
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        # A file may grow while it is read.
        content = b"" if size > most else file.read(most + 1)
    if max(size, len(content)) > most:
        raise ValueError(f"{path}: the file has {max(size, len(content))} bytes, more than the {most} that are read.")
    return content

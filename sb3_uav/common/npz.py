"""Reading ``.npz`` files of plain arrays that may be damaged or hostile."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

# What numpy and zipfile raise on damaged files: the last on headers that ask for encryption or an unknown compression.
UNREADABLE = (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, RuntimeError)


def read_npz(path: Path, advice: str) -> dict[str, np.ndarray]:
    """
    :param path: An ``.npz`` file that exists
    :param advice: What the user should do if it is damaged, the end of the message
    :return: Its arrays by name
    :raises ValueError: If it is not an intact ``.npz``, or holds anything but plain arrays
    """
    try:
        # Not np.load(path), which would also read a .npy or offer to unpickle whatever else it finds.
        with path.open("rb") as stream, np.lib.npyio.NpzFile(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except UNREADABLE as error:
        raise ValueError(f"{path}: not an intact .npz of plain arrays ({error}); {advice}.") from error

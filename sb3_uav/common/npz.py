"""Reading ``.npz`` files of plain arrays that may be damaged or hostile."""

from __future__ import annotations

import math
import os
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from sb3_uav.common.checked_zip import check_number
from sb3_uav.common.regular_file import open_regular

# Upper bound of the compression ratio of deflate, which np.savez_compressed uses (https://zlib.net/zlib_tech.html).
_GREATEST_COMPRESSION = 1032
_SUFFIX = ".npy"
# Arrays of one file together. Plain coordinates hardly shrink, and whole numbers with constant columns about thirtyfold;
# what is small may shrink more, as many copies of one instance do.
_ALWAYS_READ = 128 * 2**20
_USUAL_COMPRESSION = 32


def read_npz(path: Path, advice: str) -> dict[str, np.ndarray]:
    """
    Read all arrays of a file. Memory is allocated only for data that the file can contain, whatever its headers declare.

    :param path: An existing ``.npz`` file
    :param advice: What the user should do if the file is damaged; ends the message
    :return: The arrays by name
    :raises ValueError: If it is not an intact ``.npz``, or holds anything but plain arrays
    """
    try:
        stream = open_regular(path)
    except OSError as error:
        raise ValueError(f"{path}: not an intact .npz of plain arrays ({error}); {advice}.") from error
    with stream:
        return read_npz_stream(stream, str(path), advice)


def read_npz_stream(stream: IO[bytes], source: str, advice: str) -> dict[str, np.ndarray]:
    """
    The same for a file that is open, or in memory.

    :param stream: Its content
    :param source: Its name, for errors
    :param advice: As of :func:`read_npz`
    :return: The arrays by name
    :raises ValueError: As :func:`read_npz`
    """
    place = ""
    try:
        check_number(stream)
        # Not np.load, which would also read a .npy or offer to unpickle whatever else it finds.
        with zipfile.ZipFile(stream) as file:
            arrays: dict[str, np.ndarray] = {}
            for member in file.infolist():
                place = f"array '{member.filename.removesuffix(_SUFFIX)}': "
                _check_member(member)
            place = ""
            _check_size(file, stream.seek(0, os.SEEK_END))
            for member in file.infolist():
                place = f"array '{member.filename.removesuffix(_SUFFIX)}': "
                if member.filename.removesuffix(_SUFFIX) in arrays:
                    raise ValueError("it stands twice in the file")
                arrays[member.filename.removesuffix(_SUFFIX)] = _read_array(file, member)
            return arrays
    except Exception as error:
        # Given damaged bytes, zipfile and numpy's header parser (tokenize, ast) raise almost any exception, even MemoryError.
        found = str(error) or type(error).__name__
        raise ValueError(f"{source}: not an intact .npz of plain arrays ({place:.200}{found:.300}); {advice}.") from error


def _check_size(file: zipfile.ZipFile, n_bytes: int) -> None:
    """
    :param file: An opened archive
    :param n_bytes: Its size. Members that lie in each other, each with the others as its numbers, claim more together
    :raises ValueError: If it would be many times larger in memory
    """
    packed, total = (sum(getattr(member, name) for member in file.infolist()) for name in ("compress_size", "file_size"))
    packed = min(packed, n_bytes)
    if total > max(_ALWAYS_READ, _USUAL_COMPRESSION * packed):
        raise ValueError(f"its {packed} bytes would become {total} bytes, more than arrays of numbers shrink")


def _check_member(member: zipfile.ZipInfo) -> None:
    """
    :param member: One of the files of an archive
    :raises ValueError: If it is no array that numpy wrote, or the archive declares more than it can hold
    """
    if not member.filename.endswith(_SUFFIX):
        raise ValueError("the name does not end in .npy")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("it is compressed in a way that numpy does not use")
    if member.file_size > _GREATEST_COMPRESSION * member.compress_size + 1:
        raise ValueError(
            f"{member.compress_size} compressed bytes cannot hold the {member.file_size} bytes that the archive declares"
        )


def _read_array(file: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """
    :param file: An opened archive
    :param member: One of its files
    :return: The array in it
    :raises Exception: Any kind of exception, if the file is damaged or not an array
    """
    with file.open(member) as stream:
        shape, dtype = _read_header(stream)
        n_bytes = member.file_size - stream.tell()
    # Arrays of objects are pickles, which read_array refuses.
    if not dtype.hasobject and (dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize != n_bytes):
        raise ValueError(f"the header declares {dtype} of shape {shape}, but {n_bytes} bytes follow")
    with file.open(member) as stream:
        array: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
        return array


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """
    :param stream: The content of an ``.npy`` file
    :return: The shape and the dtype that it declares
    """
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"version {version} of the .npy format is only for structured arrays")
    return shape, dtype

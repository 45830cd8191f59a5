"""Files that are complete at any moment, and their digests."""

from __future__ import annotations

import csv
import hashlib
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

if sys.platform != "win32":
    import fcntl

# Those of :func:`temporary_name`: a name, and its suffix once more.
_TEMPORARY = re.compile(r".+(\.\w+)\.tmp\1")


@contextmanager
def temporary_name(path: Path) -> Iterator[Path]:
    """
    Write a file under a temporary name, which is replaced by the final one if the ``with`` block ends without an exception.

    :param path: The file to write; its folder is created if missing
    :return: The temporary path, in the same folder and with the same suffix
    :raises OSError: If the file cannot be written; an existing file of this name is then left untouched
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.tmp{path.suffix}")
    try:
        with _held(temporary):
            yield temporary
            os.replace(temporary, path)
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        # Such as that of a full disk.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _held(temporary: Path) -> Iterator[None]:
    """Lock a temporary file as long as the ``with`` block or the process lasts; where there are no locks, do nothing."""
    if sys.platform == "win32":
        # Nobody can remove a file there while it is open.
        yield
        return
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT, 0o666)
    try:
        _lock(descriptor)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """:return: Whether no other process has locked the file, as far as is known"""
    if sys.platform != "win32":
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            # Some network file systems have no locks.
            pass
    return True


def remove_leftovers(folder: Path) -> None:
    """
    Remove the temporary files of processes that were killed while they wrote them. Those that a process is writing stay.

    :param folder: A folder, which may be missing
    """
    try:
        found = [path for path in folder.iterdir() if _TEMPORARY.fullmatch(path.name)]
    except OSError:
        return
    for path in found:
        # Where the folder is read-only, or another process is faster, they do no harm.
        with suppress(OSError):
            descriptor = os.open(path, os.O_WRONLY)
            try:
                is_left = _lock(descriptor)
                if is_left and sys.platform != "win32":
                    path.unlink()
            finally:
                os.close(descriptor)
            if is_left and sys.platform == "win32":
                path.unlink()


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    :param path: The file to write; its folder is created if missing
    :param content: The content of the file; text is encoded as UTF-8
    :raises OSError: If the file cannot be written; an existing file of this name is then left untouched
    """
    with temporary_name(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replaced_when_complete(path: Path) -> Iterator[TextIO]:
    """
    Open a text file for writing; it replaces an existing one only if the ``with`` block ends without an exception.

    :param path: The file to write; its folder is created if missing
    :return: The open file, without translation of line endings
    :raises ValueError: If the file cannot be written there
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary_name(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
            yield file
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror}); choose another output folder.") from error


def write_csv(file: TextIO, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """
    :param file: A file opened with ``newline=""``
    :param columns: Cells of the header
    :param rows: Cells of the other rows; None becomes an empty cell
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)


def file_hash(path: Path) -> str:
    """
    :param path: A file; ``.zip`` is appended if there is no such file, as SB3 does
    :return: SHA-256 of the file in hexadecimal digits, as ``sha256sum`` prints it
    :raises OSError: If the file cannot be read
    """
    path = path if path.is_file() else path.with_name(path.name + ".zip")
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()

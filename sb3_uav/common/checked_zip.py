"""Reading zips of strangers: everything is checked in the table of contents, before a member is unpacked."""

from __future__ import annotations

import io
import os
import stat
import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO, BinaryIO

MIB = 2**20
# Of the largest file that is looked at. The default networks take 3 MB with their optimizer, the paper's 8 MB.
MAX_FILE = 512 * MIB
# Zeros can be packed a thousandfold. Trained numbers hardly can, and the JSON of SB3 about fivefold.
MAX_RATIO = 20
_RATIO_MATTERS_FROM = MIB
# Of all members, also those of zips within the zip, as every tensor is one.
MAX_MEMBERS = 20_000
_SIGNATURE = b"PK\x01\x02"
_ENCRYPTED = 0x1
_METHODS = {zipfile.ZIP_STORED: "stored", zipfile.ZIP_DEFLATED: "deflated"}
# What zipfile raises for what is not an intact zip.
DAMAGE = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, OSError, RuntimeError),
    *(ValueError, OverflowError, LookupError, struct.error),
)


class ZipDamageError(ValueError):
    """What is wrong with a zip, for messages that name the file."""


class CheckedZip:
    """
    A zip whose table of contents is harmless. The members are not extracted, only read, none beyond its stated size.

    :param source: The file, or its content
    :param most_members: The largest number of members
    :param most_bytes: The largest sum of their unpacked sizes
    :param paths: Whether names may have folders, as in the zips of torch
    :param packed: Whether members may be compressed
    :raises OSError: If the file cannot be read
    :raises ZipDamageError: If it is no zip, or one that no program of ours has written
    """

    def __init__(
        self, source: Path | bytes, most_members: int, most_bytes: int, paths: bool = False, packed: bool = True
    ) -> None:
        self._stream: BinaryIO = io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")
        try:
            size = self._stream.seek(0, os.SEEK_END)
            if size > MAX_FILE:
                raise ZipDamageError(f"it has {size} bytes, more than the {MAX_FILE} that are read")
            check_number(self._stream)
            try:
                self._archive = zipfile.ZipFile(self._stream)
            except DAMAGE as error:
                raise ZipDamageError(str(error)) from error
            self.members = _checked_members(self._archive.infolist(), most_members, most_bytes, paths, packed)
        except BaseException:
            self._stream.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._archive.close()
        self._stream.close()

    def __enter__(self) -> CheckedZip:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, name: str, most: int) -> bytes:
        """
        :param name: Name of a member
        :param most: The largest size that it may have
        :return: Its content, whose checksum is right
        :raises ZipDamageError: If it is larger, or not intact
        """
        size = self.members[name].file_size
        if size > most:
            raise ZipDamageError(f"member {name!r:.80} has {size} bytes, more than the {most} that are read")
        content = bytearray(size)
        self.read_into(name, memoryview(content))
        return bytes(content)

    def read_into(self, name: str, target: memoryview) -> None:
        """
        :param name: Name of a member
        :param target: Receives its content; of its size
        :raises ZipDamageError: If the member is not intact
        """
        member, done = self.members[name], 0
        try:
            with self._archive.open(member) as stream:
                # In pieces, because zipfile unpacks as much as is asked for, whatever the table of contents says.
                while piece := stream.read(MIB):
                    target[done : done + len(piece)] = piece
                    done += len(piece)
        except DAMAGE as error:
            raise ZipDamageError(f"member {name!r:.80}: {error}") from error
        if done != len(target):
            raise ZipDamageError(f"member {name!r:.80} has {done} bytes in place of {len(target)}")


def check_number(stream: IO[bytes]) -> None:
    """
    Count the entries of all tables of contents, before zipfile makes an object of each.

    :param stream: A file, of which the last 512 MiB are looked at; it is at its beginning afterwards
    :raises ZipDamageError: If there are too many
    """
    stream.seek(max(0, stream.seek(0, os.SEEK_END) - MAX_FILE))
    found, tail = 0, b""
    while piece := stream.read(MIB // 16):
        found += (tail + piece).count(_SIGNATURE)
        # A signature may lie across two pieces, but none is counted twice.
        tail = piece[-(len(_SIGNATURE) - 1) :]
        if found > MAX_MEMBERS:
            raise ZipDamageError(f"it has more than {MAX_MEMBERS} members")
    stream.seek(0)


def _checked_members(
    members: list[zipfile.ZipInfo], most_members: int, most_bytes: int, paths: bool, packed: bool
) -> dict[str, zipfile.ZipInfo]:
    """
    :param members: The table of contents
    :param most_members: See :class:`CheckedZip`, as the others
    :param most_bytes: The largest sum of sizes
    :param paths: Whether names may have folders
    :param packed: Whether members may be compressed
    :return: The members by name
    :raises ZipDamageError: If one is not harmless
    """
    if len(members) > most_members:
        raise ZipDamageError(f"it has {len(members)} members, more than the {most_members} that one of ours can have")
    # Of a truncated zip, zipfile may open one that lies inside, and take the rest for a preamble.
    if min((member.header_offset for member in members), default=0) > 0:
        raise ZipDamageError("its table of contents is missing")
    total = sum(member.file_size for member in members)
    if total > most_bytes:
        raise ZipDamageError(f"its members have {total} bytes unpacked, more than the {most_bytes} that are read")
    found: dict[str, zipfile.ZipInfo] = {}
    for member in members:
        name = f"member {member.filename!r:.80}"
        if member.filename in found:
            raise ZipDamageError(f"{name} is there twice")
        parts = member.filename.replace("\\", "/").split("/")
        if (
            not member.filename.isprintable()
            or {"", ".", ".."} & set(parts)
            or ":" in parts[0]
            or not (paths or parts[1:] == [])
        ):
            raise ZipDamageError(f"{name} is a path that leads elsewhere or a folder, in place of a plain name")
        if stat.S_IFMT(member.external_attr >> 16) not in (0, stat.S_IFREG):
            raise ZipDamageError(f"{name} is a link or a device, in place of a file")
        if member.flag_bits & _ENCRYPTED:
            raise ZipDamageError(f"{name} is encrypted")
        if member.compress_type not in (_METHODS if packed else [zipfile.ZIP_STORED]):
            raise ZipDamageError(f"{name} is compressed by method {member.compress_type}, which is not read here")
        if member.file_size > max(_RATIO_MATTERS_FROM, MAX_RATIO * member.compress_size):
            packed_size = member.compress_size
            raise ZipDamageError(
                f"{name} would grow from {packed_size} to {member.file_size} bytes, more than {MAX_RATIO}-fold"
            )
        if member.compress_type == zipfile.ZIP_STORED and member.file_size != member.compress_size:
            raise ZipDamageError(f"{name} has two sizes, {member.compress_size} and {member.file_size} bytes")
        found[member.filename] = member
    return found

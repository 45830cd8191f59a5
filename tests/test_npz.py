"""Damaged and hostile ``.npz`` files: errors name file and array, and no memory is allocated for data that is not there."""

from __future__ import annotations

import io
import struct
import tracemalloc
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instance_helpers import arrays
from malicious_zips import million_members

from sb3_uav.common.npz import read_npz
from sb3_uav.envs import Instances


def npy(header: str, content: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    """An ``.npy`` file with any header."""
    length = struct.pack("<H" if version == b"\x01\x00" else "<I", len(header) + 1)
    return b"\x93NUMPY" + version + length + header.encode("latin1") + b"\n" + content


def with_tasks(path: Path, tasks: bytes) -> Path:
    """An instance file in which ``tasks.npy`` has this content."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, array in arrays().items():
            buffer = io.BytesIO()
            np.save(buffer, array)
            file.writestr(f"{name}.npy", tasks if name == "tasks" else buffer.getvalue())
    return path


HEADER = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            npy(HEADER.format("'<f8'", "(1000000000000,)"), bytes(96)),
            r"declares float64 of shape \(1000000000000,\), but 96 byt",
        ),
        (
            npy(HEADER.format("'<f8'", "(2, 3, 200)"), bytes(96)),
            r"declares float64 of shape \(2, 3, 200\), but 96 bytes follow",
        ),
        (npy(HEADER.format("'<f8'", "(2, 3)"), bytes(96)), r"declares float64 of shape \(2, 3\), but 96 bytes follow"),
        (npy(HEADER.format("'<f8'", "(-2, 3, 2)"), bytes(96)), r"declares float64 of shape \(-2, 3, 2\)"),
        (npy(HEADER.format("'<f8'", "(-2, -3, 2)"), bytes(96)), ""),
        (npy(HEADER.format("'<f8'", f"({10**400},)"), bytes(96)), "declares float64 of shape"),
        (npy(HEADER.format("('<f8', (10**9,))", "(2,)"), bytes(96)), ""),
        (npy(HEADER.format("('<f8', (100000000,))", "(2,)"), bytes(96)), "declares "),
        (npy(HEADER.format("'V0'", "(10,)")), "declares "),
        (npy(HEADER.format("'<U0'", "(1000000000000,)")), "declares "),
        (npy(HEADER.format("('<f8',)", "(2,)"), bytes(96)), ""),
        (npy(HEADER.format("'O'", "(2,)"), bytes(96)), "Object arrays cannot be loaded"),
        (npy(HEADER.format("'<f8'", "2"), bytes(96)), "shape is not valid"),
        (npy("{'descr': '<f8'"), ""),
        (npy("(" * 9000), ""),
        (npy("-" * 9000 + "1"), ""),
        (npy("x" * 20000), ""),
        (npy(""), ""),
        (npy("{}", version=b"\x02\x00"), ""),
        (npy("{}", version=b"\x03\x00"), r"version \(3, 0\)"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{}", ""),
        (b"", ""),
        (b"\x93NUMPY", ""),
        (b"not an array", ""),
    ],
)
def test_damaged_headers_name_file_and_array(content: bytes, message: str, tmp_path: Path) -> None:
    path = with_tasks(tmp_path / "plan.npz", content)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=rf"plan\.npz: not an intact \.npz of plain arrays \(array 'tasks': .*{message}"):
            Instances.load(path)
        # numpy's parser needs this much for the most deeply nested headers.
        assert tracemalloc.get_traced_memory()[1] < 32 * 2**20
    finally:
        tracemalloc.stop()


def test_absurd_sizes_in_the_archive_are_refused(tmp_path: Path) -> None:
    """Archive and header may agree on a size that the few bytes of the file cannot hold."""
    path = with_tasks(tmp_path / "plan.npz", npy(HEADER.format("'<f8'", "(1000000000,)"), bytes(96)))
    size = len(npy(HEADER.format("'<f8'", "(1000000000,)"))) + 8 * 10**9
    content = path.read_bytes()
    with zipfile.ZipFile(path) as file:
        start = file.getinfo("tasks.npy").header_offset
        found = file.getinfo("tasks.npy").file_size
    # Sizes in plain zip files are below 4 GB, which is still absurd here.
    size = min(size, 2**32 - 2)
    content = content.replace(struct.pack("<I", found), struct.pack("<I", size))
    assert struct.pack("<I", size) in content[start:]
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"plan\.npz: .*array 'tasks': .* compressed bytes cannot hold the 4294967294"):
        Instances.load(path)


def test_other_compressions_and_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        file.writestr("tasks.npy", npy("{}"))
    with pytest.raises(ValueError, match="array 'tasks': it is compressed in a way that numpy does not use"):
        read_npz(path, "write it again")
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("readme.txt", "hello")
    with pytest.raises(ValueError, match=r"array 'readme\.txt': the name does not end in \.npy"):
        read_npz(path, "write it again")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_intact_files_are_read(save: object, tmp_path: Path) -> None:
    """With every plain dtype, shape and memory order, and highly compressed."""
    rng = np.random.default_rng(0)
    expected = {
        "zeros": np.zeros((500, 500)),
        "number": np.array(3),
        "empty": np.zeros((0, 4)),
        "fortran": np.asfortranarray(rng.random((3, 4))),
        "big_endian": rng.random(5).astype(">f4"),
        "bools": rng.random(7) < 0.5,
    }
    save(tmp_path / "all.npz", **expected)  # type: ignore[operator]
    found = read_npz(tmp_path / "all.npz", "write it again")
    assert list(found) == list(expected)
    for name, array in expected.items():
        assert found[name].dtype == array.dtype and np.array_equal(found[name], array)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.floats(0, 1, exclude_max=True), flips=st.binary(min_size=1, max_size=3))
def test_any_damage_to_a_header_is_a_value_error(position: float, flips: bytes, tmp_path: Path) -> None:
    """In every part of the header, which is read before the checksum is verified."""
    buffer = io.BytesIO()
    np.save(buffer, arrays()["tasks"])
    content = bytearray(buffer.getvalue())
    start = int(position * 128)
    content[start : start + len(flips)] = flips
    path = with_tasks(tmp_path / "plan.npz", bytes(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            Instances.load(path)
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")


def nested(n_members: int, size: int) -> bytes:
    """An archive of arrays that lie in each other: the numbers of each are all members after it."""

    def header(n: int) -> bytes:
        return npy(f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({n},), }}".ljust(117))

    content = header(size) + bytes(size)
    entries: list[tuple[bytes, bytes]] = []
    for number in reversed(range(n_members)):
        name = b"%04d.npy" % number
        fields = struct.pack("<5H3I2H", 20, 0, 0, 0, 33, zlib.crc32(content), len(content), len(content), len(name), 0)
        entries.insert(0, (name, fields))
        whole = b"PK\3\4" + fields + name + content
        content = header(len(whole)) + whole
    # From each member to the next: the record of 30 bytes, its name, and the header of the array.
    places = range(0, n_members * (30 + 8 + 128), 30 + 8 + 128)
    table = b"".join(
        b"PK\1\2" + struct.pack("<H", 20) + fields + struct.pack("<3H2I", 0, 0, 0, 0, at) + name
        for at, (name, fields) in zip(places, entries, strict=True)
    )
    return whole + table + b"PK\5\6" + struct.pack("<4H2IH", 0, 0, n_members, n_members, len(table), len(whole), 0)


def test_members_that_lie_in_each_other(tmp_path: Path) -> None:
    path = tmp_path / "nested.npz"
    path.write_bytes(nested(2, 10))
    assert [len(array) for array in read_npz(path, "write it again").values()] == [176, 10]
    path.write_bytes(nested(200, 2**20))
    with pytest.raises(ValueError, match=r"nested\.npz: .* bytes would become \d{9} bytes"):
        read_npz(path, "write it again")


def test_a_million_members(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="more than 20000 members"):
        read_npz(million_members(tmp_path / "many.npz"), "write it again")

"""Ways to damage a file: blindly, and by what its format is."""

from __future__ import annotations

import io
import json
import random
import re
import zipfile
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import yaml

_PIECES = (
    b"NaN", b"Infinity", b"-1e999", b"9" * 400, b"9" * 5000, b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"[" * 5000, b'{"a":' * 3000,
    b"true", b"null", b"\r\n", b"\r", b'"', b"'", b",,,,", b"<script>", b"../../", b"\xe2\x80\xae",
    b"\xe2\x80\xa8", b"a" * 70_000,
    b"\\ud800", b"-0", b"1_000", b"0x10", b"\xd9\xa3", b"=", b":", b"!!python/object/apply:os.abort []", b"&a", b"*a",
    b"<<: *a", b"!!timestamp x", b"!!bool x", b"- " * 2000, b"%YAML 9.9\n", b"\t", b"PK\x05\x06", b"\x93NUMPY",
)  # fmt: skip
#: Values that take the place of others in trees of data.
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 7, 10**30, -(2**63), 2**31, 1e308, -1e308, 1e-320, float("nan"), float("inf"),
    0.5, "", "x",
    "1e-3", "nan", "lin_1", "../x.zip", "/etc/passwd", "é\u2028\u202e", "a" * 5000, [], {}, [[]], [1, "a"],
    {"a": 1}, {"": None},
    [None] * 50, "sb3_uav.training.ITSCallback", "os.system", "dict(a=1)",
)  # fmt: skip
_DESCRIPTIONS = (
    "'<f8'", "'<f4'", "'>f8'", "'|O'", "'|b1'", "'<i8'", "'<u1'", "'<c16'", "'<U9'", "'|S0'", "'<M8[ns]'", "'|V16'", "'f8,i4'",
    "[('a', '<f8')]", "('<f8', (2,))", "('<f8', (1000000000,))", "None", "7", "'x'", "''", "[('a', ('<f8', (99999,)))]",
    "'<f2'",
)  # fmt: skip
_SHAPES = (
    "()", "(0,)", "(1,)", "(3,)", "(2, 5)", "(10**9,)", "(1000000000000,)", "(-1,)", "(2**70,)", "(3, 0)", "(None,)", "(1.5,)",
    "[3]", "(True,)", "3", "(65536, 65536, 65536, 65536)", "(" + "1," * 70 + ")", "(" * 300 + ")" * 300,
)  # fmt: skip


def bytes_changed(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """:return: The file with a few blind changes: flips, cuts, copies, pieces, and halves of other files"""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        size = len(found)
        place, length = rng.randrange(size + 1), rng.choice((1, 2, 8, 40, 300))
        kind = rng.randrange(8)
        if kind == 0 and size:
            found[rng.randrange(size)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del found[place:]
        elif kind == 2:
            del found[place : place + length]
        elif kind == 3:
            found[place:place] = found[place : place + length] * rng.choice((1, 1, 50))
        elif kind == 4:
            found[place : place + rng.choice((0, 0, 1, 5, length))] = rng.choice(_PIECES)
        elif kind == 5:
            found[place : place + length] = rng.randbytes(length)
        elif kind == 6:
            other = rng.choice(others)
            found[place:] = other[rng.randrange(len(other) + 1) :]
        elif size:
            found[rng.randrange(size)] = rng.choice(b"\0\xff\x80 ,\n0-[{\"':")
    return bytes(found)


def tree_changed(rng: random.Random, tree: Any, values: Sequence[Any] = VALUES) -> Any:
    """:return: A copy of plain data with a few changes: values, keys, fields dropped, repeated, nested or exchanged"""
    tree = json.loads(json.dumps(tree))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = list(_places(tree))
        if not places:
            return rng.choice(values)
        box, key = rng.choice(places)
        kind = rng.randrange(9)
        if kind <= 3:
            box[key] = rng.choice(values)
        elif kind == 4:
            del box[key]
        elif kind == 5:
            other_box, other_key = rng.choice(places)
            box[key] = json.loads(json.dumps(other_box[other_key]))
        elif kind == 6 and isinstance(box, dict):
            box[rng.choice(("", "x", key + "s", key[:-1], key.upper(), "__class__"))] = box.pop(key)
        elif kind == 7:
            box[key] = _nested(box[key], rng.choice((1, 2, 60)), rng.random() < 0.5)
        elif isinstance(box, list):
            box[key:key] = [box[key]] * rng.choice((1, 2, 30))
        elif isinstance(box[key], int | float):
            box[key] = rng.choice((-box[key], box[key] + 1, str(box[key]), [box[key]], box[key] * 1000, float(box[key])))
    return rng.choice(values) if rng.random() < 0.01 else tree


def _places(tree: Any) -> Any:
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ():
        yield tree, key
        yield from _places(tree[key])


def _nested(value: Any, depth: int, as_list: bool) -> Any:
    for _ in range(depth):
        value = [value] if as_list else {"a": value}
    return value


def json_changed(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """:return: A JSON file with changes of its data; at times of its bytes"""
    if rng.random() < 0.3:
        return bytes_changed(rng, data, others)
    return json.dumps(tree_changed(rng, json.loads(data)), ensure_ascii=rng.random() < 0.5).encode("utf-8", "surrogatepass")


def lines_changed(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """:return: A table or another text of lines with changes of cells, lines and columns; at times of its bytes"""
    if rng.random() < 0.35:
        return bytes_changed(rng, data, others)
    lines = data.decode("utf-8", "replace").split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        row = rng.randrange(len(lines))
        mark = next((mark for mark in (",", ";", "\t", " ") if mark in lines[row]), ",")
        cells = lines[row].split(mark)
        cell, kind = rng.randrange(len(cells)), rng.randrange(8)
        if kind <= 2:
            cells[cell] = str(rng.choice(VALUES))
        elif kind == 3:
            del cells[cell]
        elif kind == 4:
            cells[cell:cell] = [cells[cell]]
        elif kind == 5:
            lines[row:row] = [lines[row]] * rng.choice((1, 1, 100))
            continue
        elif kind == 6:
            del lines[row]
            lines = lines or [""]
            continue
        elif re.fullmatch(r"-?[\d.]+", cells[cell]):
            cells[cell] = rng.choice(
                (f"-{cells[cell]}", f"{cells[cell]}e300", f"{cells[cell]},5", f" {cells[cell]} ", "1e-320")
            )
        lines[row] = mark.join(cells)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def json_lines_changed(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """:return: A file with JSON in each line, one of them changed"""
    if rng.random() < 0.4:
        return lines_changed(rng, data, others)
    lines = data.decode().splitlines()
    row = rng.randrange(len(lines))
    lines[row] = json.dumps(tree_changed(rng, json.loads(lines[row])))
    return ("\n".join(lines) + "\n").encode()


def yaml_changed(values: Sequence[Any] = VALUES, blindly: float = 0.4) -> Callable[..., bytes]:
    """:return: A function that changes the data of a YAML file; at times its text, or what its aliases name"""

    def change(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
        choice = rng.random()
        if choice < blindly:
            return bytes_changed(rng, data, others)
        if choice < blindly + 0.05:
            return data + _laughs(rng)
        tree = tree_changed(rng, yaml.safe_load(data), values)
        return yaml.safe_dump(tree, allow_unicode=True, default_flow_style=rng.random() < 0.2).encode("utf-8", "surrogatepass")

    return change


def _laughs(rng: random.Random) -> bytes:
    """:return: Aliases of aliases, which written out would fill any memory, as lists or as merged mappings; or a circle"""
    if rng.random() < 0.2:
        return b"\ncircle: &a [*a, {b: *a}]\n"
    merge, lines = rng.random() < 0.5, ["l0: &l0 {a: 1, b: 2}"]
    for level in range(1, rng.choice((3, 9, 40))):
        aliases = ", ".join([f"*l{level - 1}"] * 9)
        lines.append(f"l{level}: &l{level} " + (f"{{<<: [{aliases}], k{level}: 1}}" if merge else f"[{aliases}]"))
    return ("\n" + "\n".join(lines) + "\n").encode()


def npy_changed(rng: random.Random, data: bytes) -> bytes:
    """:return: An array file with another header, or other numbers"""
    if rng.random() < 0.15:
        return bytes_changed(rng, data, [data])
    if rng.random() < 0.5:
        array = np.load(io.BytesIO(data), allow_pickle=False)
        return _npy(_array_changed(rng, array), rng)
    length = int.from_bytes(data[8:10], "little")
    header, content = data[10 : 10 + length].decode("latin1"), data[10 + length :]
    for _ in range(rng.choice((1, 1, 2))):
        key, choices = rng.choice(
            (("descr", _DESCRIPTIONS), ("shape", _SHAPES), ("fortran_order", ("True", "False", "1", "None")))
        )
        value = rng.choice(choices)
        header = re.sub(rf"('{key}': ).*?(?=, '|, \}}|\n)", lambda match: match[1] + value, header, count=1)  # noqa: B023
    if rng.random() < 0.1:
        header = rng.choice(
            ("", "{}", "7", "(" * 5000, "{'descr': '<f8'}", header * 2, "\0", "__import__('os')", "{" + header)
        )
    version = rng.choice((b"\1\0",) * 8 + (b"\2\0", b"\3\0", b"\0\0", b"\xff\0"))
    size = len(header).to_bytes(2 if version == b"\1\0" else 4, "little") if rng.random() < 0.95 else b"\xff\xff"
    return b"\x93NUMPY" + version + size + header.encode("latin1") + content


def _array_changed(rng: random.Random, array: np.ndarray) -> np.ndarray:
    kind = rng.randrange(7)
    if kind <= 1 and array.size:
        changed = array.astype(np.float64)
        changed.flat[rng.randrange(array.size)] = rng.choice((np.nan, np.inf, -1, 1e308, 1e-320, 0.5, 2**31, 1e18))
        return changed
    if kind == 2:
        return array.astype(rng.choice(("f2", "f4", "i8", "u1", "bool", "c16", "U8", "S3", "O", "M8[s]")), casting="unsafe")
    if kind == 3:
        return array[rng.choice((slice(0, 0), slice(1, None), slice(None, None, -1)))] if array.ndim else array[None]
    if kind == 4:
        return array.T if rng.random() < 0.5 else np.asfortranarray(array)
    return np.repeat(array, rng.choice((0, 2, 50)), axis=-1) if array.ndim and kind == 5 else np.atleast_1d(array).ravel()


def _npy(array: np.ndarray, rng: random.Random) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def zip_changed(inside: Callable[[random.Random, str, bytes], bytes]) -> Callable[..., bytes]:
    """
    :param inside: Changes a member, given its name and content
    :return: A function that changes a zip: its members, their names and sizes; at times its bytes
    """

    def change(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
        if rng.random() < 0.3:
            # Half of the time in the table of contents, where names, sizes and offsets are.
            start = data.rfind(b"PK\1\2") if rng.random() < 0.5 else 0
            return data[:start] + bytes_changed(rng, data[start:], others)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
        for _ in range(rng.choice((1, 1, 2))):
            place = rng.randrange(len(members))
            name, content, packed = members[place]
            kind = rng.randrange(12)
            if kind <= 6:
                members[place] = (name, inside(rng, name, content), packed)
            elif kind == 7:
                name = rng.choice(
                    ("", "../x.npy", "/a", name + "s", "a" * 3000, name.upper(), "x\0y", "\u202e.npy", "__class__.npy")
                )
                members[place] = (name, content, packed)
            elif kind == 8 and len(members) > 1:
                del members[place]
            elif kind == 9:
                members.insert(place, rng.choice(members))
            elif kind == 10:
                members[place] = (name, content, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)))
            else:
                members[place] = (name, members[rng.randrange(len(members))][1], packed)
        return _zipped(members) if rng.random() < 0.98 else _bomb(members[0][0])

    return change


def _zipped(members: Sequence[tuple[str, bytes, int]]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content, packed in members:
            archive.writestr(zipfile.ZipInfo(name), content, packed)
    return file.getvalue()


@cache
def _bomb(name: str, mebibytes: int = 1024) -> bytes:
    """:return: A zip with a member of 1 GiB of zeros, behind the header of an array that fits"""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (mebibytes * 2**20,)})
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = packer.compress(header.getvalue()) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    packed, crc = start + block * mebibytes + packer.flush(), zlib.crc32(header.getvalue())
    for _ in range(mebibytes):
        crc = zlib.crc32(bytes(2**20), crc)
    sizes = b"".join(n.to_bytes(4, "little") for n in (crc, len(packed), len(header.getvalue()) + mebibytes * 2**20))
    text = name.encode("utf-8", "replace")[:1000]
    fields = b"\x14\0\0\0\x08\0\0\0\0\0" + sizes + len(text).to_bytes(2, "little") + b"\0\0"
    local = b"PK\3\4" + fields + text + packed
    table = b"PK\1\2\x14\0" + fields + b"\0" * 14 + text
    ends = len(table).to_bytes(4, "little") + len(local).to_bytes(4, "little")
    return local + table + b"PK\5\6\0\0\0\0\1\0\1\0" + ends + b"\0\0"


def npz_member(rng: random.Random, name: str, content: bytes) -> bytes:
    """:return: A changed array of an ``.npz``"""
    return npy_changed(rng, content)


def tensor_member(rng: random.Random, name: str, content: bytes) -> bytes:
    """:return: A changed member of a zip of torch: mostly flips in its pickle, which names shapes, strides and types"""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if found:
            place = rng.randrange(len(found))
            found[place] = rng.choice((found[place] ^ (1 << rng.randrange(8)), 0, 255, rng.randrange(256)))
    return bytes(found)


def policy_member(rng: random.Random, name: str, content: bytes) -> bytes:
    """:return: A changed member of a zip of Stable-Baselines3: its attributes as data, its tensors as a zip"""
    if name == "data":
        return json_changed(rng, content, [content])
    if name.endswith(".pth"):
        return zip_changed(tensor_member)(rng, content, [content])
    return bytes_changed(rng, content, [content])

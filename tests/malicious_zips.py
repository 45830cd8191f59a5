"""Zips as an attacker would write them, each made from a harmless one."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch as th

MIB = 2**20
FIRST = "features_extractor.project_graph.weight"


class Touch:
    """Whoever unpickles it creates a file, as it could run anything else."""

    def __init__(self, proof: Path) -> None:
        self.proof = str(proof)

    def __reduce__(self) -> Any:
        return os.system, (f"touch '{self.proof}'",)


def contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def saved(value: Any) -> bytes:
    stream = io.BytesIO()
    th.save(value, stream)
    return stream.getvalue()


def torch_zip(pickled: bytes, storages: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """What ``th.save`` would write, with any pickle and any storages."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("archive/data.pkl", pickled)
        for key, content in storages.items():
            archive.writestr(f"archive/data/{key}", content)
        archive.writestr("archive/version", "3\n")
    return stream.getvalue()


def one_tensor(
    claimed: int, size: tuple[int, ...], stride: tuple[int, ...], kind: str = "FloatStorage", key: str = "0"
) -> bytes:
    """The pickle of a state dict of one tensor, with numbers that need not be true."""

    def number(value: int) -> bytes:
        body = value.to_bytes(9, "little", signed=True)
        return pickle.LONG1 + bytes([len(body)]) + body

    def text(value: str) -> bytes:
        return b"X" + struct.pack("<I", len(value)) + value.encode()

    def numbers(values: tuple[int, ...]) -> bytes:
        return b"(" + b"".join(map(number, values)) + b"t"

    storage = b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text(key) + text("cpu") + number(claimed) + b"tQ"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + number(0) + numbers(size) + numbers(stride)
    tensor += b"\x89ccollections\nOrderedDict\n)RtR"
    return b"\x80\x02}" + text(FIRST) + tensor + b"s."


def settings_corpus(good: dict[str, bytes]) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Settings that would build something else, or never end."""
    data = json.loads(good["data"])
    wrong: dict[str, list[Any]] = {
        "n_layers": [10**5, 10**30, -1, True, 1.0, 7, [1], "1", float("nan")],
        "embed_dim": [10**7, 10**30, 0, -8, 2**13, False, 8.5, {"a": 1}],
        "n_heads": [0, 10**9, 3],
        "ff_dim": [10**9, 2**15, -1],
        "bias_dim": [2**13, 10**9, float("inf")],
        "net_arch": [
            [10**9],
            [64] * 1000,
            [2**15, 2**15],
            [-1],
            [True],
            {"pi": [2**16, 2**16]},
            {"x": [1]},
            "8",
            [[[1]]],
            {"pi": 3},
        ],
        "geometry": [1, "yes", []],
        "preset": [["default"], {"a": 1}, "x" * 10_000],
        "features_extractor_kwargs": [{"n_layers": 10**5}, {"embed_dim": 10**7}, 3, [1]],
        "features_extractor_class": ["sb3_uav.__main__", "sb3_uav.nothing"],
        "activation_fn": ["torch.nn.ReLU"],
    }
    for name, values in wrong.items():
        for index, value in enumerate(values):
            kwargs = {**data["policy_kwargs"], name: value}
            yield f"{name}_{index}", {**good, "data": json.dumps({**data, "policy_kwargs": kwargs}).encode()}


def json_corpus(good: dict[str, bytes]) -> Iterator[tuple[str, dict[str, bytes]]]:
    for name, text in {
        "deep_lists": b'{"a":' + b"[" * 10**6 + b"]" * 10**6 + b"}",
        "deep_objects": b'{"a":' * 500 + b"1" + b"}" * 500,
        "many_values": b'{"a":[' + b"[]," * MIB + b"1]}",
        "huge_number": b'{"policy_kwargs":{"n_layers":' + b"9" * 10**6 + b"}}",
        "huge_string": b'{"policy_kwargs":"' + b"x" * (17 * MIB) + b'"}',
        "list": b"[1]",
        "not_utf8": b'{"a":"\xff\xfe"}',
        "half": b'{"policy_kwargs":{"embed_dim":',
    }.items():
        yield f"json_{name}", {**good, "data": text}


def tensors_corpus(good: dict[str, bytes], proof: Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Contents of ``policy.pth`` that are no plain dense numbers of the right shapes."""
    state = th.load(io.BytesIO(good["policy.pth"]), weights_only=True)
    whole = state[FIRST]
    quantized = th.quantize_per_tensor(whole, 0.1, 0, th.qint8)
    values: dict[str, Any] = {
        "coo": whole.to_sparse(),
        "csr": whole.to_sparse_csr(),
        "quantized": quantized,
        "complex": whole.to(th.complex64),
        "meta": whole.to("meta"),
        "float64": whole.double(),
        "float16": whole.half(),
        "bfloat16": whole.bfloat16(),
        "float8": whole.to(th.float8_e4m3fn),
        "int64": whole.long(),
        "bool": whole.bool(),
        "nan": whole * float("nan"),
        "inf": whole + float("inf"),
        "transposed": th.empty(whole.shape[::-1]).t(),
        "stride_0": th.zeros(1).expand(10**12),
        "shape": whole.flatten(),
        "nested": th.nested.nested_tensor([whole[0], whole[1, :1]], layout=th.jagged),
        "number": 1.0,
        "text": "x" * 1000,
        "list": [whole],
        "none": None,
    }
    for name, value in values.items():
        yield f"tensor_{name}", {**good, "policy.pth": saved({**state, FIRST: value})}
    for name, found in {
        "integer_keys": dict(enumerate(state.values())),
        "one_missing": {key: value for key, value in state.items() if not key.startswith("value_net.bias")},
        "one_more": {**state, "more": whole},
        "many": {**state, **{f"t{number}": th.zeros(1) for number in range(12_000)}},
        "many_values": dict.fromkeys(range(10**5), 1),
        "empty": {},
        "a_list": list(state.values()),
        "module": th.nn.Linear(2, 2),
        "system": {**state, FIRST: Touch(proof)},
    }.items():
        yield f"state_{name}", {**good, "policy.pth": saved(found)}
    for name, content in {
        "claims_1e12": torch_zip(one_tensor(10**12, (10**12,), (1,)), {"0": bytes(8)}),
        "claims_more": torch_zip(one_tensor(100, (100,), (1,)), {"0": bytes(8)}),
        "stride_0_claimed": torch_zip(one_tensor(2, (10**12,), (0,)), {"0": bytes(8)}),
        "stride_0_small": torch_zip(one_tensor(64, (64,), (0,)), {"0": bytes(256)}),
        "negative": torch_zip(one_tensor(2, (-1,), (1,)), {"0": bytes(8)}),
        "overflow": torch_zip(one_tensor(2**60, (2**30, 2**30), (2**30, 1)), {"0": bytes(8)}),
        "no_storage": torch_zip(one_tensor(2, (2,), (1,)), {}),
        "storage_outside": torch_zip(one_tensor(2, (2,), (1,), key="../version"), {"0": bytes(8)}),
        "unknown_storage": torch_zip(one_tensor(2, (2,), (1,), kind="nn.Module"), {"0": bytes(8)}),
        "inner_bomb": torch_zip(one_tensor(2**22, (2**22,), (1,)), {"0": bytes(4 * 2**22)}, zipfile.ZIP_DEFLATED),
        "system": torch_zip(pickle.dumps(Touch(proof), 2), {}),
        "builtins": torch_zip(b"\x80\x02cbuiltins\neval\nX\x04\x00\x00\x001+1.\x85R.", {}),
        "getattr": torch_zip(b"\x80\x02cbuiltins\ngetattr\n)R.", {}),
        "deep_tuples": torch_zip(b"\x80\x02}" + b")" + b"\x85" * 10**6 + b"Ns.", {}),
        "deep_key": torch_zip(b"\x80\x02}" + b")" + b"\x85" * 10**5 + b"Ns.", {}),
        "long_memo": torch_zip(b"\x80\x02Nr\xff\xff\xff\x7f.", {}),
        "long_text": torch_zip(b"\x80\x02X\xff\xff\xff\x7fabc.", {}),
        "long_bytes": torch_zip(b"\x80\x04\x8e" + b"\xff" * 7 + b"\x00abc.", {}),
        "doubling": torch_zip(b"\x80\x02]" + b"q\x00h\x00h\x00e" * 100 + b".", {}),
        "no_pickle": torch_zip(b"", {}),
        "plain_pickle": pickle.dumps(Touch(proof), 2),
        "garbage": b"garbage" * 100,
        "nothing": b"",
    }.items():
        yield f"file_{name}", {**good, "policy.pth": content}


def _patched(path: Path, signature: bytes, offset: int, value: bytes) -> None:
    """Overwrite a field of the first record with this signature that belongs to the outer zip's last table of contents."""
    content = bytearray(path.read_bytes())
    start = struct.unpack("<L", content[-6:-2])[0] if signature == b"PK\x01\x02" else 0
    at = content.index(signature, start) + offset
    content[at : at + len(value)] = value
    path.write_bytes(content)


def zips_corpus(good: dict[str, bytes], folder: Path) -> Iterator[tuple[str, Path]]:
    """Tables of contents that lie, or that no program would write."""

    def changed(name: str, change: Callable[[Path], object], members: dict[str, bytes] | None = None, method: int = 0) -> Any:
        path = write(folder / f"zip_{name}.zip", good if members is None else members, method)
        change(path)
        return f"zip_{name}", path

    def nothing(_: Path) -> None:
        pass

    zeros = torch_zip(one_tensor(2**22, (2**22,), (1,)), {"0": bytes(4 * 2**22)})
    packed = zipfile.ZIP_DEFLATED
    yield changed("bomb", nothing, {**good, "policy.pth": zeros}, packed)
    yield changed("data_bomb", nothing, {**good, "data": b'{"a":"' + bytes(20 * MIB) + b'"}'}, packed)
    # It states 100 bytes, and unpacks to 16 MiB.
    small = struct.pack("<L", 100)
    yield changed("lying_bomb", lambda p: _patched(p, b"PK\x01\x02", 24, small), {"policy.pth": zeros, **good}, packed)
    yield changed("claims_4_gib", lambda p: _patched(p, b"PK\x01\x02", 20, b"\xfe\xff\xff\xff" * 2))
    yield changed("wrong_checksum", lambda p: _patched(p, b"PK\x01\x02", 16, b"abcd"))
    yield changed("encrypted", lambda p: _patched(p, b"PK\x01\x02", 8, b"\x01\x00"))
    yield changed("method", lambda p: _patched(p, b"PK\x01\x02", 10, b"\x0c\x00"))
    yield changed("offset", lambda p: _patched(p, b"PK\x01\x02", 42, b"\xff\xff\xff\x7f"))
    yield changed("end_counts", lambda p: _patched(p, b"PK\x05\x06", 8, b"\xff" * 12), {"policy.pth": b"", "data": b"{}"})
    yield changed("lzma", nothing, None, zipfile.ZIP_LZMA)
    yield changed("cut", lambda p: p.write_bytes(p.read_bytes()[:-30]))
    yield changed("preamble", lambda p: p.write_bytes(b"#!/bin/sh\n" + p.read_bytes()))
    yield changed("no_policy", nothing, {"data": good["data"]})
    yield changed("no_data", nothing, {"policy.pth": good["policy.pth"]})
    yield changed("nothing", nothing, {})
    for name in ("/etc/passwd", "../up", "a/../../up", "C:/x", "back\\..\\up", "folder/", "bell\a"):
        yield changed(f"name_{len(name)}_{ord(name[0])}", nothing, {**good, name: b"x"})
    yield changed("many_members", nothing, {**good, **{f"m{number}": b"" for number in range(500)}})
    link = zipfile.ZipInfo("policy.pth")
    link.external_attr = 0o120777 << 16
    path = folder / "zip_link.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", good["data"])
        archive.writestr(link, good["policy.pth"])
    yield "zip_link", path
    path = write(folder / "zip_twice.zip", good)
    content = path.read_bytes().replace(b"system_info.txt", b"policy.pth12345")
    path.write_bytes(content.replace(b"policy.pth12345", b"policy.pth\0\0\0\0\0"))
    yield "zip_twice", path
    yield "zip_million", million_members(folder / "zip_million.zip")
    # 600 MiB of holes in front of the end: nothing on the disk, but to be read.
    path = write(folder / "zip_sparse.zip", {})
    end = path.read_bytes()
    with path.open("wb") as file:
        file.seek(600 * MIB)
        file.write(end)
    yield "zip_sparse", path


def million_members(path: Path) -> Path:
    """A table of contents of a million entries for one empty member, in zip64."""
    n = 10**6
    local = struct.pack("<4s5H3L2H", b"PK\x03\x04", 20, 0, 0, 0, 0, 0, 0, 0, 1, 0) + b"a"
    entry = struct.pack("<4s6H3L5H2L", b"PK\x01\x02", 20, 20, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0) + b"a"
    size, at = n * len(entry), len(local)
    end64 = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, n, n, size, at)
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, at + size, 1)
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    with path.open("wb") as file:
        file.write(local)
        for _ in range(10):
            file.write(entry * (n // 10))
        file.write(end64 + locator + end)
    return path


def malicious_zips(good: Path, folder: Path, proof: Path) -> Iterator[tuple[str, Path]]:
    """
    :param good: The zip of one of our policies
    :param folder: Where to write, one file at a time: each is removed when the next one is asked for
    :param proof: A file that exists if something was executed
    :return: Names of the attacks, and the files
    """
    members = contents(good)
    for corpus in (settings_corpus(members), json_corpus(members), tensors_corpus(members, proof)):
        for name, content in corpus:
            yield name, write(path := folder / f"{name}.zip", content)
            path.unlink()
    for name, path in zips_corpus(members, folder):
        yield name, path
        path.unlink()

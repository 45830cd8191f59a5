"""
Tensors from files that strangers have written with ``th.save``.

``th.load(weights_only=True)`` executes nothing either, but it builds what the file claims before anybody can look at it:
storages larger than their bytes, strides of 0 that make a trillion numbers of one, sparse and quantized tensors. Here the
pickle is walked through first; tensors are dense, and their bytes are there.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th

from sb3_uav.common.checked_zip import MAX_MEMBERS, MIB, CheckedZip, ZipDamageError
from sb3_uav.common.plain_pickle import MAX_BYTES, Name, NotPlainError, PlainPickle

# 25 million parameters; the default networks have 0.2 million, the paper's 0.7 million.
MAX_TENSOR_BYTES = 96 * MIB
# Several names of one tensor are views of one storage, such as those of a shared extractor.
_MAX_VIEWS = 4 * MAX_TENSOR_BYTES
_KINDS = {
    "FloatStorage": th.float32,
    "DoubleStorage": th.float64,
    "HalfStorage": th.float16,
    "BFloat16Storage": th.bfloat16,
    "LongStorage": th.int64,
    "IntStorage": th.int32,
    "BoolStorage": th.bool,
}


class _Storage(NamedTuple):
    """A storage that a tensor names: its key in the zip, its type and its number of elements."""

    key: str
    dtype: th.dtype
    n_elements: int


def read_tensor_file(content: bytes) -> Any:
    """
    :param content: What ``th.save`` has written
    :return: Numbers, strings, lists, dictionaries and dense tensors on the CPU, of the plain types
    :raises ValueError: If the file is damaged, or holds something else
    """
    try:
        with CheckedZip(content, MAX_MEMBERS, MAX_TENSOR_BYTES, paths=True, packed=False) as archive:
            return _TensorReader(archive).read()
    except (ZipDamageError, NotPlainError) as error:
        raise ValueError(str(error)) from error


class _TensorReader:
    def __init__(self, archive: CheckedZip) -> None:
        self._archive = archive
        self._storages: dict[str, tuple[_Storage, th.Tensor]] = {}
        self._n_bytes = 0

    def read(self) -> Any:
        pickles = [name for name in self._archive.members if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ZipDamageError("it is not a zip of torch.save, as it has no data.pkl")
        self._root = pickles[0].removesuffix("data.pkl")
        order = f"{self._root}byteorder"
        if order in self._archive.members and self._archive.read(order, 10).decode("ascii", "replace") != sys.byteorder:
            raise ZipDamageError("its numbers have the byte order of another kind of computer")
        calls: dict[Name, Callable[..., Any]] = {
            Name("collections", "OrderedDict"): lambda: {},
            Name("torch._utils", "_rebuild_tensor_v2"): self._tensor,
            Name("torch._utils", "_rebuild_parameter"): lambda data, requires_grad, hooks: data,
        }
        return PlainPickle(calls, self._storage).load(self._archive.read(pickles[0], MAX_BYTES))

    def _storage(self, found: Any) -> _Storage:
        if not isinstance(found, tuple) or len(found) != 5 or found[0] != "storage":
            raise NotPlainError("a storage is not described as torch.save does")
        _, kind, key, _, n_elements = found
        dtype = _KINDS.get(kind.name) if isinstance(kind, Name) and kind.module == "torch" else None
        if dtype is None:
            name = f"{kind.module:.60}.{kind.name:.60}" if isinstance(kind, Name) else type(kind).__name__
            raise NotPlainError(f"a tensor has the storage {name}, not one of plain numbers")
        if not isinstance(key, str) or not _is_count(n_elements):
            raise NotPlainError("a storage is not described as torch.save does")
        return _Storage(key, dtype, n_elements)

    def _tensor(
        self,
        storage: Any,
        offset: Any,
        size: Any,
        stride: Any,
        requires_grad: Any = False,
        hooks: Any = None,
        more: Any = None,
    ) -> th.Tensor:
        if not isinstance(storage, _Storage) or more is not None:
            raise NotPlainError("a tensor is not described as torch.save does")
        if not (isinstance(size, tuple) and isinstance(stride, tuple) and len(size) == len(stride) <= 8):
            raise NotPlainError("a tensor has no plain shape")
        if not all(map(_is_count, (offset, *size, *stride))):
            raise NotPlainError("a tensor has no plain shape: an offset, a size or a stride is no count")
        n_elements = math.prod(size)
        if offset + n_elements > storage.n_elements:
            raise NotPlainError(
                f"a tensor claims {n_elements} numbers of shape {size} at offset {offset} of a storage of {storage.n_elements}"
            )
        expected = [math.prod(size[axis + 1 :]) for axis in range(len(size))]
        if n_elements and any(n > 1 and step != plain for n, step, plain in zip(size, stride, expected, strict=True)):
            raise NotPlainError(f"a tensor of shape {size} has the strides {stride}, not those of a dense one")
        self._n_bytes += n_elements * storage.dtype.itemsize
        if self._n_bytes > _MAX_VIEWS:
            raise NotPlainError(f"its tensors claim more than {_MAX_VIEWS} bytes")
        return self._numbers(storage)[offset : offset + n_elements].view(size)

    def _numbers(self, storage: _Storage) -> th.Tensor:
        """The numbers of a storage, each read once."""
        if storage.key not in self._storages:
            name = f"{self._root}data/{storage.key}"
            if name not in self._archive.members:
                raise NotPlainError(f"member {name!r:.80} is missing in it")
            found, claimed = self._archive.members[name].file_size, storage.n_elements * storage.dtype.itemsize
            if found != claimed:
                raise NotPlainError(f"member {name!r:.80} has {found} bytes, but its tensor claims {claimed}")
            numbers = th.empty(storage.n_elements, dtype=storage.dtype, device="cpu")
            if claimed:
                self._archive.read_into(name, numbers.view(th.uint8).numpy().data)
            self._storages[storage.key] = storage, numbers
        described, numbers = self._storages[storage.key]
        if described != storage:
            raise NotPlainError(f"storage {storage.key!r:.40} is described in two ways")
        return numbers


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**62

"""
Reading the files that our own runs left by ``torch.save``, of any size, and perhaps damaged since.

The zips of strangers, which are small, are read more strictly by :mod:`~sb3_uav.common.tensor_file`.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from typing import Any

import torch as th

_MOST_DEPTH = 50


def load_tensors(data: bytes) -> Any:
    """
    Read plain data and dense tensors. Nothing in the file is executed, and memory is allocated only for what it can hold.

    :param data: Content of the file
    :return: What was saved, on the CPU
    :raises ValueError: If the file is damaged, packed, or holds something else
    """
    try:
        # torch.save stores, it does not compress; its reader would unpack a thousandfold.
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
        packed = [member.filename for member in members if member.compress_type != zipfile.ZIP_STORED]
        if packed or sum(member.file_size for member in members) > len(data):
            raise ValueError(f"{packed[0] if packed else 'it'} declares more than the file holds")
        content = th.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        for tensor in _tensors(content, 0):
            _check_dense(tensor)
        return content
    except Exception as error:
        # Given damaged bytes, zipfile and torch raise almost any exception.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{reason:.300}") from error


def _tensors(content: Any, depth: int) -> Iterator[th.Tensor]:
    """:return: All tensors in dictionaries and lists"""
    if depth > _MOST_DEPTH:
        raise ValueError("it is nested too deeply")
    if isinstance(content, th.Tensor):
        yield content
    elif isinstance(content, dict):
        for value in content.values():
            yield from _tensors(value, depth + 1)
    elif isinstance(content, list | tuple | set | frozenset):
        for value in content:
            yield from _tensors(value, depth + 1)


def _check_dense(tensor: th.Tensor) -> None:
    """:raises ValueError: If its numbers are not all there, one after the other, as with a stride of 0"""
    plain = tensor.layout == th.strided and not tensor.is_quantized and tensor.device.type == "cpu"
    if not plain or tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise ValueError(f"a tensor of shape {tuple(tensor.shape)} is not dense, or its numbers are not all there")

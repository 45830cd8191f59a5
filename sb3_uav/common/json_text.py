"""
Reading JSON: that of our own runs, of any size and perhaps damaged since, and that of strangers, whose values are counted
before it is parsed.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from sb3_uav.common.regular_file import MAX_TEXT, read_regular

# Values of one text, and how deep they may lie. SB3's texts have a few hundred values, four deep.
MAX_VALUES, MAX_DEPTH = 200_000, 64
_STRING = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"', re.DOTALL)
_LONG_NUMBER = re.compile(rb"[-+.0-9eE]{100}")


def parse_json(text: str | bytes) -> Any:
    """
    :param text: What should be JSON
    :return: Its content
    :raises ValueError: If it is none, however it fails: ``json`` raises RecursionError for lists within lists without end
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("lists or objects are nested too deeply") from error


def read_json_file(path: Path, most: int = MAX_TEXT) -> Any:
    """
    :param path: A file of JSON
    :param most: The largest size that it may have, in bytes
    :return: Its content
    :raises OSError: If it cannot be read, or is no regular file
    :raises ValueError: If it is too large, or no JSON
    """
    return parse_json(read_regular(path, most).decode("utf-8"))


def read_plain_json(text: bytes, most: int = MAX_VALUES) -> Any:
    """
    :param text: JSON
    :param most: The largest number of values
    :return: What it holds
    :raises ValueError: If it is not JSON, or holds more or deeper values than anything of ours
    """
    # The pickles that SB3 writes are strings, which may be long.
    marks = _STRING.sub(b"", text)
    n_values = sum(marks.count(mark) for mark in (b",", b":", b"[", b"{"))
    if n_values > most:
        raise ValueError(f"it holds {n_values} values, more than the {most} that are read")
    depth = 0
    for mark in re.findall(rb"[\[{\]}]", marks):
        depth += 1 if mark in b"[{" else -1
        if depth > MAX_DEPTH:
            raise ValueError(f"its values are nested more than {MAX_DEPTH} deep")
    if _LONG_NUMBER.search(marks):
        raise ValueError("it holds a number of 100 digits or more")
    return parse_json(text)

"""
Reading the JSON that our own runs left, of any size, and perhaps damaged since.

That of strangers is read more strictly by :mod:`~sb3_uav.common.plain_json`.
"""

from __future__ import annotations

import json
from typing import Any


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

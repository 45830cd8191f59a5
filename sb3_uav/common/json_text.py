"""Reading JSON that may be damaged or hostile."""

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

"""Objects by their dotted path."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def import_object(path: str) -> Any:
    """
    :param path: ``package.module.name``
    :return: The object
    :raises ValueError: If there is none; whatever the import raises is named
    """
    # Of a YAML, a path may be anything.
    module_name, _, name = path.rpartition(".") if isinstance(path, str) else ("", "", "")
    if not module_name:
        raise ValueError(f"{path!r:.80} is no dotted path; write package.module.name.")
    try:
        return getattr(import_module(module_name), name)
    # The module may be anybody's, and fail at anything.
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error


# What a higher room offers to a lower one, by dotted path; filled by the package's __init__.
_OFFERS: dict[str, str] = {}


def offer(what: str, path: str) -> None:
    """
    Let lower rooms use a function of a higher one, which is imported when it is first needed.

    :param what: Name of the offer
    :param path: ``package.module.name``
    """
    _OFFERS[what] = path


def offered(what: str) -> Any:
    """
    :param what: Name of an offer
    :return: The object
    """
    return import_object(_OFFERS[what])

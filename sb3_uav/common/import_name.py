"""Objects by their dotted name, as YAML files give them."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def import_object(path: str) -> Any:
    """
    :param path: ``package.module.name``
    :return: The object
    :raises ValueError: If there is none
    """
    module_name, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(str(error)) from error

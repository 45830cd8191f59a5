"""Packages that an extra of sb3-uav brings."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


def require(module: str, what: str, extra: str) -> ModuleType:
    """
    Import a package that the core does not need.

    :param module: Name of the module
    :param what: What needs the module, the subject of the error message
    :param extra: The extra of sb3-uav that brings it
    :return: The imported module
    :raises ImportError: If it cannot be imported, with the command that installs it
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"{what} needs {module} ({error}); run: pip install 'sb3-uav[{extra}]'") from error

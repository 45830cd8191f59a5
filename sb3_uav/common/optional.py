"""Packages that the core does not need, and the command that installs them."""

from __future__ import annotations

import shlex
from importlib import import_module
from pathlib import Path
from types import ModuleType

# The folder that holds the package: a checkout, or site-packages.
ROOT = Path(__file__).resolve().parents[2]


def install_command(extra: str) -> str:
    """
    :param extra: An extra of sb3-uav
    :return: The shell command that installs it, from any folder: out of the checkout that is in use, where there is one,
        because the package is not on an index
    """
    if (ROOT / "pyproject.toml").is_file() and (ROOT / "setup.cfg").is_file():
        return f"pip install -e {shlex.quote(f'{ROOT}[{extra}]')}"
    return f"pip install {shlex.quote(f'sb3-uav[{extra}]')}"


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
        raise ImportError(f"{what} needs {module} ({error}); run: {install_command(extra)}") from error

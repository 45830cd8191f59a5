"""Checks for the packages that training from YAML needs, made before anything imports them."""

from __future__ import annotations

from sb3_uav.common.optional import require

_EXTRA = "zoo"
_MODULES = ("yaml", "rl_zoo3.train")


def require_zoo(what: str, *others: str) -> None:
    """
    :param what: What needs the packages, the subject of the error message
    :param others: Further modules of the same extra
    :raises ImportError: If one cannot be imported, with the command that installs it
    """
    for module in (*_MODULES, *others):
        require(module, what, _EXTRA)

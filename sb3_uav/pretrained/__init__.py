"""
Trained pairs that come with the package, each in a folder of its own beside its model card.

``allocator.zip`` and ``router.zip`` are ordinary SB3 zips without the state of their optimizers.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["files", "names", "pair_files"]

DEFAULT_PAIR = "universal"
ALLOCATOR_FILE, ROUTER_FILE = "allocator.zip", "router.zip"


def names() -> list[str]:
    """:return: Names of all pairs"""
    return sorted(file.parent.name for file in Path(__file__).parent.glob(f"*/{ALLOCATOR_FILE}"))


def files(name: str = DEFAULT_PAIR) -> tuple[Path, Path]:
    """
    :param name: Name of a pair
    :return: The zips of its allocator and of its router
    :raises ValueError: If there is no such pair
    """
    if name not in names():
        raise ValueError(f"There is no trained pair {name!r}; choose one of {names()}.")
    folder = Path(__file__).parent / name
    return folder / ALLOCATOR_FILE, folder / ROUTER_FILE


def pair_files(allocator: str | None = None, router: str | None = None) -> tuple[Path, Path]:
    """
    :param allocator: A zip, or the name of a pair; the default pair when None
    :param router: A zip; that of the pair when None
    :return: The zips of allocator and router
    :raises ValueError: If one of them is a zip and the other is not given
    """
    if allocator is None or allocator in names():
        found = files(allocator or DEFAULT_PAIR)
        if router is None:
            return found
        if allocator is not None:
            return found[0], Path(router)
    if allocator is None or router is None:
        missing, given = ("allocator", router) if allocator is None else ("router", allocator)
        raise ValueError(
            f"{given} is one zip of a pair, and its {missing} is missing: give both, or the name of a pair, one of {names()}."
        )
    return Path(allocator), Path(router)

"""The checkpoints of a run before its last one: which are kept, and when they are removed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

from sb3_uav.common.files import write_atomically

STATE_FILE = "its_state.json"
# Of earlier checkpoints: epochs of the allocator and of the router.
_EARLIER_STATE = re.compile(r"its_state_(\d+)_(\d+|start)\.json")
_ZIP = re.compile(r"(allocator|router)_(\d+|start)\.zip")


def keep_previous(folder: Path, names: dict[str, str]) -> None:
    """
    Give the state file of the last checkpoint a name of its own, before that of a new one takes its place.

    :param folder: Where the checkpoints are
    :param names: Names of the new zips, ``allocator`` and ``router``
    :raises OSError: If a file cannot be read or written
    """
    state = folder / STATE_FILE
    old = _zips(state)
    # A zip of the same name is that of the new checkpoint now, so that the old one is no longer whole.
    if len(old) == 2 and old != list(names.values()):
        epoch, number = (name.rpartition("_")[2].removesuffix(".zip") for name in old)
        write_atomically(folder / f"its_state_{epoch}_{number}.json", state.read_bytes())


def earlier_states(folder: Path) -> list[Path]:
    """
    :param folder: Where the checkpoints are
    :return: The state files of those before the last one, the newest first
    """
    found = [(match, path) for path in folder.iterdir() if (match := _EARLIER_STATE.fullmatch(path.name))]
    return [path for _, path in sorted(found, key=lambda pair: _order(*pair[0].groups()), reverse=True)]


def remove_old(folder: Path, keep: int) -> None:
    """
    Remove all checkpoints but the last ones, once the last one is complete.

    :param folder: Where the checkpoints are
    :param keep: Number of checkpoints to keep, the last one included
    :raises OSError: If a file cannot be removed
    """
    last = _zips(folder / STATE_FILE)
    newest = _order(*(name.rpartition("_")[2].removesuffix(".zip") for name in last))
    kept, n_kept = set(last), 1
    for path in earlier_states(folder):
        match = _EARLIER_STATE.fullmatch(path.name)
        assert match is not None
        # Later ones are of a run that was continued from an earlier checkpoint.
        if n_kept < keep and _order(*match.groups()) < newest and all((folder / name).is_file() for name in _zips(path)):
            kept.update(_zips(path))
            n_kept += 1
        else:
            # Before its zips, so that no state file names one that is gone.
            path.unlink()
    for path in folder.iterdir():
        if _ZIP.fullmatch(path.name) and path.name not in kept:
            path.unlink()


def _zips(state: Path) -> list[str]:
    """:return: Names of the zips of allocator and router; none if this is no state file of ours"""
    try:
        content = json.loads(state.read_text(encoding="utf-8"))
        names = [content["allocator"], content["router"]]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return []
    return names if all(isinstance(name, str) and _ZIP.fullmatch(name) for name in names) else []


def _order(*parts: str) -> tuple[int, ...]:
    return tuple(-1 if part == "start" else int(part) for part in parts)


def oldest(paths: Iterable[Path], number: re.Pattern[str], keep: int) -> list[Path]:
    """
    :param paths: Files
    :param number: Finds the number in the name of those that count
    :param keep: How many of the highest numbers to keep
    :return: The others
    """
    numbered = [(int(match[1]), path) for path in paths if (match := number.fullmatch(path.name))]
    return [path for _, path in sorted(numbered)[:-keep]]

"""File names that every system takes, made from the names of UAVs."""

from __future__ import annotations

import re

from sb3_uav.missions.plan import Plan

_LONGEST = 80
# Windows refuses these with any suffix: https://learn.microsoft.com/en-us/windows/win32/fileio/naming-a-file.
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def file_stems(plan: Plan) -> tuple[str, ...]:
    """
    :param plan: A plan
    :return: For every UAV a file name without suffix, of letters, digits, ``-``, ``_`` and ``.``; unique, whatever the case
    """
    taken: set[str] = set()
    stems = []
    for number, uav in enumerate(plan.fleet, 1):
        stem = re.sub(r"\.{2,}", ".", re.sub(r"[^A-Za-z0-9._-]+", "_", uav.id[:_LONGEST])).strip("._")
        if not stem or _RESERVED.fullmatch(stem):
            stem = f"uav-{number}-{stem}".rstrip("-")
        unique, again = stem, 2
        while unique.lower() in taken:
            unique, again = f"{stem}-{again}", again + 1
        taken.add(unique.lower())
        stems.append(unique)
    return tuple(stems)

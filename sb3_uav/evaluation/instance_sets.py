"""The sets of instances of an evaluation, of which one file at a time is in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

from sb3_uav.envs.instances import Instances


class InstanceFiles:
    """
    A set of instances in several files, read one after the other, each time that they are needed. Rows are counted within
    their file where solvers draw random numbers.

    :param paths: The ``.npz`` files
    :raises ValueError: If there are none
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise ValueError("There are no instance files; give at least one .npz.")
        self.paths = tuple(paths)
        # Several solvers one after the other need the only file of a set.
        self._last: tuple[Path, Instances] | None = None

    def load(self, part: int) -> Instances:
        """
        :param part: Number of the file, from 0
        :return: Its instances
        :raises OSError: If it cannot be read
        :raises ValueError: If it is damaged
        """
        path = self.paths[part]
        if self._last is None or self._last[0] != path:
            self._last = None
            self._last = (path, Instances.load(path))
        return self._last[1]


class InstanceSet:
    """
    One set of instances, in one or several parts.

    :param name: Its name
    :param first_index: Index of its first instance, counted through all sets
    :param given: The instances, or their files
    :raises ValueError: If a part is empty or damaged, or holds bad numbers
    :ivar sizes: Number of instances of each part
    :ivar sha256: Digest of the contents; that of the instances themselves if there is one part
    """

    def __init__(self, name: str, first_index: int, given: Instances | InstanceFiles) -> None:
        self.name = name
        self.first_index = first_index
        self._given = given.to("cpu") if isinstance(given, Instances) else given
        self.sizes: list[int] = []
        digests = []
        for part in range(1 if isinstance(given, Instances) else len(given.paths)):
            batch = self.load(part)
            if len(batch) == 0:
                raise ValueError(f"The set {name!r} holds no instances; leave it out.")
            try:
                batch.validate()
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            self.sizes.append(len(batch))
            digests.append(batch.digest())
        self.sha256 = digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()

    def __len__(self) -> int:
        return sum(self.sizes)

    def load(self, part: int) -> Instances:
        """
        :param part: Number of a part, from 0
        :return: Its instances, on the CPU
        """
        return self._given if isinstance(self._given, Instances) else self._given.load(part)

    def places(self) -> list[tuple[int, int]]:
        """:return: First row of each part in the set, and the number of its instances"""
        ends = list(accumulate(self.sizes, initial=0))
        return list(zip(ends[:-1], self.sizes, strict=True))

    def part_at(self, first: int) -> Instances:
        """
        :param first: First row of a part
        :return: Its instances
        :raises ValueError: If the file has changed
        """
        places = self.places()
        part = [place for place, _ in places].index(first)
        batch = self.load(part)
        if len(batch) != self.sizes[part]:
            raise ValueError(f"{self.name}: an instance file changed during the evaluation; run it again.")
        return batch

    def description(self) -> dict[str, Any]:
        """:return: Its entry in ``evaluation.json``"""
        return {"name": self.name, "n_instances": len(self), "sha256": self.sha256}


def instance_sets(given: Instances | Mapping[str, Instances | InstanceFiles]) -> list[InstanceSet]:
    """
    :param given: The instances, or several named sets of them
    :return: The sets, counted through
    :raises ValueError: As :class:`InstanceSet`
    """
    sources = {"instances": given} if isinstance(given, Instances) else given
    sets: list[InstanceSet] = []
    n_before = 0
    for name, batch in sources.items():
        sets.append(InstanceSet(name, n_before, batch))
        n_before += len(sets[-1])
    return sets


def files_of(paths: Sequence[Path]) -> dict[str, InstanceFiles]:
    """
    :param paths: ``.npz`` files, and folders: all ``.npz`` files of a folder, in the order of their names, are one set
    :return: The sets by the stem of the file or the name of the folder; by the whole path where these are alike
    :raises FileNotFoundError: If a file is missing, or a folder holds none
    :raises ValueError: If one is given twice
    """
    stems = [path.resolve().name if path.is_dir() else path.stem for path in paths]
    names = [str(path) if stems.count(stem) > 1 else stem for path, stem in zip(paths, stems, strict=True)]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--instances names {name} twice; give every file once.")
    return {name: InstanceFiles(_npz_files(path)) for name, path in zip(names, paths, strict=True)}


def _npz_files(path: Path) -> list[Path]:
    """:return: The file itself, or those in the folder"""
    if not path.is_dir():
        return [path]
    found = sorted(file for file in path.glob("*.npz") if not file.name.startswith(".") and not file.name.endswith(".tmp.npz"))
    if not found:
        raise FileNotFoundError(f"{path}: holds no .npz file; give a folder with instance files, or the files.")
    return found

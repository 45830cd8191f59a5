"""A folder of benchmark files: which are read, how they are named and grouped, and the sets in which they are evaluated."""

from __future__ import annotations

import fnmatch
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sb3_uav.common.regular_file import read_regular
from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.benchmarks.chao import read_chao
from sb3_uav.evaluation.benchmarks.instance import BenchmarkInstance
from sb3_uav.evaluation.benchmarks.oplib import UnsupportedMetricError, read_oplib

_TEXT_SUFFIXES = (".txt", ".oplib", ".op", ".tsp", ".vrp")
# Beside the files of a benchmark.
_NO_BENCHMARKS = (".csv", ".md")


@dataclass(frozen=True)
class BenchmarkFolder:
    """
    :param path: The folder
    :param instances: The instances, by name
    :param unsupported: Files that were left out because of their metric: name and metric
    :param skipped: Files that are no benchmark files, without CSVs and Markdown, which often stand beside them
    """

    path: Path
    instances: dict[str, BenchmarkInstance]
    unsupported: dict[str, str]
    skipped: list[Path]


def read_folder(path: Path, only: Sequence[str] = (), known: Sequence[str] = ()) -> BenchmarkFolder:
    """
    Read all benchmark files in a folder and in the folders in it.

    ``.npz`` files are ours; of text files the content decides. An instance has the name of its file without the suffix; of
    an ``.npz`` with several instances, each has the name of the file, a dot and its row. Instances are in groups: by the
    folder in the folder, if there are several such; otherwise by their name up to the first dot; and all in one if most
    groups would hold only one.

    :param path: The folder, or a single file
    :param only: Patterns of names, such as ``p7.*``; all when empty
    :param known: Names of instances: a text file of such a name must be a benchmark file
    :return: What is there
    :raises FileNotFoundError: If there is no such folder
    :raises ValueError: If a file is damaged, two instances have the same name, or nothing is left
    :raises ImportError: If there are OPLib files and vrplib is not installed
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder; give the folder of the benchmark files.")
    root = path.parent if path.is_file() else path
    files = [path] if path.is_file() else _files(path)
    folders = {file.parent for file in files if file.suffix.lower() not in _NO_BENCHMARKS}
    instances: dict[str, BenchmarkInstance] = {}
    unsupported: dict[str, str] = {}
    skipped: list[Path] = []
    for file in files:
        if only and file.suffix.lower() != ".npz" and not _matches(file.stem, only):
            continue
        place = file.parent.relative_to(root).as_posix()
        group = place if len(folders) > 1 and place != "." else file.stem.partition(".")[0]
        try:
            found = _read_file(file, group, file.stem in known)
        except UnsupportedMetricError as error:
            unsupported[file.stem] = error.metric
            continue
        if found is None and file.suffix.lower() not in _NO_BENCHMARKS:
            skipped.append(file)
        for instance in found or ():
            if instance.name in instances:
                other = instances[instance.name].path
                raise ValueError(f"{file}: {instance.name} is the name of an instance in {other} too; rename one of them.")
            if not only or _matches(instance.name, only):
                instances[instance.name] = instance
    if not instances:
        raise ValueError(f"{path}: {_nothing(only, unsupported)}")
    return BenchmarkFolder(path, _grouped(instances, root.resolve().name), unsupported, skipped)


def _grouped(instances: dict[str, BenchmarkInstance], name: str) -> dict[str, BenchmarkInstance]:
    """:return: The instances, in one group of the given name if most groups would hold only one of them"""
    sizes = Counter(instance.group for instance in instances.values())
    if 2 * sum(size == 1 for size in sizes.values()) <= len(sizes):
        return instances
    return {key: replace(instance, group=name) for key, instance in instances.items()}


def _files(folder: Path) -> list[Path]:
    """:return: All files in a folder and those in it, without hidden ones, in the order of their names"""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [Path(place) / name for name in sorted(names) if not name.startswith(".")]
    return found


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _nothing(only: Sequence[str], unsupported: dict[str, str]) -> str:
    """:return: Why there is nothing to solve"""
    if unsupported:
        metrics = ", ".join(sorted(set(unsupported.values())))
        return f"all benchmark files have metrics that cannot be solved ({metrics}); only EUC_2D can."
    if only:
        return f"no instance has a name like {' '.join(only)}; see the names of the files."
    return "holds no benchmark file (Chao's .txt, OPLib, or .npz of this package); give another folder."


def _read_file(path: Path, group: str, is_known: bool) -> list[BenchmarkInstance] | None:
    """
    :param path: A file
    :param group: Group of its instances
    :param is_known: Whether it must be a benchmark file
    :return: Its instances; None if it is no benchmark file
    :raises ValueError: If it is damaged
    """
    if path.suffix.lower() == ".npz":
        batch = Instances.load(path)
        names = [path.stem] if len(batch) == 1 else [f"{path.stem}.{row}" for row in range(len(batch))]
        # Without padding, so that each can be a part of any set.
        sizes = batch.task_mask.sum(1).tolist()
        return [
            BenchmarkInstance(name, group, path, batch[row].trim(max(size, 1)), tuple(range(size)))
            for row, (name, size) in enumerate(zip(names, sizes, strict=True))
        ]
    if path.suffix.lower() not in _TEXT_SUFFIXES and not is_known:
        return None
    # Comments may be in any encoding; where numbers are damaged, the readers say so.
    text = read_regular(path).decode("utf-8", "replace")
    first = text.split(maxsplit=1)[:1]
    if "_SECTION" in text:
        return [read_oplib(path, text, group)]
    if first == ["n"] or is_known:
        return [read_chao(path, text, group)]
    return None


def evaluation_sets(instances: Sequence[BenchmarkInstance]) -> dict[str, list[BenchmarkInstance]]:
    """
    Arrange instances in sets that are evaluated as one batch: of one group, of one fleet size, all of the paper's problem or
    none, and with at most twice as many tasks in one as in another, because batches are padded.

    :param instances: The instances
    :return: Sets by name, in the order of the instances
    """
    groups: dict[tuple[str, int, bool, int], list[BenchmarkInstance]] = {}
    for instance in instances:
        batch = instance.instances
        key = (instance.group, batch.n_uavs, batch.is_plain, (batch.n_tasks - 1).bit_length())
        groups.setdefault(key, []).append(instance)
    named: dict[str, list[BenchmarkInstance]] = {}
    for (group, n_uavs, is_plain, size), members in groups.items():
        alike = [key for key in groups if key[0] == group]
        parts = [group]
        if len({key[1] for key in alike}) > 1:
            parts.append(f"{n_uavs} UAV{'s' if n_uavs > 1 else ''}")
        if len({key[2] for key in alike}) > 1:
            parts.append("as in the paper" if is_plain else "beyond the paper")
        if len({key[3] for key in alike}) > 1:
            parts.append(f"up to {2**size} tasks")
        named[", ".join(parts)] = members
    return named


def batch_of(members: Sequence[BenchmarkInstance]) -> Instances:
    """
    :param members: A set of :func:`evaluation_sets`
    :return: Its instances as one batch, padded to the largest
    """
    return Instances.concatenate([member.instances for member in members])

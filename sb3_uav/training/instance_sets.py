"""The instances of an evaluation during training: one set, or several of different sizes."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.common.regular_file import read_regular
from sb3_uav.envs.generators import make_generator
from sb3_uav.envs.instances import Instances
from sb3_uav.training.fixed_set_returns import fingerprint

# The logarithm of a mean of 0 tasks is taken of this instead.
_LEAST_MEAN = 1e-9

InstanceSource = str | os.PathLike[str] | Instances


class InstanceSets:
    """
    One or several sets of instances.

    :param sets: Instances by name
    :param is_grid: Whether all sets count alike in a score, however many tasks their instances have
    """

    def __init__(self, sets: Mapping[str, Instances], is_grid: bool) -> None:
        self.sets = dict(sets)
        self.is_grid = is_grid

    @classmethod
    def read(cls, sources: InstanceSource | Sequence[InstanceSource]) -> InstanceSets:
        """
        :param sources: Instances or paths of ``.npz`` files, one or several
        :return: The sets, named after their sizes
        :raises FileNotFoundError: If there is no such file
        :raises ValueError: If there is no set, or a file holds no instances
        """
        given = [sources] if isinstance(sources, str | os.PathLike | Instances) else list(sources)
        if not given:
            raise ValueError("instances is empty; give at least one set.")
        found: dict[str, Instances] = {}
        for source in given:
            instances = source if isinstance(source, Instances) else Instances.load(source)
            name = f"U{instances.n_uavs}-N{instances.n_tasks}"
            number = 1 + sum(other.partition("/")[0] == name for other in found)
            found[name if number == 1 else f"{name}/{number}"] = instances
        return cls(found, is_grid=len(found) > 1)

    @classmethod
    def draw(
        cls, sizes: Sequence[Sequence[Any]], max_distance: float, source: Callable[[int, int], np.random.Generator]
    ) -> InstanceSets:
        """
        :param sizes: UAVs, tasks and number of instances of each set, and the name of their distribution, ``"uniform"`` if
            there is none
        :param max_distance: Maximum flight distance
        :param source: Random generator by numbers of UAVs and tasks
        :return: The sets
        :raises ValueError: If a size is not allowed or stands twice
        """
        found: dict[str, Instances] = {}
        kinds: set[tuple[int, int, str]] = set()
        for size in sizes:
            if len(size) not in (3, 4) or not all(isinstance(number, int) and number >= 1 for number in size[:3]):
                raise ValueError(
                    f"sizes: {size!r:.80} must be three whole numbers of at least 1, UAVs, tasks and number of instances, and "
                    "may name a distribution."
                )
            n_uavs, n_tasks, n_instances = size[:3]
            distribution = str(size[3]) if len(size) == 4 else "uniform"
            name = f"U{n_uavs}-N{n_tasks}" + (f"-{distribution}" if len(size) == 4 else "")
            kind = (n_uavs, n_tasks, distribution)
            if kind in kinds:
                # Also where only one of them names the distribution: both would draw the same instances.
                raise ValueError(
                    f"sizes: {n_uavs} UAVs and {n_tasks} tasks stand twice ({distribution}); name every set once."
                )
            kinds.add(kind)
            generator = make_generator(n_tasks, n_uavs, max_distance, distribution)
            found[name] = generator(n_instances, source(n_uavs, n_tasks))
        if not found:
            raise ValueError("sizes is empty; give at least one triple of UAVs, tasks and number of instances.")
        return cls(found, is_grid=True)

    @property
    def n_instances(self) -> int:
        return sum(map(len, self.sets.values()))

    def for_one_uav(self) -> InstanceSets:
        """The same instances for a single UAV each."""
        return InstanceSets({name: instances.with_fleet(1) for name, instances in self.sets.items()}, self.is_grid)

    def means(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """
        :param values: ``(n_evaluations, n_instances)``, set after set
        :return: Means ``(n_evaluations,)`` by name of the set
        """
        ends = np.cumsum([len(instances) for instances in self.sets.values()])
        return {name: part.mean(1) for name, part in zip(self.sets, np.split(values, ends[:-1], axis=1), strict=True)}

    def score(self, values: np.ndarray) -> np.ndarray:
        """
        :param values: ``(n_evaluations, n_instances)``, set after set
        :return: ``(n_evaluations,)``: the mean; of a grid the mean logarithm of the means of its sets
        """
        means = list(self.means(values).values())
        if not self.is_grid:
            return means[0]
        return np.log(np.maximum(means, _LEAST_MEAN)).mean(0)

    def fingerprint(self, n_samples: int) -> str:
        """
        :param n_samples: Samples per instance
        :return: A name for the evaluation on these sets
        """
        names = [fingerprint(instances, n_samples) for instances in self.sets.values()]
        return names[0] if len(names) == 1 else hashlib.sha256("".join(names).encode()).hexdigest()[:16]

    def save(self, path: Path) -> None:
        """
        :param path: The ``.npz`` of a single set; of several, ``-U4-N80`` and so on is appended to its stem
        """
        for name, instances in self.sets.items():
            suffix = "" if len(self.sets) == 1 else f"-{name.replace('/', '-')}"
            instances.save(path.with_name(f"{path.stem}{suffix}{path.suffix}"))


class SizeTable:
    """
    The means of several sets in the course of a training, as a CSV file for readers.

    :param rows: ``updates``, ``seconds``, the mean of each set by its name, and ``score``
    """

    def __init__(self, rows: list[dict[str, float]] | None = None) -> None:
        self.rows: list[dict[str, float]] = rows or []

    @classmethod
    def load(cls, path: Path, columns: Sequence[str]) -> SizeTable:
        """
        :param path: The CSV file
        :param columns: Names of the sets
        :return: The table
        :raises OSError: If the file cannot be read
        :raises ValueError: If it is damaged or belongs to other sets
        """
        try:
            reader = csv.DictReader(io.StringIO(read_regular(path).decode("utf-8")))
            rows = [{name: float(value) for name, value in row.items()} for row in reader]
            # As they were written.
            rows = [{name: int(value) if name == "updates" else value for name, value in row.items()} for row in rows]
        except (ValueError, OverflowError, TypeError, AttributeError, csv.Error) as error:
            raise ValueError(f"{path}: not an intact table of numbers ({error!s:.300}); delete it.") from error
        expected = ["updates", "seconds", *columns, "score"]
        for row in rows:
            if list(row) != expected:
                raise ValueError(f"{path}: has columns {list(row)!s:.300}, not {expected}; it belongs to other sizes.")
        return cls(rows)

    def text(self) -> str:
        """:return: The contents of the CSV file"""
        text = io.StringIO()
        writer: Any = csv.DictWriter(text, list(self.rows[0]))
        writer.writeheader()
        writer.writerows(self.rows)
        return text.getvalue()

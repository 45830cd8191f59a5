"""One instance of a public benchmark, with what its file says beyond the problem itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from sb3_uav.envs.instances import Instances


@dataclass(frozen=True)
class BenchmarkInstance:
    """
    :param name: Name of the instance, as in the file of best-known values
    :param group: Instances of one group share a line of the table
    :param path: The file
    :param instances: A batch of one
    :param nodes: Number of every task in the file: of its points, from 1; in an ``.npz`` of its tasks, from 0
    :param is_rounded: Whether the file's own rule rounds the length of every edge to the nearest whole number, see
        :mod:`~sb3_uav.evaluation.benchmarks.rounding`; without it lengths are Euclidean
    :param depot_score: Score of the depot in the file, which every tour collects. It is no part of ``instances``, but of
        best-known values
    """

    name: str
    group: str
    path: Path
    instances: Instances
    nodes: tuple[int, ...]
    is_rounded: bool = False
    depot_score: float = 0.0


def finite_number(text: str) -> float:
    """
    :param text: A word of a file
    :return: The number
    :raises ValueError: If it is no finite number, as files write them (no ``1_000``, which Python would read)
    """
    try:
        number = float(text) if "_" not in text else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{text!r:.60} is no finite number")
    return number

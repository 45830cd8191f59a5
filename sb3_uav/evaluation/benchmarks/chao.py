"""Team orienteering files of Chao, Golden and Wasil: ``n``, ``m``, ``tmax``, then one point with its score a line."""

from __future__ import annotations

from pathlib import Path

from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.benchmarks.instance import BenchmarkInstance, finite_number

# Each has an end of its own in memory.
_MOST_VEHICLES = 10_000
_HEADER = ("n", "m", "tmax")
_REMEDY = "get the file again, or take it out of the folder"


def read_chao(path: Path, text: str, group: str) -> BenchmarkInstance:
    """
    Read a file of Chao's sets.

    Of its ``n`` points the first is where all ``m`` vehicles start and the last where they end, both with score 0; ``tmax``
    is the limit of each vehicle. Where start and end coincide, they are the depot, as in the paper's problem.

    :param path: The file, for the name of the instance and for errors
    :param text: Its content
    :param group: Group of the instance
    :return: The instance
    :raises ValueError: If a line is missing, superfluous or wrong; the message names the line and what was found
    """
    lines = text.rstrip().splitlines()
    n_points, n_vehicles, limit = (_header(path, lines, position, key) for position, key in enumerate(_HEADER))
    for key, number, least in (("n", n_points, 3), ("m", n_vehicles, 1)):
        if number != int(number) or number < least:
            raise ValueError(f"{path}: '{key}' is {number:g}, but must be a whole number of at least {least}; {_REMEDY}.")
    if n_vehicles > _MOST_VEHICLES:
        raise ValueError(f"{path}: 'm' is {n_vehicles:g}, but must be at most {_MOST_VEHICLES}; {_REMEDY}.")
    if limit <= 0:
        raise ValueError(f"{path}: 'tmax' is {limit:g}, but must be more than 0; {_REMEDY}.")
    if len(lines) - len(_HEADER) != n_points:
        raise ValueError(f"{path}: says n {n_points:g}, but {len(lines) - len(_HEADER)} lines of points follow; {_REMEDY}.")
    points = [_point(path, line, number) for number, line in enumerate(lines[len(_HEADER) :], start=len(_HEADER) + 1)]
    for place, row, number in (("start", points[0], len(_HEADER) + 1), ("end", points[-1], len(lines))):
        if row[2] != 0:
            raise ValueError(f"{path}, line {number}: the {place} has the score {row[2]:g}, which must be 0; {_REMEDY}.")
    start, end = points[0][:2], points[-1][:2]
    tasks = points[1:-1]
    fleet = int(n_vehicles)
    instances = Instances.from_arrays(
        depot=start,
        tasks=[point[:2] for point in tasks],
        values=[point[2] for point in tasks],
        max_distance=limit,
        n_uavs=fleet,
        end=None if end == start else [end] * fleet,
        source=str(path),
    )
    return BenchmarkInstance(path.stem, group, path, instances, tuple(range(2, len(points))))


def _header(path: Path, lines: list[str], position: int, key: str) -> float:
    """:return: The number of one of the first lines"""
    words = lines[position].split() if position < len(lines) else []
    try:
        found, number = words
        if found != key:
            raise ValueError
        return finite_number(number)
    except ValueError:
        line = " ".join(words) if words else "nothing"
        raise ValueError(f"{path}, line {position + 1}: expected '{key} NUMBER', found {line!r:.60}; {_REMEDY}.") from None


def _point(path: Path, line: str, number: int) -> tuple[float, float, float]:
    """:return: x, y and score of one line"""
    words = line.split()
    try:
        x, y, score = (finite_number(word) for word in words)
    except ValueError as error:
        why = str(error) if len(words) == 3 else f"found {' '.join(words)!r:.60}"
        raise ValueError(f"{path}, line {number}: expected x, y and score, three numbers, but {why}; {_REMEDY}.") from None
    if score < 0:
        raise ValueError(f"{path}, line {number}: the score is {score:g}, but must be at least 0; {_REMEDY}.")
    return x, y, score

"""OPLib files (orienteering problems in the format of TSPLIB), read by vrplib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.common.optional import require
from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.benchmarks.instance import BenchmarkInstance, finite_number

_METRIC = "EUC_2D"
_REMEDY = "get the file again, or take it out of the folder"
# Section, and how many numbers follow the number of the node.
_SECTIONS = {"NODE_COORD_SECTION": 2, "NODE_SCORE_SECTION": 1}


class UnsupportedMetricError(ValueError):
    """
    Distances that are not those between points in the plane.

    :param path: The file
    :param metric: What its ``EDGE_WEIGHT_TYPE`` says
    """

    def __init__(self, path: Path, metric: str) -> None:
        super().__init__(
            f"{path}: EDGE_WEIGHT_TYPE is {metric:.60}; only {_METRIC} can be solved; take the file out of the folder."
        )
        self.path = path
        self.metric = metric


def read_oplib(path: Path, text: str, group: str) -> BenchmarkInstance:
    """
    Read an OPLib file: one vehicle, which returns to the node of ``DEPOT_SECTION`` within ``COST_LIMIT``. In most files the
    depot has a score too, which best-known values include.

    Its rule rounds the length of each edge; the instance itself has Euclidean lengths, see
    :mod:`~sb3_uav.evaluation.benchmarks.rounding`.

    :param path: The file, for the name of the instance and for errors
    :param text: Its content
    :param group: Group of the instance
    :return: The instance
    :raises UnsupportedMetricError: If its ``EDGE_WEIGHT_TYPE`` is not EUC_2D
    :raises ValueError: If it is damaged, or no orienteering problem; the message names the field and what was found
    :raises ImportError: If vrplib is not installed
    """
    vrplib = require("vrplib.parse", "Reading OPLib files", "bench")
    try:
        fields: dict[str, Any] = vrplib.parse_vrplib(text, compute_edge_weights=False)
    except Exception as error:
        # Given damaged text, it raises almost anything, and tries to build the matrix of an EXPLICIT file.
        metric = _specification(text, "EDGE_WEIGHT_TYPE")
        if metric not in ("", _METRIC):
            raise UnsupportedMetricError(path, metric) from error
        raise ValueError(
            f"{path}: is no intact OPLib file ({str(error)[:300] or type(error).__name__}); {_REMEDY}."
        ) from error
    if str(fields.get("type")).upper() != "OP":
        raise ValueError(f"{path}: TYPE is {fields.get('type', 'missing')!s:.60}; only OP can be solved; {_REMEDY}.")
    if fields.get("edge_weight_type") != _METRIC:
        raise UnsupportedMetricError(path, str(fields.get("edge_weight_type", "missing")))
    limit = _number(path, fields, "cost_limit")
    n_nodes = _number(path, fields, "dimension")
    if n_nodes != int(n_nodes) or n_nodes < 2:
        raise ValueError(f"{path}: DIMENSION is {n_nodes:g}, but must be a whole number of at least 2; {_REMEDY}.")
    _check_sections(path, text, int(n_nodes))
    depot = _depot(path, fields.get("depot"), int(n_nodes))
    points = np.asarray(fields["node_coord"], dtype=np.float64)
    scores = np.asarray(fields["node_score"], dtype=np.float64)
    tasks = np.delete(np.arange(int(n_nodes)), depot)
    instances = Instances.from_arrays(
        depot=points[depot],
        tasks=points[tasks],
        values=scores[tasks],
        max_distance=limit,
        n_uavs=1,
        source=str(path),
    )
    nodes = tuple((tasks + 1).tolist())
    return BenchmarkInstance(path.stem, group, path, instances, nodes, is_rounded=True, depot_score=float(scores[depot]))


def _specification(text: str, key: str) -> str:
    """:return: What stands after ``KEY :``, or nothing"""
    for line in text.splitlines():
        name, _, value = line.partition(":")
        if name.strip() == key:
            return value.strip()
    return ""


def _number(path: Path, fields: dict[str, Any], key: str) -> float:
    """:return: The number of a specification"""
    try:
        return finite_number(str(fields[key]))
    except (KeyError, ValueError):
        found = repr(fields[key]) if key in fields else "missing"
        raise ValueError(f"{path}: {key.upper()} is {found:.60}, but must be a number; {_REMEDY}.") from None


def _check_sections(path: Path, text: str, n_nodes: int) -> None:
    """
    Check the sections line by line: vrplib neither reads the numbers of nodes nor compares the sections with ``DIMENSION``.

    :param path: The file
    :param text: Its content
    :param n_nodes: Its ``DIMENSION``
    :raises ValueError: If a section is missing, or a line of it is wrong
    """
    found: dict[str, int] = {}
    section = ""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        # As vrplib, which reads nothing after it.
        if "EOF" in line:
            break
        if "_SECTION" in line:
            section = line.strip(" :\t")
            found[section] = found.get(section, 0)
        elif section in _SECTIONS:
            found[section] += 1
            _check_line(path, number, section, words, found[section])
    for section in _SECTIONS:
        if found.get(section) != n_nodes:
            raise ValueError(f"{path}: DIMENSION is {n_nodes}, but {section} has {found.get(section, 0)} lines; {_REMEDY}.")


def _check_line(path: Path, number: int, section: str, words: list[str], node: int) -> None:
    """
    :param path: The file
    :param number: Number of the line
    :param section: Its section
    :param words: Its words
    :param node: Number that the node must have
    :raises ValueError: If a word is wrong
    """
    where = f"{path}, line {number}: {section}"
    try:
        numbers = [finite_number(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{where}: {error}; {_REMEDY}.") from None
    if len(numbers) != 1 + _SECTIONS[section] or numbers[0] != node:
        shape = "x and y" if _SECTIONS[section] == 2 else "the score"
        raise ValueError(f"{where}: expected {node}, then {shape}, found {' '.join(words)!r:.60}; {_REMEDY}.")
    if section == "NODE_SCORE_SECTION" and numbers[1] < 0:
        raise ValueError(f"{where}: the score is {numbers[1]:g}, but must be at least 0; {_REMEDY}.")


def _depot(path: Path, found: Any, n_nodes: int) -> int:
    """:return: Index of the depot"""
    depots = [] if found is None else np.asarray(found).ravel().tolist()
    if len(depots) != 1 or not isinstance(depots[0], int) or not 0 <= depots[0] < n_nodes:
        listed = ", ".join(f"{depot + 1}" for depot in depots if isinstance(depot, int)) or "no node"
        raise ValueError(f"{path}: DEPOT_SECTION names {listed}, but must name one of nodes 1 to {n_nodes}; {_REMEDY}.")
    return depots[0]

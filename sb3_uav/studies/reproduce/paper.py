"""What the paper itself reports: its Tables I to IV, as data."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from sb3_uav.registration import GENERALIZATION_SIZES, PAPER_FLEETS, PAPER_SIZES

FLEETS = PAPER_FLEETS
# Of Tables I to III and all figures.
SIZES = PAPER_SIZES
# Of Table IV, which ends at 1000 tasks in the paper.
LARGER_SIZES = GENERALIZATION_SIZES
# Of an epoch.
INSTANCES_PER_EPOCH = 1_280_000
MAX_DISTANCE = 2.0
# "all the instances are randomly generated with seed 1234" (section V-B, of Fig. 3)
FIG3_SEED = 1234
# The ablation of Fig. 5.
ABLATION_FLEET, ABLATION_SIZE = 4, 80
ABLATION_STRATEGIES = ("ITS", "ITS/pre-training", "ITS/intensive", "ITS/pre-training&intensive")

EXACT_BLOCK, FULL_BLOCK = "30 instances", "500 instances"
GUROBI = "Gurobi (1800s)"
OR_TOOLS, KMEANS_VND, KMEANS_AM = "OR-tools", "K-means+VND", "K-means+AM"
GREEDY, SAMPLING = "DL-DRL (Greedy)", "DL-DRL (Sampling)"
INDEPENDENT_GREEDY, INDEPENDENT_SAMPLING = "DL-DRL-I (Greedy)", "DL-DRL-I (Sampling)"
EXACT_COLUMNS = (GUROBI, GREEDY, SAMPLING)
FULL_COLUMNS = (OR_TOOLS, KMEANS_VND, KMEANS_AM, INDEPENDENT_GREEDY, INDEPENDENT_SAMPLING, GREEDY, SAMPLING)
LARGER_METHODS = (OR_TOOLS, KMEANS_AM, "DL-DRL-I", "DL-DRL")
PHASES = ("Upper-level", "Lower-level", "Data generation")
# The rows of Tables II and III, and what the data calls them.
MEASURES = {"Obj.": "objective", "Gap": "gap", "Time(s)": "seconds"}


@cache
def paper_tables() -> dict[str, Any]:
    """
    :return: ``paper_tables.json``: ``source``, and ``table1`` to ``table4``, each with ``source``, ``caption``, ``rows``, and
        the ``faults`` that are known of the printed table. The rows are nested: ``table1`` by situation and phase (minutes);
        ``table2`` and ``table3`` by number of tasks, block and method (``objective``, ``gap`` in percent, ``seconds``);
        ``table4`` by fleet, number of tasks and method (``objective``, ``seconds``)
    """
    return json.loads(files(__package__).joinpath("paper_tables.json").read_text(encoding="utf-8"))


def paper_figure(table: str, *path: str) -> float | None:
    """
    :param table: ``"table1"`` to ``"table4"``
    :param path: Where the figure stands in the ``rows`` of the table
    :return: The figure that the paper prints, None if it prints none
    """
    found: Any = paper_tables()[table]["rows"]
    for key in path:
        if key not in found:
            return None
        found = found[key]
    return found

"""The figures of the paper's Tables I to IV."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from sb3_uav.registration import GENERALIZATION_SIZES, PAPER_FLEETS, PAPER_SIZES
from sb3_uav.training.its_schedule import ALTERNATE_ONLY, ITS, NO_INTENSIVE, NO_PRETRAINING, PAPER_STRATEGIES

FLEETS = PAPER_FLEETS
# Numbers of tasks in Tables I to III and in all figures.
SIZES = PAPER_SIZES
# Numbers of tasks in Table IV, which ends at 1000 in the paper.
LARGER_SIZES = GENERALIZATION_SIZES
# Training instances of an epoch.
INSTANCES_PER_EPOCH = 1_280_000
MAX_DISTANCE = 2.0
# "all the instances are randomly generated with seed 1234" (section V-B, of Fig. 3)
FIG3_SEED = 1234
# The ablation of Fig. 5.
ABLATION_FLEET, ABLATION_SIZE = 4, 80
ABLATION_STRATEGIES = (ITS, NO_PRETRAINING, NO_INTENSIVE, ALTERNATE_ONLY)
# Names of the training strategies in tables and figures.
STRATEGY_TITLES = {name: title for title, name in PAPER_STRATEGIES.items()}

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
    :param path: Keys of the figure in the ``rows`` of the table
    :return: The figure that the paper prints; None if it prints none
    """
    found: Any = paper_tables()[table]["rows"]
    for key in path:
        if key not in found:
            return None
        found = found[key]
    return found

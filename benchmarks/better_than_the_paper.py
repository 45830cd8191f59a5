"""
Our results beside the paper's, for each cell of its Tables II to IV.

Reads folders of ``sb3-uav evaluate`` in which ``ortools`` and other solvers solved the same instances, and prints a Markdown
table: for every scenario the mean objective of ``ortools``, the ratio of DL-DRL (Sampling) to OR-Tools in the paper, and the
ratio of each solver's mean to that of ``ortools`` on the instances that both solved. The paper's instances are not public;
only ratios on instances of the same distribution are comparable.

    python benchmarks/better_than_the_paper.py RESULTS [RESULTS ...] --solvers "dl-drl:decode=sampling" "pyvrp:time_limit=1"
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_uav.common.statistics import confidence_halfwidth
from sb3_uav.reproduce.paper import FULL_BLOCK, OR_TOOLS, SAMPLING, SIZES, paper_figure

REFERENCE = "ortools"

# Scenario -> solver -> instance -> objective.
Objectives = Mapping[tuple[int, int], Mapping[str, Mapping[tuple[str, int], float]]]


def read(folders: Sequence[Path]) -> Objectives:
    """
    :param folders: Folders of ``sb3-uav evaluate``
    :return: Objectives by scenario, solver, and file and index of the instance
    :raises ValueError: If a solver failed, or solved an instance twice
    """
    found: dict[tuple[int, int], dict[str, dict[tuple[str, int], float]]] = defaultdict(lambda: defaultdict(dict))
    for folder in folders:
        with (folder / "results.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        # Instances are numbered across all files, one per scenario.
        first = {row["source"]: min(int(r["instance"]) for r in rows if r["source"] == row["source"]) for row in rows}
        for row in rows:
            if row["status"] != "ok" or row["feasible"] != "True":
                raise ValueError(f"{folder}: {row['solver']} failed on instance {row['instance']}: {row['message']}")
            limit = f", {float(row['time_limit']):g} s" if row["time_limit"] else ""
            place = (row["source"], int(row["instance"]) - first[row["source"]])
            of_solver = found[int(row["n_uavs"]), int(row["n_tasks"])][row["solver"] + limit]
            if place in of_solver:
                raise ValueError(f"{folder}: {row['solver']} solved instance {place[1]} of {place[0]} twice; keep one result.")
            of_solver[place] = float(row["objective"])
    return found


def paper_ratio(n_uavs: int, n_tasks: int) -> float | None:
    """:return: DL-DRL (Sampling) / OR-Tools in the paper, None where it prints no such cell"""
    if n_tasks in SIZES:
        path = ("table2" if n_uavs == 4 else "table3", str(n_tasks), FULL_BLOCK)
        ours, reference = (paper_figure(*path, method, "objective") for method in (SAMPLING, OR_TOOLS))
    else:
        path = ("table4", f"U{n_uavs}", str(n_tasks))
        ours, reference = (paper_figure(*path, method, "objective") for method in ("DL-DRL", OR_TOOLS))
    return None if ours is None or reference is None else ours / reference


def ratio(ours: Mapping[tuple[str, int], float], reference: Mapping[tuple[str, int], float]) -> tuple[float, float, int]:
    """
    :param ours: Objectives by instance
    :param reference: Objectives of the reference by instance
    :return: Ratio of the means on the instances that both solved; half the width of its paired confidence interval, which is
        that of the mean difference in units of the reference's mean; and how many instances these are
    """
    places = sorted(ours.keys() & reference.keys())
    if not places:
        return np.nan, np.nan, 0
    difference = np.array([ours[place] - reference[place] for place in places])
    mean = float(np.mean([reference[place] for place in places]))
    return 1.0 + float(difference.mean()) / mean, float(confidence_halfwidth(difference)) / mean, len(places)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="folders of sb3-uav evaluate")
    parser.add_argument("--solvers", nargs="+", help="solvers to show, in this order (default: all)")
    parser.add_argument("--reference", default=REFERENCE, help="default: %(default)s")
    args = parser.parse_args()
    found = read(args.results)
    names = args.solvers or list(dict.fromkeys(name for solvers in found.values() for name in solvers))
    names = [name for name in names if name != args.reference]
    print(f"| scenario | n | {args.reference} | paper | " + " | ".join(names) + " |")
    print("| :-- | --: | --: | --: | " + " | ".join(["--:"] * len(names)) + " |")
    for (n_uavs, n_tasks), solvers in sorted(found.items()):
        if args.reference not in solvers:
            parser.error(f"--reference {args.reference} did not solve U{n_uavs}-{n_tasks}; choose one of {sorted(solvers)}.")
        reference = solvers[args.reference]
        printed = paper_ratio(n_uavs, n_tasks)
        cells = []
        for name in names:
            value, width, n = ratio(solvers.get(name, {}), reference)
            few = f" (n = {n})" if n < len(reference) else ""
            cells.append("-" if n == 0 else f"{value:.3f} ± {width:.3f}{few}")
        mean = np.mean(list(reference.values()))
        paper = "-" if printed is None else f"{printed:.3f}"
        print(f"| U{n_uavs}-{n_tasks} | {len(reference)} | {mean:.1f} | {paper} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()

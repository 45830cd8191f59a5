"""The cheapest assignment of as many things to as many others."""

from __future__ import annotations

import numpy as np


def cheapest_assignment(costs: np.ndarray) -> np.ndarray:
    """
    The Hungarian method: rows are assigned one by one, each along the cheapest alternating path to a free column.

    :param costs: ``(n, n)`` float64, finite
    :return: ``(n,)`` int64, the column of each row; each column once, and the sum of the costs is the least
    """
    n = len(costs)
    of_row, of_column = np.zeros(n), np.zeros(n)
    row_of = np.full(n, -1)
    for first in range(n):
        reached = np.zeros(n, dtype=bool)
        shortest = np.full(n, np.inf)
        before = np.full(n, -1)
        row, column = first, -1
        # Dijkstra's algorithm over reduced costs, which are never negative, until it reaches a free column.
        length = 0.0
        while True:
            path = length + (costs[row] - of_row[row] - of_column)
            better = ~reached & (path < shortest)
            shortest[better], before[better] = path[better], column
            column = int(np.where(reached, np.inf, shortest).argmin())
            length = float(shortest[column])
            if row_of[column] < 0:
                break
            reached[column] = True
            row = int(row_of[column])
        gained = length - shortest[reached]
        of_row[first] += length
        of_row[row_of[reached]] += gained
        of_column[reached] -= gained
        while column >= 0:
            row_of[column] = first if before[column] < 0 else row_of[before[column]]
            column = int(before[column])
    return row_of.argsort()

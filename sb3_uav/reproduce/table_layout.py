"""Which cells of our tables are bold, and where their parts begin; both follow from the cells alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

from sb3_uav.reproduce.table_formats import MISSING, Table


def _best(cells: Sequence[str], smallest: bool = False) -> list[int]:
    """
    :param cells: Numbers as the table shows them
    :param smallest: Whether the smallest is the best
    :return: Indices of the best, several if the table shows them alike; none if there are fewer than two numbers to compare
    """
    known = {index: float(cell) for index, cell in enumerate(cells) if cell != MISSING}
    if len(known) < 2:
        return []
    target = (min if smallest else max)(known.values())
    return [index for index, value in known.items() if value == target]


def lay_out(table: Table) -> None:
    """
    Mark the best cells, and the rows that begin a new part.

    :param table: A complete table, which is changed; others than Tables I to IV and Figs. 6 and 7 stay as they are
    """
    if table.label == "Table I":
        table.rules = _changes(row[0].partition("-")[0] for row in table.rows)
    elif table.label in ("Table II", "Table III"):
        table.rules = _changes(row[0] for row in table.rows)
        table.bold = _best_of_blocks(table)
    elif table.label == "Table IV":
        table.rules = _changes(row[0] for row in table.rows)
        table.bold = _best_methods(table)
    elif table.label in ("Fig. 6", "Fig. 7"):
        for column in range(1, len(table.columns)):
            table.bold |= {(row, column) for row in _best([cells[column] for cells in table.rows])}


def _changes(keys: Iterable[str]) -> list[int]:
    """
    :param keys: One for each row
    :return: Indices of the rows whose key is not that of the row before
    """
    rules, position = [], 0
    for _, group in groupby(keys):
        rules.append(position)
        position += len(list(group))
    return rules


def _best_of_blocks(table: Table) -> set[tuple[int, int]]:
    """Tables II and III: the best method of each row and block; times are not compared."""
    blocks: dict[str, list[int]] = {}
    for index, column in enumerate(table.columns):
        if column.group:
            blocks.setdefault(column.group, []).append(index)
    bold: set[tuple[int, int]] = set()
    for position, row in enumerate(table.rows):
        measure = row[1]
        for columns in blocks.values() if measure in ("Obj.", "Gap") else ():
            found = _best([row[column] for column in columns], smallest=measure == "Gap")
            bold.update((position, columns[index]) for index in found)
    return bold


def _best_methods(table: Table) -> set[tuple[int, int]]:
    """Table IV: the best method of each fleet and source in each column."""
    parts: dict[tuple[str, str], list[int]] = {}
    for position, row in enumerate(table.rows):
        parts.setdefault((row[0], row[2]), []).append(position)
    bold: set[tuple[int, int]] = set()
    for index, column in enumerate(table.columns):
        for positions in parts.values() if column.group else ():
            found = _best([table.rows[position][index] for position in positions], smallest=column.title == "Time(s)")
            bold.update((positions[found_index], index) for found_index in found)
    return bold

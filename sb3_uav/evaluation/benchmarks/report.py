"""How near solvers come to best-known values: the lines of the table, and ``summary.md``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sb3_uav.evaluation.benchmarks.gaps import GapRow
from sb3_uav.evaluation.results import FAILED, INFEASIBLE
from sb3_uav.evaluation.table import require_rich

ALL = "all"
# After the mean gap of some of the results only.
PARTIAL = "*"
ABOUT_PARTIAL = f"{PARTIAL} mean over those that are solved and have a best-known value, not over all"


@dataclass(frozen=True)
class ReportRow:
    """
    One solver on one group of instances, with one time limit.

    :param group: The group, or :data:`ALL`
    :param solver: Name of the solver
    :param time_limit: Seconds that it was given
    :param n_results: Number of results; instances times seeds
    :param n_known: How many of them have a best-known value
    :param n_compared: How many of these have an objective
    :param gap: Mean gap of these in percent; NaN if there are none
    :param n_reached: How many reach the best-known value
    :param n_better: How many exceed it
    :param n_infeasible: How many schedules were refused
    :param n_failed: How often the solver refused the instance or failed
    :param seconds: Mean wall time; NaN if there is none
    """

    group: str
    solver: str
    time_limit: float | None
    n_results: int
    n_known: int
    n_compared: int
    gap: float
    n_reached: int
    n_better: int
    n_infeasible: int
    n_failed: int
    seconds: float


def report(rows: Sequence[GapRow]) -> list[ReportRow]:
    """
    :param rows: Gaps
    :return: One row for every group, solver and time limit, and those of all groups together at the end if there are several
    """
    groups = list(dict.fromkeys(row.group for row in rows))
    parts = [(group, [row for row in rows if row.group == group]) for group in groups]
    if len(groups) > 1:
        parts.append((ALL, list(rows)))
    summary = []
    for group, members in parts:
        runs: dict[tuple[str, float | None], list[GapRow]] = {}
        for row in members:
            runs.setdefault((row.solver, row.time_limit), []).append(row)
        summary += [_report_row(group, run) for run in runs.values()]
    return summary


def _report_row(group: str, run: Sequence[GapRow]) -> ReportRow:
    gaps = [row.gap for row in run if row.gap is not None]
    return ReportRow(
        group=group,
        solver=run[0].solver,
        time_limit=run[0].time_limit,
        n_results=len(run),
        n_known=sum(row.best_known is not None for row in run),
        n_compared=len(gaps),
        gap=_mean(gaps),
        n_reached=sum(row.reached for row in run),
        n_better=sum(row.better for row in run),
        n_infeasible=sum(row.status == INFEASIBLE for row in run),
        n_failed=sum(row.status == FAILED for row in run),
        seconds=_mean([row.seconds for row in run if row.seconds is not None]),
    )


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


def table_cells(summary: Sequence[ReportRow]) -> tuple[list[str], list[list[str]]]:
    """
    :param summary: What :func:`report` returned
    :return: Headings of the columns, and the cells of every row; columns without content are left out
    """
    columns: list[tuple[str, list[str]]] = []
    if len({row.group for row in summary}) > 1:
        columns.append(("Group", [row.group for row in summary]))
    columns.append(("Solver", [row.solver for row in summary]))
    if any(row.time_limit is not None for row in summary):
        columns.append(("Limit\ns", ["-" if row.time_limit is None else f"{row.time_limit:g}" for row in summary]))
    columns.append(("Gap\n%", [_gap(row) for row in summary]))
    columns.append(("Reached", [f"{row.n_reached}/{row.n_known}" for row in summary]))
    columns.append(("Better", [f"{row.n_better}" for row in summary]))
    if any(row.n_infeasible for row in summary):
        columns.append(("Infeas-\nible", [f"{row.n_infeasible}" for row in summary]))
    if any(row.n_failed for row in summary):
        columns.append(("Failed", [f"{row.n_failed}" for row in summary]))
    columns.append(("s\neach", ["-" if math.isnan(row.seconds) else f"{row.seconds:.3f}" for row in summary]))
    return [heading for heading, _ in columns], [list(cells) for cells in zip(*(c for _, c in columns), strict=True)]


def _gap(row: ReportRow) -> str:
    """The mean gap, marked if it is not that of all results."""
    if math.isnan(row.gap):
        return "-"
    return f"{row.gap:.2f}" + (PARTIAL if row.n_compared < row.n_results else "")


def print_report(summary: Sequence[ReportRow], title: str) -> None:
    """
    Print the table on the standard output.

    :param summary: What :func:`report` returned
    :param title: Title of the table
    :raises ImportError: If rich is not installed
    """
    rich = require_rich()
    console = rich.console.Console()
    headings, rows = table_cells(summary)
    # Narrow, so that most tables fit into 80 columns.
    # Text, because rich would take brackets in a name for markup.
    table: Any = rich.table.Table(title=rich.text.Text(title), box=rich.box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    n_names = headings.index("Solver") + 1
    for position, heading in enumerate(headings):
        if position < n_names:
            table.add_column(heading, overflow="fold", min_width=min(10, *(len(cells[position]) for cells in rows)))
        else:
            table.add_column(heading, justify="right", no_wrap=True)
    for position, (row, cells) in enumerate(zip(summary, rows, strict=True)):
        if position > 0 and summary[position - 1].group != row.group:
            table.add_section()
        elif position > 0 and n_names > 1:
            # Once is enough.
            cells = ["", *cells[1:]]
        table.add_row(*(rich.text.Text(cell) for cell in cells))
    if any(PARTIAL in cells[headings.index("Gap\n%")] for cells in rows):
        table.caption = rich.text.Text(ABOUT_PARTIAL)
    if not console.is_terminal:
        # Without a terminal, rich assumes 80 columns and breaks the names of solvers.
        console.width = max(console.measure(table, options=console.options.update(width=10_000)).maximum, 80)
    console.print(table)


def markdown_table(summary: Sequence[ReportRow]) -> list[str]:
    """
    :param summary: What :func:`report` returned
    :return: Lines of the same table
    """
    headings, rows = table_cells(summary)
    headings = [heading.replace("-\n", "").replace("\n", " ") for heading in headings]
    n_names = headings.index("Solver") + 1
    rule = ["---" if position < n_names else "---:" for position in range(len(headings))]
    cells = [headings, rule, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return [f"| {' | '.join(row)} |" for row in cells]

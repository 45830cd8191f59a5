"""Printing a comparison as tables, one for every set of instances and every time limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from sb3_uav.common.optional import install_command
from sb3_uav.evaluation.summary import SummaryRow


def require_rich() -> Any:
    """
    :return: The module ``rich`` with its tables
    :raises ImportError: With the command that installs it
    """
    try:
        import rich.box
        import rich.console
        import rich.table
        import rich.text
    except ImportError as error:
        raise ImportError(f"Printing tables needs rich; run: {install_command('solvers')}") from error
    return rich


def print_table(summary: Sequence[SummaryRow]) -> None:
    """
    Print a summary as tables on the standard output.

    :param summary: What :func:`~sb3_uav.evaluation.run.evaluate` returned
    :raises ImportError: If rich is not installed
    """
    rich = require_rich()
    console = rich.console.Console()
    for _, group in groupby(summary, key=lambda row: (row.source, row.time_limit)):
        table = _table(rich, list(group))
        if not console.is_terminal:
            # Without a terminal, rich assumes 80 columns and breaks the names of solvers.
            console.width = max(console.measure(table, options=console.options.update(width=10_000)).maximum, 80)
        console.print(table)


def _table(rich: Any, rows: Sequence[SummaryRow]) -> Any:
    """
    :param rich: The module
    :param rows: Rows of one set of instances and one time limit
    :return: Their table
    """
    first = rows[0]
    limit = "" if first.time_limit is None else f", {first.time_limit:g} s each"
    # Text, because rich would take brackets in a name for markup.
    title = rich.text.Text(f"{first.source}: {first.n_instances} instances{limit}")
    # Without lines between the columns, so that most tables fit into 80 columns.
    table = rich.table.Table(title=title, box=rich.box.SIMPLE_HEAD)
    table.add_column("Solver", overflow="fold", min_width=10)
    columns = [
        ("Obj.", [_figure(row.objective, 2) for row in rows]),
        ("Std.\nerror", [_figure(row.standard_error, 2) for row in rows]),
        ("Gap\n%", [_figure(row.gap, 2) for row in rows]),
    ]
    if len(rows) > 1:
        columns.append(("Difference", [_difference(row) for row in rows]))
    if any(row.n_bounds > 0 for row in rows):
        columns.append(("Bound", [_figure(row.bound, 2) for row in rows]))
        columns.append(("Opt.\ngap %", [_figure(row.optimality_gap, 2) for row in rows]))
    columns.append(("s per\ninstance", [_figure(row.seconds, 4) for row in rows]))
    if any(row.batch_size > 1 for row in rows):
        columns.append(("Batch", [str(row.batch_size or "-") for row in rows]))
    if any(row.n_feasible < row.n_instances for row in rows):
        columns.append(("Feasible", [f"{row.n_feasible}/{row.n_instances}" for row in rows]))
    if any(row.n_unserved > 0 for row in rows):
        columns.append(("Un-\nserved", [str(row.n_unserved) for row in rows]))
    for heading, _ in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    for position, row in enumerate(rows):
        table.add_row(rich.text.Text(row.solver), *(cells[position] for _, cells in columns))
    if len(rows) > 1:
        table.caption = rich.text.Text(f"Difference: to {first.reference} on the same instances, with 95 % confidence")
    return table


def _figure(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _difference(row: SummaryRow) -> str:
    """The mean difference to the reference, half of its confidence interval, and how many instances if not all."""
    if row.solver == row.reference:
        return "reference"
    if math.isnan(row.difference):
        return "-"
    halfwidth = row.difference_high - row.difference
    interval = "" if math.isnan(halfwidth) else f" ± {halfwidth:.2f}"
    return f"{row.difference:+.2f}{interval}" + ("" if row.n_paired == row.n_instances else f" (n={row.n_paired})")

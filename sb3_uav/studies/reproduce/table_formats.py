"""A table that can be written as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from sb3_uav.common.files import replaced_when_complete

MISSING = "-"
SUFFIXES = (".md", ".tex", ".csv")
LATEX_SPECIAL = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


@dataclass(frozen=True)
class Column:
    """
    :param title: Title of the column
    :param group: What stands above it and its neighbours of the same group
    """

    title: str
    group: str = ""

    @property
    def flat(self) -> str:
        """Both in one line."""
        return f"{self.group}: {self.title}" if self.group else self.title


@dataclass
class Table:
    """
    :param caption: What the table shows
    :param columns: Its columns
    :param rows: Its cells, as text
    :param rules: Indices of rows that begin a new part
    :param bold: Row and column of cells that stand out
    :param notes: What has to be known to read it
    """

    caption: str
    columns: Sequence[Column]
    rows: list[list[str]] = field(default_factory=list)
    rules: list[int] = field(default_factory=list)
    bold: set[tuple[int, int]] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)

    def start_part(self) -> None:
        """What is added from now on is a new part."""
        self.rules.append(len(self.rows))

    def add(self, cells: Sequence[str], bold: Iterable[int] = ()) -> None:
        """
        :param cells: One for each column
        :param bold: Indices of those that stand out
        """
        if len(cells) != len(self.columns):
            raise ValueError(f"A row has {len(cells)} cells, the table {len(self.columns)} columns: {cells}.")
        self.bold.update((len(self.rows), column) for column in bold)
        self.rows.append(list(cells))


def number(value: float | None, digits: int = 2) -> str:
    """
    :param value: A number; None or NaN if there is none
    :param digits: Digits after the point
    :return: Text for a cell
    """
    return MISSING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def best(values: Sequence[float | None], smallest: bool = False, show: Callable[[float | None], str] = number) -> list[int]:
    """
    :param values: Numbers; None or NaN where there is none
    :param smallest: Whether the smallest is the best
    :param show: How the table shows them
    :return: Indices of the best, several if the table shows them alike
    """
    known = [value for value in values if value is not None and not math.isnan(value)]
    if not known:
        return []
    target = show(min(known) if smallest else max(known))
    return [index for index, value in enumerate(values) if show(value) == target]


def to_markdown(table: Table, about: Sequence[str]) -> str:
    """
    :param table: The table
    :param about: Where it comes from, line by line
    :return: Markdown with the table, its notes and where it comes from
    """

    def line(cells: Iterable[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    text = [f"# {table.caption}", "", line(column.flat for column in table.columns)]
    text.append(line("---:" if numeric else "---" for numeric in _numeric(table)))
    for position, row in enumerate(table.rows):
        text.append(line(f"**{c}**" if (position, k) in table.bold and c else c for k, c in enumerate(row)))
    for heading, items in (("Notes", table.notes), ("How this was made", about)):
        if items:
            text += ["", f"## {heading}", "", *(f"- {item}" for item in items)]
    return "\n".join(text) + "\n"


def _numeric(table: Table) -> list[bool]:
    """Which columns hold nothing but numbers."""
    return [not any(map(str.isalpha, "".join(row[column] for row in table.rows))) for column in range(len(table.columns))]


def to_latex(table: Table, about: Sequence[str]) -> str:
    """
    :param table: The table
    :param about: Where it comes from, as comments
    :return: A LaTeX table; it needs the packages booktabs and graphicx
    """

    def cell(position: int, column: int, text: str) -> str:
        escaped = text.translate(LATEX_SPECIAL)
        return rf"\textbf{{{escaped}}}" if (position, column) in table.bold and text else escaped

    text = [f"% {item}" for item in about]
    text += ["% Needs \\usepackage{booktabs,graphicx}", "\\begin{table*}[htbp]", "\\centering"]
    text += [rf"\caption{{{table.caption.translate(LATEX_SPECIAL)}}}", "\\resizebox{\\textwidth}{!}{%"]
    text += [rf"\begin{{tabular}}{{{''.join('r' if numeric else 'l' for numeric in _numeric(table))}}}", "\\toprule"]
    if any(column.group for column in table.columns):
        cells, rules, first = [], [], 1
        for group, columns in groupby(table.columns, key=lambda column: column.group):
            width = len(list(columns))
            cells.append(rf"\multicolumn{{{width}}}{{c}}{{{group.translate(LATEX_SPECIAL)}}}")
            rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}" if group else "")
            first += width
        text += [" & ".join(cells) + r" \\", "".join(rules)]
    text += [" & ".join(column.title.translate(LATEX_SPECIAL) for column in table.columns) + r" \\", "\\midrule"]
    for position, row in enumerate(table.rows):
        if position > 0 and position in table.rules:
            text.append("\\midrule")
        text.append(" & ".join(cell(position, column, content) for column, content in enumerate(row)) + r" \\")
    text += ["\\bottomrule", "\\end{tabular}}"]
    text += [rf"\par\footnotesize {note.translate(LATEX_SPECIAL)}" for note in table.notes]
    return "\n".join([*text, "\\end{table*}"]) + "\n"


def to_csv(table: Table, about: Sequence[str]) -> str:
    """
    :param table: The table
    :param about: Where it comes from, as lines that begin with ``#``, like the notes
    :return: CSV, for example for ``pandas.read_csv(path, comment="#")``; cells without a figure are empty
    """
    text = io.StringIO()
    text.writelines(f"# {item}\n" for item in (table.caption, *about, *table.notes))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(column.flat for column in table.columns)
    writer.writerows(["" if cell == MISSING else cell for cell in row] for row in table.rows)
    return text.getvalue()


def write_table(table: Table, about: Sequence[str], stem: Path) -> list[Path]:
    """
    :param table: The table
    :param about: Where it comes from, line by line
    :param stem: Path of the files without their suffix
    :return: The three files
    :raises ValueError: If they cannot be written
    """
    paths = []
    for suffix, render in zip(SUFFIXES, (to_markdown, to_latex, to_csv), strict=True):
        path = stem.with_name(stem.name + suffix)
        with replaced_when_complete(path) as file:
            file.write(render(table, about))
        paths.append(path)
    return paths

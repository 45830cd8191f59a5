"""A table that can be written as Markdown, LaTeX and CSV, and read again from the CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby, takewhile
from pathlib import Path

MISSING = "-"
_LATEX_SPECIAL = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


@dataclass(frozen=True)
class Column:
    """
    :param title: Title of the column
    :param group: Heading above neighboring columns of the same group
    """

    title: str
    group: str = ""

    @property
    def flat(self) -> str:
        """Group and title in one line."""
        return f"{self.group}: {self.title}" if self.group else self.title


@dataclass
class Table:
    """
    :param label: Name and number in the paper, e.g., ``Table II``
    :param caption: Caption without the label
    :param columns: Its columns
    :param rows: Its cells, as text
    :param rules: Indices of rows that begin a new part
    :param bold: Row and column of bold cells
    :param notes: Notes for the reader
    """

    label: str
    caption: str
    columns: Sequence[Column]
    rows: list[list[str]] = field(default_factory=list)
    rules: list[int] = field(default_factory=list)
    bold: set[tuple[int, int]] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)

    @property
    def heading(self) -> str:
        """Label and caption in one line."""
        return f"{self.label}: {self.caption}"

    def add(self, cells: Sequence[str]) -> None:
        """
        :param cells: One for each column
        """
        if len(cells) != len(self.columns):
            raise ValueError(f"A row has {len(cells)} cells, the table {len(self.columns)} columns: {cells}.")
        self.rows.append(list(cells))


def number(value: float | None, digits: int = 2) -> str:
    """
    :param value: A number; None or NaN if there is none
    :param digits: Digits after the point
    :return: Text for a cell
    """
    return MISSING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def to_markdown(table: Table, about: Sequence[str]) -> str:
    """
    :param table: The table
    :param about: Lines on its origin
    :return: Markdown with the table, its notes and its origin
    """

    def line(cells: Iterable[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    text = [f"# {table.heading}", "", line(column.flat for column in table.columns)]
    text.append(line("---:" if numeric else "---" for numeric in _numeric(table)))
    for position, row in enumerate(table.rows):
        text.append(line(f"**{c}**" if (position, k) in table.bold and c else c for k, c in enumerate(row)))
    for heading, items in (("Notes", table.notes), ("How this was made", about)):
        if items:
            text += ["", f"## {heading}", "", *(f"- {item}" for item in items)]
    return "\n".join(text) + "\n"


def _numeric(table: Table) -> list[bool]:
    """Whether each column holds only numbers."""
    return [not any(map(str.isalpha, "".join(row[column] for row in table.rows))) for column in range(len(table.columns))]


def to_latex(table: Table, about: Sequence[str]) -> str:
    """
    :param table: The table
    :param about: Lines on its origin, written as comments
    :return: A LaTeX table; it needs the packages booktabs and graphicx
    """

    def cell(position: int, column: int, text: str) -> str:
        escaped = text.translate(_LATEX_SPECIAL)
        return rf"\textbf{{{escaped}}}" if (position, column) in table.bold and text else escaped

    text = [f"% {item}" for item in about]
    text += ["% Needs \\usepackage{booktabs,graphicx}", "\\begin{table*}[htbp]", "\\centering"]
    # LaTeX numbers the table itself.
    text += [rf"\caption{{{table.caption.translate(_LATEX_SPECIAL)}}}", "\\resizebox{\\textwidth}{!}{%"]
    text += [rf"\begin{{tabular}}{{{''.join('r' if numeric else 'l' for numeric in _numeric(table))}}}", "\\toprule"]
    if any(column.group for column in table.columns):
        cells, rules, first = [], [], 1
        for group, columns in groupby(table.columns, key=lambda column: column.group):
            width = len(list(columns))
            cells.append(rf"\multicolumn{{{width}}}{{c}}{{{group.translate(_LATEX_SPECIAL)}}}")
            rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}" if group else "")
            first += width
        text += [" & ".join(cells) + r" \\", "".join(rules)]
    text += [" & ".join(column.title.translate(_LATEX_SPECIAL) for column in table.columns) + r" \\", "\\midrule"]
    for position, row in enumerate(table.rows):
        if position > 0 and position in table.rules:
            text.append("\\midrule")
        text.append(" & ".join(cell(position, column, content) for column, content in enumerate(row)) + r" \\")
    text += ["\\bottomrule", "\\end{tabular}}"]
    text += [rf"\par\footnotesize {note.translate(_LATEX_SPECIAL)}" for note in table.notes]
    return "\n".join([*text, "\\end{table*}"]) + "\n"


def to_csv(table: Table, about: Sequence[str]) -> str:
    """
    :param table: The table
    :param about: Lines on its origin, written as ``#`` comments like the notes
    :return: CSV, readable by ``pandas.read_csv(path, comment="#")``; missing figures are empty cells
    """
    text = io.StringIO()
    text.writelines(f"# {item}\n" for item in (table.heading, *about, *table.notes))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(column.flat for column in table.columns)
    writer.writerows(["" if cell == MISSING else cell for cell in row] for row in table.rows)
    return text.getvalue()


def read_csv(path: Path) -> tuple[Table, list[str]]:
    """
    :param path: A file written from :func:`to_csv`
    :return: The table without notes, rules and bold cells; and the comments after the caption: origin and notes
    :raises ValueError: If the file is not such a log
    :raises OSError: If it cannot be read
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        comments = [line[1:].strip() for line in takewhile(lambda line: line.startswith("#"), lines)]
        header, *rows = csv.reader(lines[len(comments) :])
        label, separator, caption = comments[0].partition(": ")
        if not separator:
            raise ValueError(f"its first line is {comments[0]!r}, not the caption")
        parts = [title.rpartition(": ") for title in header]
        table = Table(label, caption, [Column(title, group) for group, _, title in parts])
        for row in rows:
            table.add([cell or MISSING for cell in row])
    except (ValueError, IndexError, csv.Error) as error:
        raise ValueError(f"{path}: is no table that `sb3-uav reproduce` wrote ({error}).") from error
    return table, comments[1:]

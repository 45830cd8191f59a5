"""Tables in text: CSV with commas, semicolons or tabs, as people and spreadsheets write them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

DELIMITERS = (",", ";", "\t")
_MOST_COLUMNS = 1_000
# Blank ones, and those within quotes, are no rows, but take time too.
_MOST_LINES = 500_000
_MOST_IN_LINE = 100_000
_MOST_LINES_OF_RECORD = 100
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs"}


@dataclass(frozen=True)
class Table:
    """
    :param source: Name of the file
    :param delimiter: What is between cells
    :param header: Cells of the header, without spaces around them
    :param rows: Line where each row begins, as text editors count from 1, and its cells, as many as the header has and without
        spaces around them; rows without content are left out
    """

    source: str
    delimiter: str
    header: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]


def decoded(data: bytes, source: str) -> str:
    """
    :param data: Content of a text file
    :param source: Its name, for errors
    :return: Its text, without a byte order mark
    :raises ValueError: If it is not UTF-8, or holds control characters; the message names the line
    """
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ValueError(f"{source}: the file is UTF-16; save it as UTF-8.")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # Counted from after the byte order mark.
        offset = error.start + (3 if data.startswith(b"\xef\xbb\xbf") else 0)
        row = _n_line_ends(data[:offset].decode("latin-1")) + 1
        raise ValueError(
            f"{source}: row {row}: byte {data[offset]:#04x} at offset {offset} is not UTF-8; save the file as UTF-8."
        ) from None
    control = _CONTROL.search(text)
    if control:
        row = _n_line_ends(text[: control.start()]) + 1
        raise ValueError(f"{source}: row {row}: the file holds the control character {control[0]!r}; remove it.")
    return text


def _n_line_ends(text: str) -> int:
    """:return: Number of line ends of any kind"""
    return text.count("\n") + text.count("\r") - text.count("\r\n")


def read_table(data: bytes, source: str, known: Sequence[str], most_rows: int, example: str) -> Table:
    """
    Read a table whose first row names its columns.

    The delimiter is the one that makes most cells of the header known names; among equals the one that makes most cells.
    ``sep=;`` in the first line, as spreadsheets write it, is skipped.

    :param data: Content of the file
    :param source: Its name, for errors
    :param known: Beginnings of known names of columns, in lower case
    :param most_rows: Most rows beside the header
    :param example: A header, for errors
    :return: The table
    :raises ValueError: If it is empty, no such table, or too large; the message names the row
    """
    text = decoded(data, source)
    if _n_line_ends(text) > _MOST_LINES:
        raise ValueError(f"{source}: there are {_n_line_ends(text)} rows, but at most {most_rows} are read; divide the file.")
    delimiter = max(DELIMITERS, key=lambda mark: _rank(text, mark, source, known))
    records = _records(text, delimiter, source)
    line, header = _header(records)
    if not header:
        raise ValueError(f"{source}: the file is empty; begin with a row that names the columns, such as {example}.")
    while header and not header[-1]:
        del header[-1]
    if len(header) > _MOST_COLUMNS:
        raise ValueError(f"{source}: row {line}: there are {len(header)} columns, but at most {_MOST_COLUMNS} are read.")
    rows: list[tuple[int, tuple[str, ...]]] = []
    for line, cells in records:
        if len(rows) == most_rows:
            raise ValueError(f"{source}: row {line}: there are more than {most_rows} rows; divide the file.")
        rows.append((line, _fitted(cells, len(header), delimiter, f"{source}: row {line}")))
    return Table(source, delimiter, tuple(header), tuple(rows))


def _rank(text: str, delimiter: str, source: str, known: Sequence[str]) -> tuple[int, int]:
    """:return: How well a delimiter fits the header: its known names, and its cells"""
    try:
        _, header = _header(_records(text, delimiter, source))
    except ValueError:
        return -1, 0
    names = (re.split(r"[^a-z]", cell.lower())[0] for cell in header[:_MOST_COLUMNS])
    return sum(name in known for name in names), len(header)


def _header(records: Iterator[tuple[int, list[str]]]) -> tuple[int, list[str]]:
    """:return: The first record after a line such as ``sep=;``, and its line; no cells if there is none"""
    line, cells = next(records, (1, []))
    if line == 1 and cells and cells[0].lower().startswith("sep=") and not any(cells[1:]):
        return next(records, (1, []))
    return line, cells


def _records(text: str, delimiter: str, source: str) -> Iterator[tuple[int, list[str]]]:
    """
    :return: Line where each record begins, and its cells; without those that are empty
    :raises ValueError: If the text is no CSV
    """
    lines = _Lines(text, source)
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    while True:
        row = lines.begin_record()
        try:
            record = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise ValueError(f"{source}: row {row}: this is no CSV ({error}); look for a quote that is not closed.") from None
        cells = [cell.strip() for cell in record]
        if any(cells):
            yield row, cells


class _Lines:
    """
    The lines of a text, in bounds that keep every record small.

    :param text: The text
    :param source: Its name, for errors
    """

    def __init__(self, text: str, source: str) -> None:
        # Without translation, so that every kind of line end counts once.
        self._lines = io.StringIO(text, newline="")
        self._source = source
        self._n_read = 0
        self._record = 1

    def begin_record(self) -> int:
        """:return: The line where a record begins, from 1"""
        self._record = self._n_read + 1
        return self._record

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = next(self._lines)
        self._n_read += 1
        if len(line) > _MOST_IN_LINE:
            raise ValueError(f"{self._source}: row {self._n_read}: {len(line)} characters are in the line; is this a CSV?")
        if self._n_read >= self._record + _MOST_LINES_OF_RECORD:
            raise ValueError(
                f"{self._source}: row {self._record}: more than {_MOST_LINES_OF_RECORD} lines are in quotes; look for a quote "
                "that is not closed."
            )
        return line


def _fitted(cells: list[str], n_columns: int, delimiter: str, where: str) -> tuple[str, ...]:
    """:return: The cells, without empty ones beyond the header"""
    while len(cells) > n_columns and not cells[-1]:
        del cells[-1]
    if len(cells) != n_columns:
        hint = "; numbers with a decimal comma need semicolons between the columns" if delimiter == "," else ""
        raise ValueError(
            f"{where}: there are {len(cells)} cells, but the header has {n_columns}, separated by {_NAMES[delimiter]}{hint}."
        )
    return tuple(cells)

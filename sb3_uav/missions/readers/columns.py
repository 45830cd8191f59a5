"""Which column of a table means what: synonyms, units in names, misspellings; and the numbers in their cells."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from sb3_uav.missions.readers.table import Table
from sb3_uav.missions.units import number_of

_YES = frozenset(("1", "true", "yes", "y", "t", "x"))
_NO = frozenset(("", "0", "false", "no", "n", "f"))
# How alike a name and a misspelling are, as of difflib. "depth" and "depot" are 0.8 alike.
_ALIKE = 0.82
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?", re.ASCII)
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}", re.ASCII)


@dataclass(frozen=True)
class Field:
    """
    What a column may mean.

    :param name: Its name in messages
    :param synonyms: Names of columns in lower case, without a unit, the best first; with more than one in a table, the best
        counts if ``has_rank``, otherwise that is an error
    :param units: Factors by units that may end the name, after an underscore
    :param needs_unit: Whether the name has to end in a unit
    :param is_text: Whether cells are no numbers
    :param is_degrees: Whether numbers are so small that a comma before three digits must be decimal
    :param has_rank: See ``synonyms``
    """

    name: str
    synonyms: tuple[str, ...]
    units: Mapping[str, float] | None = None
    needs_unit: bool = False
    is_text: bool = False
    is_degrees: bool = False
    has_rank: bool = False


@dataclass(frozen=True)
class Column:
    """
    :param index: Number of the column, from 0
    :param title: Its name as written
    :param field: What it means
    :param factor: What its numbers are multiplied by; 1 if the name has no unit
    :param unit: The unit in its name, if there is one
    """

    index: int
    title: str
    field: Field
    factor: float = 1.0
    unit: str | None = None


def plain(title: str) -> str:
    """:return: A name of a column in lower case, with underscores for spaces, hyphens and brackets"""
    return re.sub(r"[\s\-()\[\]]+", "_", title.strip().lower()).strip("_")


def match_columns(
    table: Table, fields: Sequence[Field], refused: Mapping[str, str], harmless: Sequence[str]
) -> dict[str, Column]:
    """
    :param table: A table
    :param fields: What its columns may mean
    :param refused: What cannot be done, by names of columns that ask for it
    :param harmless: Names of columns that are never taken for misspelled ones
    :return: Columns by the name of their field; other columns are ignored
    :raises ValueError: If two columns mean the same, or a name lacks its unit, has an unknown one, looks misspelled, or is
        refused
    """
    source = table.source
    names = [plain(title) for title in table.header]
    for name, title in zip(names, table.header, strict=True):
        if name in refused:
            raise ValueError(f"{source}: column {title!r:.60}: {refused[name]} not modeled; remove it to plan without.")
    found: dict[str, Column] = {}
    for index, name in enumerate(names):
        column = _meaning(name, index, table.header[index], fields)
        if column is None:
            continue
        key = column.field.name
        other = found.setdefault(key, column)
        if other is column:
            continue
        if not column.field.has_rank or name == plain(other.title):
            raise ValueError(f"{source}: columns {other.title!r:.60} and {column.title!r:.60} both mean {key}; remove one.")
        if column.field.synonyms.index(name) < column.field.synonyms.index(plain(other.title)):
            found[key] = column
    for column in found.values():
        if column.field.needs_unit and column.unit is None:
            example = f"{plain(column.title)}_{next(iter(column.field.units or ()))}"
            raise ValueError(f"{source}: column {column.title!r:.60} does not say its unit; name it {example}, or the like.")
    for name, title in zip(names, table.header, strict=True):
        if name not in harmless and _meaning(name, 0, title, fields) is None:
            _check_spelling(name, title, [field for field in fields if field.name not in found], source)
    return found


def _meaning(name: str, index: int, title: str, fields: Sequence[Field]) -> Column | None:
    for field in fields:
        if name in field.synonyms:
            return Column(index, title, field)
        parts = name.split("_")
        for cut in range(1, len(parts)):
            unit = "_".join(parts[cut:])
            if field.units and unit in field.units and "_".join(parts[:cut]) in field.synonyms:
                return Column(index, title, field, field.units[unit], unit)
    return None


def _check_spelling(name: str, title: str, missing: Sequence[Field], source: str) -> None:
    """
    :raises ValueError: If a name that means nothing resembles one of the fields that are missing
    """
    for field in missing:
        base = next((synonym for synonym in field.synonyms if name.startswith(f"{synonym}_")), None)
        if base is not None and field.units:
            # The first spelling of each.
            spelled: dict[float, str] = {}
            for unit, factor in field.units.items():
                spelled.setdefault(factor, f"{base}_{unit}")
            units = ", ".join(spelled.values())
            raise ValueError(
                f"{source}: column {title!r:.60}: {name[len(base) + 1 :]!r:.40} is no known unit; use {units}, or remove it."
            )
        spellings = [*field.synonyms, *(f"{synonym}_{unit}" for synonym in field.synonyms for unit in field.units or ())]
        meant = [base] if base and not field.is_text else difflib.get_close_matches(name[:60], spellings, 1, _ALIKE)
        # Two letters exchanged count for more with difflib.
        meant = meant or [spelling for spelling in spellings if len(name) > 2 and sorted(spelling) == sorted(name)]
        if meant:
            raise ValueError(f"{source}: column {title!r:.60}: did you mean {meant[0]!r}? Rename or remove it.")


class Cells:
    """
    The cells of a table, by field.

    :param table: The table
    :param columns: Its columns, as of :func:`match_columns`
    :raises ValueError: If it cannot be said what commas in numbers mean
    """

    def __init__(self, table: Table, columns: Mapping[str, Column]) -> None:
        self.table = table
        self.columns = columns
        self._has_comma = self._has_decimal_comma()

    def text(self, row: int, name: str) -> str:
        """
        :param row: Number of the row, from 0
        :param name: Name of a field
        :return: The cell; nothing if there is no such column
        """
        column = self.columns.get(name)
        return "" if column is None else self.table.rows[row][1][column.index]

    def where(self, row: int) -> str:
        """:return: Beginning of messages on a row"""
        return f"{self.table.source}: row {self.table.rows[row][0]}"

    def number(self, row: int, name: str, empty: float | None = None, least: float = -math.inf) -> float:
        """
        :param row: Number of the row, from 0
        :param name: Name of a field that has a column
        :param empty: What an empty cell means; an error when None
        :param least: Least number that is allowed
        :return: The number, as it stands there
        :raises ValueError: If it is no finite number, or too small
        """
        text = self.text(row, name)
        if not text and empty is not None:
            return empty
        title = self.columns[name].title
        if not text:
            raise ValueError(f"{self.where(row)}: {title} is missing; fill the cell.")
        try:
            number = number_of(text.replace(",", ".") if self._has_comma else text)
        except ValueError:
            advice = "decimals need a point" if "," in text else "give a number alone, such as 12.5"
            raise ValueError(f"{self.where(row)}: {title} is {text!r:.60}, which is no number; {advice}.") from None
        if not math.isfinite(number):
            raise ValueError(f"{self.where(row)}: {title} is {text!r:.60}; give a finite number.")
        if number < least:
            raise ValueError(f"{self.where(row)}: {title} is {text!r:.60}; give a number of at least {least:g}.")
        return number

    def flag(self, row: int, name: str) -> bool:
        """
        :param row: Number of the row, from 0
        :param name: Name of a field
        :return: Whether the cell says yes; an empty one says no
        :raises ValueError: If it says neither
        """
        text = self.text(row, name).lower()
        if text not in _YES | _NO:
            raise ValueError(f"{self.where(row)}: {self.columns[name].title} is {text!r:.60}; write yes or no, or 1 or 0.")
        return text in _YES

    def _numbers(self, mark: str) -> Iterator[tuple[int, Column, str]]:
        """:return: Row, column and text of the cells with numbers that hold a mark"""
        columns = [column for column in self.columns.values() if not column.field.is_text]
        for row, (_, cells) in enumerate(self.table.rows):
            for column in columns:
                if mark in cells[column.index]:
                    yield row, column, cells[column.index]

    def _has_decimal_comma(self) -> bool:
        """
        :return: Whether numbers have decimal commas
        :raises ValueError: If some have commas and some have points, or all commas may as well group thousands
        """
        if self.table.delimiter == ",":
            return False
        commas = [found for found in self._numbers(",") if _DECIMAL_COMMA.fullmatch(found[2])]
        if not commas:
            return False
        row, column, text = commas[0]
        for other, with_point, number in self._numbers("."):
            raise ValueError(
                f"{self.where(row)}: {column.title} is {text!r:.60}, but row {self.table.rows[other][0]} has {number!r:.60} "
                f"as {with_point.title}; use either commas or points for decimals in the whole file."
            )
        if all(_GROUPED.fullmatch(text) and not column.field.is_degrees for _, column, text in commas):
            dotted, whole = text.replace(",", "."), text.replace(",", "")
            raise ValueError(
                f"{self.where(row)}: {column.title} is {text!r:.60}, which may be {dotted} or {whole}; write one of them."
            )
        return True

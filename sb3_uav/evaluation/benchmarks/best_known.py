"""The file of best-known values."""

from __future__ import annotations

import csv
from pathlib import Path

from sb3_uav.common.regular_file import read_regular
from sb3_uav.evaluation.benchmarks.instance import finite_number

COLUMNS = ("instance", "best_known")


def read_best_known(path: Path) -> dict[str, float]:
    """
    :param path: A CSV with the columns ``instance`` and ``best_known``, and possibly others
    :return: Best-known values by the name of the instance
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If it is no such file; the message names the line and what was found
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a CSV with the columns {','.join(COLUMNS)}.")
    try:
        # A byte order mark, as spreadsheets write it, is none of the name of the first column.
        lines = read_regular(path).decode("utf-8-sig").splitlines()
        rows = list(csv.reader(lines, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: is no CSV in UTF-8 ({error}); write it again.") from error
    header = [cell.strip() for cell in rows[0]] if rows else []
    if not set(COLUMNS) <= set(header):
        raise ValueError(f"{path}, line 1: needs the columns {','.join(COLUMNS)}, found {','.join(header)!r:.80}.")
    columns = [header.index(name) for name in COLUMNS]
    values: dict[str, float] = {}
    for number, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}, line {number}"
        if len(row) != len(header):
            raise ValueError(f"{where}: has {len(row)} cells, expected {len(header)}, found {','.join(row)!r:.80}.")
        name, text = (row[column].strip() for column in columns)
        try:
            value = finite_number(text)
        except ValueError:
            raise ValueError(f"{where}: best_known of {name!r:.80} is {text!r:.40}; it must be a finite number.") from None
        if value < 0:
            raise ValueError(f"{where}: best_known of {name!r:.80} is {text}; it must be at least 0.")
        if values.setdefault(name, value) != value:
            raise ValueError(
                f"{where}: best_known of {name!r:.80} is {text}, but {values[name]:g} in a line before; keep one."
            )
    if not values:
        raise ValueError(f"{path}: holds no best-known value; add a line for every instance.")
    return values

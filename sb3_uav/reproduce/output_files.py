"""The files of a table or figure, written from its results or again from its CSV."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_uav.common.files import replaced_when_complete
from sb3_uav.plots.figure_files import save_figure
from sb3_uav.reproduce.drawings import DRAWINGS
from sb3_uav.reproduce.origin import Origin
from sb3_uav.reproduce.table_formats import Table, read_csv, to_csv, to_latex, to_markdown
from sb3_uav.reproduce.table_layout import lay_out

# Further tables that a target writes.
COMPANIONS = {"claims": ("claims_comparisons", "claims_ratios")}
_TABLE_FORMATS = {".md": to_markdown, ".tex": to_latex, ".csv": to_csv}
_FIGURE_SUFFIXES = (".png", ".pdf")


def write_files(table: Table, origin: Origin, folder: Path, name: str, drawn: Table | None = None) -> list[Path]:
    """
    Write a table in all formats and, if there is something to draw, its figure.

    :param table: The table
    :param origin: Its origin
    :param folder: Folder of the files
    :param name: Their name without suffix
    :param drawn: The data of the figure, which may be the table itself; None if there is no figure
    :return: Paths of the written files
    :raises ValueError: If they cannot be written
    """
    lay_out(table)
    paths = [_write_text(folder / f"{name}{suffix}", write(table, origin.lines)) for suffix, write in _TABLE_FORMATS.items()]
    if drawn is None:
        return paths
    stem, draw = DRAWINGS[name]
    if drawn is not table:
        paths.append(_write_text(folder / f"{stem}.csv", to_csv(drawn, origin.lines)))
    return [*paths, *_write_figure(draw(drawn), origin, folder / name)] if drawn.rows else paths


def redraw(folder: Path, names: Iterable[str]) -> list[Path]:
    """
    Write the tables and figures of a folder again from the CSV files in it, which stay as they are.

    :param folder: Folder of the files
    :param names: Names of tables and figures
    :return: The files; those without a CSV are left out
    :raises ValueError: If a CSV is damaged, a file cannot be written, or there is no CSV at all
    """
    paths = []
    names = [written for name in names for written in (name, *COMPANIONS.get(name, ()))]
    for name in names:
        if not (folder / f"{name}.csv").is_file():
            continue
        table, origin = _read(folder / f"{name}.csv")
        drawn = None
        if name in DRAWINGS:
            stem = DRAWINGS[name][0]
            drawn = table if stem == name else _read(folder / f"{stem}.csv")[0]
        paths += write_files(table, origin, folder, name, drawn)
    if not paths:
        raise ValueError(f"{folder}: holds no CSV of {', '.join(names)}; give a folder that `sb3-uav reproduce` wrote.")
    return paths


def _read(path: Path) -> tuple[Table, Origin]:
    table, comments = read_csv(path)
    try:
        origin, table.notes = Origin.read(comments)
    except ValueError as error:
        raise ValueError(f"{path}: {error}.") from error
    return table, origin


def _write_text(path: Path, text: str) -> Path:
    with replaced_when_complete(path) as file:
        file.write(text)
    return path


def _write_figure(figure: Any, origin: Origin, stem: Path) -> list[Path]:
    figure.supxlabel(origin.footer(), fontsize=7, color="0.45", x=0.995, ha="right")
    paths = [stem.with_name(stem.name + suffix) for suffix in _FIGURE_SUFFIXES]
    for path in paths:
        save_figure(figure, path, origin.metadata(path.suffix))
    return paths

"""What all tables and figures of one call share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_uav.studies.reproduce.evaluator import BASELINES, Evaluator
from sb3_uav.studies.reproduce.origin import Origin, write_figure
from sb3_uav.studies.reproduce.pairs import Models
from sb3_uav.studies.reproduce.scales import Scale, Scenario
from sb3_uav.studies.reproduce.table_formats import Table, write_table


@dataclass(frozen=True)
class Session:
    """
    :param scale: The scale
    :param models: The trained pairs
    :param evaluator: Runs solvers
    :param solvers: Names of the solvers to compare with: baselines of the paper, and others, which become further columns
    :param origin: What every file says of its origin
    :param out: Folder of all results
    """

    scale: Scale
    models: Models
    evaluator: Evaluator
    solvers: Sequence[str]
    origin: Origin
    out: Path

    @property
    def extra_solvers(self) -> list[str]:
        """Those that the paper does not have."""
        return [solver for solver in self.solvers if solver not in BASELINES]

    def write_table(self, table: Table, name: str) -> list[Path]:
        """
        :param table: The table
        :param name: Of the files
        :return: The files
        """
        return write_table(table, self.origin.lines(), self.out / name)

    def write_figure(self, figure: Any, name: str) -> list[Path]:
        """
        :param figure: A matplotlib figure
        :param name: Of the files
        :return: The files
        """
        return write_figure(figure, self.origin, self.out / name)


class Notes:
    """
    Collects what a reader has to know, everything once.

    :param first: The first notes
    """

    def __init__(self, *first: str) -> None:
        self._texts = dict.fromkeys(first)

    def add(self, *texts: str) -> None:
        """
        :param texts: Further notes
        """
        self._texts.update(dict.fromkeys(texts))

    def add_stand_ins(self, scale: Scale, scenarios: Sequence[Scenario]) -> None:
        """
        Say which scenarios are solved by pairs that were trained for others, and that others stand in for them.

        :param scale: The scale
        :param scenarios: The scenarios
        """
        if scale.shrink != 1:
            self.add(
                f"At scale {scale.name}, our instances have a {scale.shrink}th of the tasks and a maximum flight distance of "
                f"{scale.max_distance:g}: our figures cannot be compared with the paper's."
            )
        others = [f"{s.name} ({trained.name})" for s in scenarios if (trained := scale.trained_for(s)) != s]
        if others:
            self.add(f"Not trained at scale {scale.name}, and solved by the pair of another size: {', '.join(others)}.")

    def list(self) -> list[str]:
        """:return: All notes"""
        return list(self._texts)

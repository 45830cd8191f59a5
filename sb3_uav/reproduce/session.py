"""State shared by all tables and figures of one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sb3_uav.reproduce.evaluator import BASELINES, Evaluator
from sb3_uav.reproduce.origin import Origin
from sb3_uav.reproduce.output_files import write_files
from sb3_uav.reproduce.pairs import Models
from sb3_uav.reproduce.scales import Scale, Scenario
from sb3_uav.reproduce.table_formats import Table


@dataclass(frozen=True)
class Session:
    """
    :param scale: The scale
    :param models: The trained pairs
    :param evaluator: Runs solvers
    :param solvers: Names of the solvers to compare with: baselines of the paper, and others, which become further columns
    :param origin: The origin that every file states
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
        """Solvers that the paper does not have."""
        return [solver for solver in self.solvers if solver not in BASELINES]

    def write(self, table: Table, name: str, drawn: Table | None = None) -> list[Path]:
        """
        :param table: The table
        :param name: Name of the files, without suffix
        :param drawn: The data of its figure, which may be the table itself; None if it has no figure
        :return: Paths of the written files
        """
        return write_files(table, self.origin, self.out, name, drawn)


class Notes:
    """
    Collects notes for the reader, without repetitions.

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
        Note which scenarios are solved by pairs trained for others, and at which sizes.

        :param scale: The scale
        :param scenarios: The scenarios
        """
        if scale.shrink != 1:
            self.add(
                f"At scale {scale.name}, our instances have a {scale.shrink}th of the tasks and a maximum flight distance of "
                f"{scale.max_distance:g}: our figures cannot be compared with the paper's."
            )
        others = [f"{s.name} ({trained.name})" for s in scenarios if (trained := scale.trained_for(s)) != s]
        if others and not scale.universal:
            self.add(f"Not trained at scale {scale.name}, and solved by the pair of another size: {', '.join(others)}.")

    def list(self) -> list[str]:
        """:return: All notes"""
        return list(self._texts)

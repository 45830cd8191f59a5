"""The targets of ``sb3-uav reproduce``, and the solvers that it compares with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_uav.reproduce.session import Session

TARGETS = ("table1", "table2", "table3", "table4", "fig3", "fig4", "fig5", "fig6", "fig7", "claims")
DEFAULT_SOLVERS = ("milp", "ortools", "kmeans-vnd", "kmeans-am")


def target_functions() -> dict[str, Callable[[Session], list[Path]]]:
    """:return: The functions that make the tables, figures and claims, by name"""
    from sb3_uav.reproduce import claims_tables, figures_3_to_7, tables_1_to_4

    modules = {"t": tables_1_to_4, "f": figures_3_to_7, "c": claims_tables}
    return {name: getattr(modules[name[0]], name) for name in TARGETS}


def check_solvers(names: Sequence[str]) -> None:
    """
    :param names: Values of ``--solvers``
    :raises ValueError: If one is not the name of a solver that needs no zips, or is given twice
    """
    from sb3_uav.solvers import SOLVERS

    known = sorted(set(SOLVERS) - {"dl-drl", "dl-drl-i"})
    for name in names:
        if name not in known:
            raise ValueError(f"--solvers: {name!r} is not one of {known}; trained pairs are always included.")
        if names.count(name) > 1:
            raise ValueError(f"--solvers names {name!r} twice.")

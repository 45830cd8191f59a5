"""docs/problem.md: its table of solvers is that of the registry. Run as a script, this writes it."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_uav.common.files import write_atomically
from sb3_uav.envs import Instances
from sb3_uav.envs.reduction import RESOLUTION
from sb3_uav.solvers import SOLVERS, Solver
from sb3_uav.solvers.registry import solver_factory

PAGE = Path(__file__).parents[1] / "docs" / "problem.md"
TABLE = re.compile(r"(?<=<!-- table -->\n).*?(?=<!-- end of the table -->)", re.DOTALL)


def solver_class(name: str) -> type[Solver]:
    """The class of a solver, also of one that a function makes."""
    factory = solver_factory(name)
    found: Any = factory if inspect.isclass(factory) else inspect.signature(factory, eval_str=True).return_annotation
    assert issubclass(found, Solver)
    return found


def table() -> str:
    lines = [
        "| solver | own `start`, `end`, `max_distance`; `service` | `must_serve` | runs until a time limit |",
        "| --- | --- | --- | --- |",
    ]
    for name in sorted(SOLVERS):
        whole, timed = (getattr(solver_class(name), attribute) for attribute in ("solves_whole_problem", "uses_time_limit"))
        cells = [f"`{name}`", "yes" if whole else "refuses", "yes", "yes" if timed else ""]
        lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
    return "\n".join(lines) + "\n"


def test_the_table_of_solvers_is_up_to_date() -> None:
    found = TABLE.search(PAGE.read_text(encoding="utf-8"))
    assert found is not None and found[0] == table(), "run: python tests/test_problem_page.py"


@pytest.mark.parametrize(
    "field", ["depot", "tasks", "values", "n_uavs", "max_distance", "start", "end", "service", "must_serve"]
)
def test_every_field_is_described(field: str) -> None:
    assert field in inspect.signature(Instances.from_arrays).parameters
    assert re.search(rf"^\| [^|]*`{field}`", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)


def test_the_numbers_of_the_page() -> None:
    """What values OR-Tools and PyVRP take exactly, and what a task that must be served counts."""
    from sb3_uav.solvers import ortools_routing, pyvrp_search

    text = PAGE.read_text(encoding="utf-8")
    unit = 100 * (RESOLUTION * 4 + 1)
    for largest in (ortools_routing.LARGEST_COST, pyvrp_search.LARGEST_COST // pyvrp_search._PENALTY_PER_PRIZE):
        shown = f"{largest // unit:.1e}".replace("e+0", "e")
        assert shown in text or shown.replace(".0e", "e") in text, shown
    values = np.arange(100) % 10 + 1.0
    instance = Instances.from_arrays([0.0, 0.0], np.zeros((100, 2)), values, must_serve=np.arange(100) == 0)
    assert 1000 < float(instance.prizes.max()) < 1200


if __name__ == "__main__":
    write_atomically(PAGE, TABLE.sub(table(), PAGE.read_text(encoding="utf-8")))

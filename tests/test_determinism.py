"""The rows of ``docs/determinism.md``: what is promised to be bit-equal is, and the rest stays within its tolerance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch as th
from fuzz_helpers import fuzz_module

determinism = fuzz_module("determinism")
N_TASKS = 6
# Each of them starts Python twice.
SLOW = ("with numba", "one process")


def _rows() -> list[Any]:
    return [
        pytest.param(row, id=row.what, marks=[pytest.mark.slow] if row.what.startswith(SLOW) else [])
        for row in determinism.ROWS
    ]


@pytest.mark.parametrize("row", _rows())
def test_rows_keep_what_they_promise(row: Any) -> None:
    found = row.compare(N_TASKS)
    if found is None:
        pytest.skip("needs a GPU, or numba")
    assert determinism.kept(row, found), found.text


def test_a_difference_is_noticed() -> None:
    """In the last bit of one parameter, and in one route."""
    from sb3_uav.envs import Schedule

    one = {"a": th.ones(3), "b": th.zeros(2)}
    other = {"a": th.ones(3), "b": th.tensor([0.0, 1e-38])}
    promised = next(row for row in determinism.ROWS if row.promised)
    assert not determinism.kept(promised, determinism._parameters(one, other))
    assert determinism.kept(promised, determinism._parameters(one, dict(one)))
    routes = [Schedule([[0, 1], [2]]), Schedule([[1], [0]])]
    found = determinism._routes(routes, [routes[0], Schedule([[0], [1]])])
    assert found.size == 0.5 and "1 of 2" in found.text


def test_the_page_has_every_row() -> None:
    page = (Path(__file__).parents[1] / "docs" / "determinism.md").read_text(encoding="utf-8")
    for row in determinism.ROWS:
        assert f"| {row.kind} | {row.what} | {'bit-equal' if row.promised else 'within'}" in page

"""The anytime curve: what it draws, against figures worked out by hand, and what reaches the disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from sb3_uav.cli import main as cli
from sb3_uav.envs import Instances, Schedule, UniformGenerator
from sb3_uav.evaluation.results import FAILED, OK, ResultRow, read_results
from sb3_uav.evaluation.run import evaluate
from sb3_uav.plots import anytime, plot_anytime
from sb3_uav.plots.anytime import _anytime_panels
from sb3_uav.solvers import Solver, SolverResult


class Timed(Solver):
    """Visits as many reachable tasks as it has seconds, one UAV each; fails on the first instance if it has less than one."""

    name = "timed"

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [result for _, result in self.solve_rows(instances, range(len(instances)), time_limit, seed)]

    def solve_rows(self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0) -> Any:
        assert time_limit is not None
        for row in rows:
            if time_limit < 1 and row == 0:
                raise ValueError("That is not enough.")
            tasks = instances.reachable()[row].nonzero()[: round(time_limit), 0].tolist()
            yield row, SolverResult(Schedule([[task] for task in tasks]), time_limit)


class Fast(Timed):
    """Needs no time limit, and solves all instances in one batch."""

    name = "fast"
    uses_time_limit = False

    def solve_rows(self, instances: Instances, rows: Sequence[int], time_limit: float | None = None, seed: int = 0) -> Any:
        for row, result in super().solve_rows(instances, rows, 2.0):
            yield row, SolverResult(result.schedule, 0.001, 3)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two sets of instances, a solver at three time limits that fails at the shortest, and one without."""
    sets = {f"U4-N{n}": UniformGenerator(n, n_uavs=4)(3, np.random.default_rng(n)) for n in (20, 30)}
    evaluate([Timed(), Fast()], sets, tmp_path / "results", time_limits=(0.5, 1.0, 4.0))
    return tmp_path / "results"


def row(
    solver: str, limit: float | None, instance: int, objective: float | None, seconds: float = 1.0, seed: int = 0
) -> ResultRow:
    status = FAILED if objective is None else OK
    return ResultRow(
        solver, instance, 4, 20, objective, 1.0, seconds, objective is not None, "set", limit, seed, 1, None, status, ""
    )


def test_panels_of_an_evaluation(folder: Path) -> None:
    """A panel for every set; what did not solve all instances is left out, and said to be."""
    panels = _anytime_panels(read_results(folder / "results.csv"))
    assert [(panel.source, panel.n_instances, panel.left_out) for panel in panels] == [
        ("U4-N20", 3, ["timed (0.5 s)"]),
        ("U4-N30", 3, ["timed (0.5 s)"]),
    ]
    for panel in panels:
        timed, fast = panel.curves
        assert (timed.solver, timed.seconds.tolist(), timed.objective.tolist()) == ("timed", [1.0, 4.0], [1.0, 4.0])
        assert (fast.solver, fast.seconds.tolist(), fast.objective.tolist()) == ("fast", [0.001], [2.0])
        assert (timed.batch_size, fast.batch_size) == (1, 3)


def test_bands_by_hand() -> None:
    """
    The best objectives are 10, 22 and 32. The slow solver misses 0, 0 and 0 of them at 8 s, and 1, 2 and 3 at 2 s: standard
    deviation 1, Student's t for 2 degrees of freedom 4.303. That instances differ by 10 and more does not matter.
    """
    rows = [row("slow", 8.0, i, objective, 7.0) for i, objective in enumerate([10.0, 22.0, 32.0])]
    rows += [row("slow", 2.0, i, objective, 2.0 + i) for i, objective in enumerate([9.0, 20.0, 29.0])]
    rows += [row("quick", None, i, objective) for i, objective in enumerate([9.0, 19.0, 30.0])]
    (panel,) = _anytime_panels(rows)
    slow, quick = panel.curves
    np.testing.assert_allclose(slow.seconds, [3.0, 7.0])
    np.testing.assert_allclose(slow.objective, [58 / 3, 64 / 3])
    np.testing.assert_allclose(slow.halfwidth, [4.303 / np.sqrt(3), 0.0])
    np.testing.assert_allclose(quick.halfwidth, [4.303 * np.std([1, 3, 2], ddof=1) / np.sqrt(3)])


def test_seeds_are_averaged() -> None:
    rows = [row("a", 1.0, i, 10.0 * i + seed, 1.0 + seed, seed) for seed in (0, 4) for i in range(2)]
    (panel,) = _anytime_panels(rows)
    assert panel.curves[0].objective.tolist() == [7.0] and panel.curves[0].seconds.tolist() == [3.0]


def test_limits_that_make_no_difference() -> None:
    """Each is a run of its own, even of the same results; one failure leaves out that limit only."""
    rows = [row("same", limit, i, 5.0 + i, limit) for limit in (3.0, 1.0) for i in range(2)]
    rows += [row("torn", 1.0, 0, 5.0), row("torn", 1.0, 1, None), row("torn", 3.0, 0, 5.0), row("torn", 3.0, 1, 6.0)]
    rows += [row("never", None, 0, None), row("fast", None, 0, 5.0), row("fast", None, 1, 6.0)]
    (panel,) = _anytime_panels(rows)
    assert [(curve.solver, len(curve.seconds)) for curve in panel.curves] == [("same", 2), ("torn", 1), ("fast", 1)]
    assert panel.curves[0].seconds.tolist() == [1.0, 3.0]
    assert panel.left_out == ["torn (1 s)", "never"]


def test_what_is_drawn(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time runs on a logarithmic axis; a curve has its points, a solver without time limit a point and a line to the right."""
    figures: list[Any] = []
    monkeypatch.setattr(anytime, "save_figure", lambda figure, _: figures.append(figure))
    plot_anytime(folder, tmp_path / "curve.png")
    panels = figures[0].axes
    assert [axes.get_title(loc="left") for axes in panels] == ["U4-N20: 3 instances", "U4-N30: 3 instances"]
    for axes in panels:
        assert axes.get_xscale() == "log"
        timed, fast = axes.lines
        assert timed.get_xydata().tolist() == [[1.0, 1.0], [4.0, 4.0]]
        assert fast.get_xydata().tolist() == [[0.001, 2.0]]
        assert [text.get_text() for text in axes.get_legend().get_texts()] == ["timed", "fast\n(batches of 3)"]
        assert [text.get_text() for text in axes.texts] == ["Did not solve all instances: timed (0.5 s)"]
        dashed = [line.get_segments()[0] for line in axes.collections if hasattr(line, "get_segments")]
        assert dashed[0][:, 1].tolist() == [2.0, 2.0] and dashed[0][1, 0] == axes.get_xlim()[1] > 4.0


def test_files(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command writes both formats beside the results, or what it is told to."""
    assert cli.main(["anytime", str(folder)]) == 0
    assert capsys.readouterr().out == f"{folder / 'anytime.png'}\n{folder / 'anytime.pdf'}\n"
    height, width = matplotlib.image.imread(folder / "anytime.png").shape[:2]
    assert width > 900 and height > 1100
    assert (folder / "anytime.pdf").read_bytes().startswith(b"%PDF")
    assert cli.main(["anytime", str(folder), "--out", str(tmp_path / "new" / "curve.svg")]) == 0
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["curve.svg"]


def test_some_of_the_solvers(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver keeps its look, whoever stands beside it; the best comes first in the legend."""
    figures: list[Any] = []
    monkeypatch.setattr(anytime, "save_figure", lambda figure, _: figures.append(figure))
    plot_anytime(folder, tmp_path / "curve.png")
    plot_anytime(folder, tmp_path / "curve.png", ["fast"])
    both, (one,) = figures[0].axes[0].lines, figures[1].axes[0].lines
    assert (one.get_color(), one.get_marker()) == (both[1].get_color(), both[1].get_marker())
    assert len(figures[1].axes[0].texts) == 0
    with pytest.raises(ValueError, match=r"has no results of 'slow'; choose some of \['timed', 'fast'\]"):
        plot_anytime(folder, tmp_path / "curve.png", ["fast", "slow"])


def test_every_look_is_another() -> None:
    looks = [tuple(anytime._solver_style(number).values()) for number in range(64)]
    assert len(set(looks)) == 64


def test_nothing_to_draw(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def error_for(*arguments: Any) -> str:
        assert cli.main(["anytime", *map(str, arguments)]) == 2
        return capsys.readouterr().err

    assert f"{tmp_path / 'results.csv'}: no such file; give the folder that `sb3-uav evaluate` wrote" in error_for(tmp_path)
    assert "the suffix of a figure must be one of" in error_for(folder, "--out", tmp_path / "curve.jpg")
    results = folder / "results.csv"
    results.write_text(
        "\n".join(line for line in results.read_text().splitlines() if "failed" in line or "feasible" in line) + "\n"
    )
    assert "no solver has solved all instances of a set; there is nothing to draw" in error_for(folder)
    results.write_text("solver,objective\n")
    assert "its columns are not those" in error_for(folder)
    assert not (folder / "anytime.png").exists()

"""What is said of results: against figures worked out by hand, and properties that any figures have."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.common.statistics import confidence_halfwidth
from sb3_uav.evaluation.result_index import Figures, Place
from sb3_uav.evaluation.results import FAILED, INFEASIBLE, OK, ResultRow
from sb3_uav.evaluation.summary import _SUMMARY_COLUMNS, SummaryRow, _optimality_gap, gaps, write_summary
from sb3_uav.evaluation.summary import summarize as summarize_figures
from sb3_uav.evaluation.table import print_table

FIRST = 10


def summarize(
    source: str, results: dict[str, list[ResultRow]], reference: str, time_limit: float | None = None
) -> list[SummaryRow]:
    """Of results one by one, as they stand in files."""
    figures = {}
    for solver, rows in results.items():
        whole = Figures(FIRST + len(rows))
        for row in rows:
            whole.set(row, Place(0, 0))
        figures[solver] = whole.selected(np.arange(FIRST, FIRST + len(rows)))
    return summarize_figures(source, np.arange(len(rows)), figures, reference, time_limit)


def make_rows(solver: str, objectives: list[float | None], bounds: list[float | None] | None = None) -> list[ResultRow]:
    """Results of one solver; None for an instance where it failed."""
    return [
        ResultRow(
            solver=solver,
            instance=FIRST + i,
            n_uavs=2,
            n_tasks=5,
            objective=objective,
            length=1.0,
            seconds=None if objective is None else 0.5 + i,
            feasible=objective is not None,
            source="set",
            time_limit=None,
            seed=0,
            batch_size=None if objective is None else 1,
            bound=None if bounds is None else bounds[i],
            status=FAILED if objective is None else OK,
            message="it broke" if objective is None else "",
        )
        for i, objective in enumerate(objectives)
    ]


def results(**objectives: list[float | None]) -> dict[str, list[ResultRow]]:
    return {solver: make_rows(solver, values) for solver, values in objectives.items()}


# --------------------------------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize(
    "objectives, expected",
    [
        ([65.44, 56.45, 59.68, 58.78, 61.32, 64.67, 65.28], [0.00, 13.74, 8.79, 10.18, 6.29, 1.17, 0.24]),
        ([209.00, 113.88, 154.71, 170.20, 188.78, 216.66, 220.44], [5.19, 48.34, 29.82, 22.79, 14.36, 1.72, 0.00]),
    ],
)
def test_gaps_of_the_paper(objectives: list[float], expected: list[float]) -> None:
    """Table II, 80 and 500 tasks, up to the rounding of its objectives."""
    assert gaps(objectives) == pytest.approx(expected, abs=0.02)


def test_gaps_that_divide_by_nothing() -> None:
    assert gaps([0.0, 0.0]) == [0.0, 0.0]
    found = gaps([math.nan, 8.0, 10.0])
    assert math.isnan(found[0]) and found[1:] == [pytest.approx(20.0), 0.0]
    assert all(map(math.isnan, gaps([math.nan, math.nan])))


def test_paired_differences_by_hand() -> None:
    """
    Differences 3, 1, 2, 4: mean 2.5, standard deviation sqrt(5/3) = 1.2910, standard error 0.6455; Student's t for 3 degrees
    of freedom is 3.182, so the interval is 2.5 +- 2.054. The means alone, 12.5 and 10 with errors of about 4, say nothing.
    """
    reference, other = summarize("set", results(a=[2.0, 6.0, 13.0, 19.0], b=[5.0, 7.0, 15.0, 23.0]), "a")
    assert (other.n_paired, other.difference) == (4, 2.5)
    assert other.difference_low == pytest.approx(2.5 - 2.054, abs=5e-4)
    assert other.difference_high == pytest.approx(2.5 + 2.054, abs=5e-4)
    assert other.ratio == pytest.approx(12.5 / 10)
    assert (reference.difference, reference.difference_low, reference.difference_high, reference.ratio) == (0, 0, 0, 1)
    assert other.objective == 12.5 and other.standard_error == pytest.approx(4.113, abs=5e-4)
    assert reference.gap == pytest.approx(20.0) and other.gap == 0.0
    assert (other.seconds, other.batch_size, other.n_instances, other.n_feasible) == (2.0, 1, 4, 4)


@pytest.mark.parametrize(
    "n, quantile", [(2, 12.7062), (3, 4.3027), (6, 2.5706), (10, 2.2622), (11, 2.2281), (16, 2.1314), (500, 1.9647)]
)
def test_confidence_interval_against_tables(n: int, quantile: float) -> None:
    values = np.arange(n, dtype=float)
    deviation = math.sqrt(sum((value - (n - 1) / 2) ** 2 for value in values) / (n - 1))
    assert confidence_halfwidth(values) == pytest.approx(quantile * deviation / math.sqrt(n), rel=5e-4)


def test_confidence_interval_holds_what_it_says() -> None:
    """Of 4,000 samples of 5 normal numbers, 95 % of the intervals hold the true mean, within 3 standard errors of a count."""
    samples = np.random.default_rng(0).normal(7.0, 2.0, (4000, 5))
    hits = np.mean([abs(sample.mean() - 7.0) <= confidence_halfwidth(sample) for sample in samples])
    assert abs(hits - 0.95) < 3 * math.sqrt(0.95 * 0.05 / 4000)
    assert math.isnan(confidence_halfwidth(samples[0, :1])) and math.isnan(confidence_halfwidth(samples[0, :0]))
    assert confidence_halfwidth(np.full(4, 2.0)) == 0.0


def test_bounds_by_hand() -> None:
    """The best bound of each instance counts for every solver, also for those that prove none."""
    found = {
        "exact": make_rows("exact", [4.0, 8.0, None, 0.0], [4.0, 10.0, 12.0, 0.0]),
        "loose": make_rows("loose", [3.0, 8.0, 6.0, 0.0], [8.0, 9.0, None, 7.0]),
        "heuristic": make_rows("heuristic", [2.0, 9.0, 9.0, 0.0]),
    }
    exact, loose, heuristic = summarize("set", found, "heuristic")
    assert (exact.n_bounds, exact.bound) == (4, 6.5)
    assert (loose.n_bounds, loose.bound) == (3, 8.0)
    assert (heuristic.n_bounds, math.isnan(heuristic.bound)) == (0, True)
    # Best bounds: 4, 9, 12, 0.
    assert exact.optimality_gap == pytest.approx(100 * (0 + 1 / 9 + 0) / 3)
    assert loose.optimality_gap == pytest.approx(100 * (1 / 4 + 1 / 9 + 6 / 12 + 0) / 4)
    assert heuristic.optimality_gap == pytest.approx(100 * (2 / 4 + 0 + 3 / 12 + 0) / 4)
    assert math.isnan(_optimality_gap(np.array([1.0, np.nan]), np.array([np.nan, 2.0])))


def test_a_bound_below_what_is_achieved_is_wrong() -> None:
    found = {"liar": make_rows("liar", [4.0, 4.0], [4.0, 4.9999]), "other": make_rows("other", [4.0000001, 5.0])}
    liar, other = summarize("set", found, "other")
    assert liar.violations == (
        "liar, instance 1 of set: its upper bound of 4.9999 is below 5, which a feasible schedule achieves.",
    )
    assert other.violations == ()


def test_failures_leave_the_others_comparable() -> None:
    """Only the same instances are compared, and who failed on some has no gap, because its mean is over others."""
    a, b, c = summarize("set", results(a=[10.0, None, 30.0, 1.0], b=[12.0, 99.0, 31.0, None], c=[None] * 4), "a")
    assert (b.n_paired, b.difference, b.n_feasible) == (2, 1.5, 3)
    assert b.ratio == pytest.approx(21.5 / 20)
    assert all(math.isnan(row.gap) for row in (a, b, c))
    assert (c.n_paired, c.n_feasible, c.batch_size) == (0, 0, 0)
    assert all(map(math.isnan, (c.objective, c.difference, c.difference_low, c.seconds, c.ratio)))
    assert c.failures == ("c failed on 4 of 4 instances of set: it broke",)
    assert a.failures == ("a failed on 1 of 4 instances of set: it broke",)


def test_infeasible_schedules_are_named() -> None:
    rows = make_rows("a", [1.0, None])
    rows[1] = ResultRow(**{**vars(rows[1]), "status": INFEASIBLE, "message": "UAV 0 flies too far."})
    (row,) = summarize("set", {"a": rows}, "a")
    assert row.violations == ("a, instance 1 of set: UAV 0 flies too far.",) and row.failures == ()


# ------------------------------------------------------------------------------------------------------------- properties

objective_lists = st.lists(
    st.lists(st.one_of(st.none(), st.floats(0, 1e6, allow_subnormal=False)), min_size=5, max_size=5), min_size=1, max_size=4
)


@given(objective_lists, st.permutations(range(5)))
def test_summaries_of_any_results(objectives: list[list[float | None]], order: list[int]) -> None:
    """Differences are antisymmetric, the best has gap 0, and the order of the instances does not matter."""
    found = {str(i): make_rows(str(i), values) for i, values in enumerate(objectives)}
    summary = summarize("set", found, "0")
    complete = [row.gap for row in summary if row.n_feasible == 5]
    assert not complete or (min(complete) == 0.0 and max(complete) <= 100.0)
    assert all(math.isnan(row.gap) for row in summary if row.n_feasible < 5)
    for row in summary:
        (back,) = [other for other in summarize("set", found, row.solver) if other.solver == "0"]
        assert back.n_paired == row.n_paired
        np.testing.assert_allclose(back.difference, -row.difference, atol=1e-9, equal_nan=True)
        np.testing.assert_allclose(back.difference_low, -row.difference_high, atol=1e-6, equal_nan=True)
    shuffled = {str(i): make_rows(str(i), [values[j] for j in order]) for i, values in enumerate(objectives)}
    for one, other in zip(summary, summarize("set", shuffled, "0"), strict=True):
        figures = (one.objective, one.standard_error, one.gap, one.difference, one.difference_low, one.ratio)
        again = (other.objective, other.standard_error, other.gap, other.difference, other.difference_low, other.ratio)
        np.testing.assert_allclose(figures, again, rtol=1e-6, atol=1e-6, equal_nan=True)


# -------------------------------------------------------------------------------------------------------- files and tables


def test_summary_files(tmp_path: Path) -> None:
    """Both hold the same figures, and no NaN, which JSON does not have."""
    found = {"a": make_rows("a", [1.0, 3.0], [4.0, 4.0]), "b, c": make_rows("b, c", [None, 2.0])}
    summary = summarize("set", found, "a", time_limit=0.5)
    write_summary(summary, tmp_path, {"reference": "a", "seed": 3})
    text = (tmp_path / "summary.json").read_text()
    told = json.loads(text)
    assert "NaN" not in text and (told["reference"], told["seed"], told["confidence"]) == ("a", 3, 0.95)
    with (tmp_path / "summary.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == _SUMMARY_COLUMNS
    for row, record, expected in zip(rows, told["rows"], summary, strict=True):
        for name in _SUMMARY_COLUMNS:
            value: Any = getattr(expected, name)
            missing = value is None or (isinstance(value, float) and math.isnan(value))
            assert record[name] == (None if missing else value)
            assert row[name] == ("" if missing else str(value))
    assert told["rows"][1]["failures"] == ["b, c failed on 1 of 2 instances of set: it broke"]
    assert [row["time_limit"] for row in rows] == ["0.5", "0.5"]


def table_lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [" ".join(line.split()) for line in capsys.readouterr().out.splitlines() if line.strip()]


def test_table_shows_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    plain = {"a[b]": make_rows("a[b]", [2.0, 6.0, 13.0, 19.0]), "b": make_rows("b", [5.0, 7.0, 15.0, 23.0])}
    print_table(summarize("set", plain, "a[b]", 2.0))
    lines = table_lines(capsys)
    assert lines[0] == "set: 4 instances, 2 s each"
    assert lines[1:3] == ["Std. Gap s per", "Solver Obj. error % Difference instance"]
    assert lines[4:6] == ["a[b] 10.00 3.76 20.00 reference 2.0000", "b 12.50 4.11 0.00 +2.50 ± 2.05 2.0000"]
    assert lines[6] == "Difference: to a[b] on the same instances, with 95 % confidence"

    print_table(summarize("set", {"a": make_rows("a", [2.0, None], [4.0, None]), "b": make_rows("b", [1.0, 1.0])}, "b"))
    lines = table_lines(capsys)
    assert lines[2] == "Solver Obj. error % Difference Bound gap % instance Feasible"
    assert lines[4:6] == [
        "a 2.00 - - +1.00 (n=1) 4.00 50.00 0.5000 1/2",
        "b 1.00 0.00 0.00 reference - 75.00 1.0000 2/2",
    ]

    print_table(summarize("set", {"alone": make_rows("alone", [None])}, "alone"))
    lines = table_lines(capsys)
    assert lines[2:] == ["Solver Obj. error % instance Feasible", lines[3], "alone - - - - 0/1"]


def test_tasks_left_out_stand_beside_the_values(capsys: pytest.CaptureFixture[str]) -> None:
    """Figures are of values alone; what must be served is counted in a column of its own."""
    found = {"a": make_rows("a", [9.0, 9.0]), "b": make_rows("b", [5.0, 7.0])}
    found["a"] = [ResultRow(**{**vars(row), "unserved": i + 1}) for i, row in enumerate(found["a"])]
    a, b = summarize("set", found, "b")
    assert (a.n_unserved, b.n_unserved, a.difference) == (3, 0, 3.0)
    assert b.unserved == () and a.unserved[0].startswith("a, 2 of 2 instances of set: leaves out tasks that must be served")
    print_table([a, b])
    lines = table_lines(capsys)
    assert lines[2].endswith("instance served") and lines[4].endswith(" 1.0000 3") and lines[5].endswith(" 1.0000 0")


def test_table_fits_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """With 80 columns, names are folded and figures are whole; where the output is a file, no name is folded."""
    name = "dl-drl:allocator=a/rather/long/path/allocator.zip,router=a/rather/long/path/router.zip"
    found = {name: make_rows(name, [52.0, 60.5], [80.0, 80.0]), "b": make_rows("b", [10.0, 35.0], [80.0, 80.0])}
    summary = summarize("set", found, name)
    print_table(summary)
    assert any(line.startswith(f"{name} 56.25 4.25 0.00 reference 80.00 29.69 1.0000") for line in table_lines(capsys))
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    print_table(summary)
    text = capsys.readouterr().out
    assert "-33.75 ± 104.82" in text and "…" not in text

"""What `sb3-uav reproduce` is made of: the paper's figures as data, scales, table formats and logs of trainings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from its_logs import LOG

from sb3_uav.evaluation.summary import gaps
from sb3_uav.studies.reproduce import paper
from sb3_uav.studies.reproduce.evaluator import Evaluator
from sb3_uav.studies.reproduce.figures_3_to_7 import read_curves
from sb3_uav.studies.reproduce.pair_training import training_entry
from sb3_uav.studies.reproduce.pairs import ITS, Model
from sb3_uav.studies.reproduce.paper import paper_figure, paper_tables
from sb3_uav.studies.reproduce.scales import CPU, PAPER, SCALES, SMOKE, Scenario, scenarios
from sb3_uav.studies.reproduce.table_formats import Column, Table, best, to_csv, to_latex, to_markdown
from sb3_uav.studies.reproduce.tables_1_to_4 import phase_times, seconds

pytest.importorskip("rl_zoo3")


# ------------------------------------------------------------------------------------------------------- the paper's figures


def test_every_figure_of_the_paper_is_there() -> None:
    assert [paper_figure("table1", s.name, phase) for s in scenarios() for phase in paper.PHASES].count(None) == 0
    for table in ("table2", "table3"):
        rows = paper_tables()[table]["rows"]
        assert list(rows) == [str(size) for size in paper.SIZES]
        for row in rows.values():
            assert {block: tuple(methods) for block, methods in row.items()} == {
                "30 instances": paper.EXACT_COLUMNS,
                "500 instances": paper.FULL_COLUMNS,
            }
            assert all(
                set(figures) == set(paper.MEASURES.values()) for methods in row.values() for figures in methods.values()
            )
    rows = paper_tables()["table4"]["rows"]
    assert {fleet: list(sizes) for fleet, sizes in rows.items()} == {
        fleet: [str(size) for size in paper.LARGER_SIZES[:5]] for fleet in ("U4", "U6")
    }
    assert all(tuple(methods) == paper.LARGER_METHODS for sizes in rows.values() for methods in sizes.values())


@pytest.mark.parametrize(
    "figure, path",
    [
        (20.55, ("table1", "U4-80", "Upper-level")),
        (116.02, ("table1", "U6-500", "Data generation")),
        (65.44, ("table2", "80", "500 instances", "OR-tools", "objective")),
        (316.45, ("table2", "500", "500 instances", "K-means+VND", "seconds")),
        (220.44, ("table2", "500", "500 instances", "DL-DRL (Sampling)", "objective")),
        (64.37, ("table3", "80", "30 instances", "Gurobi (1800s)", "objective")),
        (2.21, ("table3", "150", "500 instances", "OR-tools", "seconds")),
        (305.64, ("table4", "U4", "1000", "OR-tools", "objective")),
        (3.32, ("table4", "U6", "1000", "DL-DRL", "seconds")),
        (None, ("table4", "U6", "1500", "DL-DRL", "seconds")),
    ],
)
def test_figures_of_the_paper(figure: float | None, path: tuple[str, ...]) -> None:
    assert paper_figure(*path) == figure


def test_the_papers_gaps_follow_from_its_objectives() -> None:
    """But for the one that the faults name; this would catch most errors in copying."""
    wrong = []
    for table in ("table2", "table3"):
        for size, blocks in paper_tables()[table]["rows"].items():
            for methods in blocks.values():
                computed = gaps([figures["objective"] for figures in methods.values()])
                for (method, figures), gap in zip(methods.items(), computed, strict=True):
                    if abs(figures["gap"] - gap) > 0.02:
                        wrong.append((table, size, method))
    assert wrong == [("table2", "100", "DL-DRL (Greedy)")]
    assert "0.93" in paper_tables()["table2"]["faults"][1]


def test_the_copied_cells_are_named() -> None:
    exact = {size: blocks["30 instances"] for size, blocks in paper_tables()["table2"]["rows"].items()}
    copies = [size for size, row in exact.items() if row["DL-DRL (Greedy)"] == row["Gurobi (1800s)"]]
    assert copies == ["200", "300", "500"]
    assert "200, 300 and 500 tasks" in paper_tables()["table2"]["faults"][0]


# ------------------------------------------------------------------------------------------------------------------- scales


def test_untrained_sizes_are_solved_by_the_nearest_pair() -> None:
    assert [SMOKE.trained_for(Scenario(6, size)).n_tasks for size in paper.SIZES] == [80, 80, 200, 200, 200, 200]
    assert [PAPER.trained_for(Scenario(4, size)).n_tasks for size in (*paper.SIZES, 600, 1500)] == [*paper.SIZES, 500, 500]


@pytest.mark.parametrize("scale", SCALES.values(), ids=str)
def test_scales_are_complete(scale: Any) -> None:
    assert set(scale.n_instances) == {*paper.SIZES, *paper.LARGER_SIZES}
    assert set(scale.exact_sizes) | set(scale.trained_sizes) <= set(paper.SIZES)
    assert scale is PAPER or all(0 < scale.time_limits[name] <= 60 for name in ("milp", "ortools-gls", "pyvrp"))


def test_training_entries() -> None:
    """At the paper's scale the zoo's own entry, at the others the changes of the recipe, at every level."""
    entry = training_entry(PAPER, PAPER.recipe, Scenario(6, 300), ITS)
    its = entry["callback"][0]["sb3_uav.training.ITSCallback"]
    assert (entry["n_envs"], entry["instances_per_epoch"], entry["learning_rate"]) == (256, 1_280_000, 1e-4)
    assert (its["n_epochs"], its["n_intensive_epochs"], its["n_continuous_epochs"]) == (100, 12, 6)
    assert entry["n_timesteps"] >= 100 * 1_280_000 * 300
    cpu = training_entry(CPU, CPU.recipe, Scenario(4, 300), "ITS/intensive")
    its = cpu["callback"][0]["sb3_uav.training.ITSCallback"]
    assert (cpu["instances_per_epoch"], cpu["baseline"], its["router"]["baseline"]) == (320, "shared", "shared")
    assert (its["strategy"], its["n_epochs"], its["n_intensive_epochs"]) == ("ITS/intensive", 24, 8)
    assert training_entry(SMOKE, SMOKE.recipe, Scenario(4, 80), ITS)["env_kwargs"] == {"n_tasks": 8, "max_distance": 1.0}


def test_test_instances() -> None:
    """Fewer are the first of more; seeds and scenarios differ."""
    evaluator = Evaluator(CPU, Path("unused"))
    some, more = (evaluator.instances(Scenario(4, 80), n_instances=n) for n in (3, 5))
    assert th.equal(some.tasks, more[:3].tasks) and th.equal(some.depot, more[:3].depot)
    others = [
        Evaluator(CPU, Path("unused"), seed=1).instances(Scenario(4, 80), n_instances=3),
        evaluator.instances(Scenario(6, 80), n_instances=3),
        evaluator.instances(Scenario(4, 80), 1234, 3),
    ]
    assert all(not th.equal(some.tasks, other.tasks) for other in others)
    assert len(evaluator.instances(Scenario(4, 80))) == CPU.n_instances[80]
    assert float(more.max_distance[0]) == 2.0 and more.n_tasks == 80


# ------------------------------------------------------------------------------------------------------------------- tables


def test_best_of_what_is_shown() -> None:
    assert best([1.0, 2.001, None, 1.999, float("nan")]) == [1, 3]
    assert best([1.0, 2.0, None], smallest=True) == [0]
    assert best([None, float("nan")]) == []
    # Small times are shown with more digits than others.
    times = [0.0012, 0.0038, 0.00119, 0.2]
    assert best(times, smallest=True, show=seconds) == [0, 2]
    assert best(times, smallest=True) == [0, 1, 2]
    assert best([0.12, 0.1234], smallest=True, show=seconds) == [0, 1]


def test_a_table_in_three_formats() -> None:
    table = Table("A & B", [Column("Name"), Column("x", "all"), Column("y", "all")], notes=["50 % of a_b"])
    table.add(["one|two", "1.00", "-"], bold=[1, 2])
    table.start_part()
    table.add(["R&D", "2.00", "3.00"])
    markdown = to_markdown(table, ["Seed: 1"])
    assert "| Name | all: x | all: y |\n| --- | ---: | ---: |\n| one\\|two | **1.00** | **-** |\n" in markdown
    assert "- 50 % of a_b" in markdown and "- Seed: 1" in markdown
    latex = to_latex(table, ["Seed: 1"])
    assert latex.startswith("% Seed: 1\n") and r"\multicolumn{2}{c}{all}" in latex and r"\cmidrule(lr){2-3}" in latex
    assert r"\begin{tabular}{lrr}" in latex and "R\\&D & 2.00 & 3.00 \\\\" in latex and r"50 \% of a\_b" in latex
    assert latex.count(r"\midrule") == 2 and latex.count("{") == latex.count("}")
    assert to_csv(table, ["Seed: 1"]).splitlines()[-3:] == ["Name,all: x,all: y", "one|two,1.00,", "R&D,2.00,3.00"]
    with pytest.raises(ValueError, match="2 cells, the table 3 columns"):
        table.add(["too", "few"])


# --------------------------------------------------------------------------------------------------------- logs of trainings


@pytest.fixture
def logged(tmp_path: Path) -> Model:
    (tmp_path / "its_log.csv").write_text(LOG)
    return Model(Scenario(4, 80), ITS, tmp_path, "U4-80")


def test_phase_times(logged: Model) -> None:
    """Per instance, without the first epoch and without the router's instances in its own time."""
    assert phase_times(logged) == pytest.approx((0.18, 4 / 50, 2 / 50, 100))
    # What earlier versions wrote does not tell them apart.
    lines = [line.rpartition(",")[0] for line in LOG.splitlines()]
    (logged.folder / "its_log.csv").write_text("\n".join(lines) + "\n")
    upper, lower, generation, _ = phase_times(logged)
    assert upper == pytest.approx(0.18) and np.isnan(lower) and np.isnan(generation)


def test_curves(logged: Model) -> None:
    assert logged.its_log is not None
    curves = read_curves(logged.its_log)
    assert curves["allocator"].cost.tolist() == [-30.0, -31.0]
    assert curves["allocator"].minutes.tolist() == pytest.approx([18 / 60, 41 / 60])
    assert curves["router"].n_pretraining == 1 and curves["router"].minutes[-1] == pytest.approx(47 / 60)
    assert curves["router"].generation_minutes == pytest.approx(3 / 60)


@pytest.mark.parametrize(
    "content, message",
    [
        ("epoch,level\n1,router\n", ": has no column 'n_instances'; give the its_log.csv"),
        (LOG.replace("18.0", "soon"), r", line 5: is damaged \(could not convert string to float: 'soon'\)"),
        (LOG.replace("8.0,6.0,2.0", "8.0,6.0,x"), r", line 6: is damaged \(could not convert string to float: 'x'\)"),
        (LOG + "4,router,alt", r", line 7: is damaged"),
        (LOG.replace("2,allocator,alternate,100", "2,allocator,alternate,0"), r", line 5: .* n_instances 0\)"),
        (LOG.replace("3,router", "3,other"), r", line 6: .*level 'other'"),
        (b"\xff\xfe", ": is no log of a training"),
    ],
)
def test_damaged_logs(content: str | bytes, message: str, logged: Model) -> None:
    assert logged.its_log is not None
    logged.its_log.write_bytes(content.encode() if isinstance(content, str) else content)
    for read in (lambda: phase_times(logged), lambda: read_curves(logged.folder / "its_log.csv")):
        with pytest.raises(ValueError, match=re.escape(str(logged.its_log)) + message):
            read()

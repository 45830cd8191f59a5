"""What `sb3-uav reproduce` is made of: the paper's figures as data, scales, table formats and logs of trainings."""

from __future__ import annotations

import json
import platform
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from its_logs import LOG

from sb3_uav.cli import main as cli
from sb3_uav.common import random_streams
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.evaluation.summary import gaps
from sb3_uav.reproduce import paper
from sb3_uav.reproduce.evaluator import Evaluator
from sb3_uav.reproduce.figures_3_to_7 import read_logged_curves
from sb3_uav.reproduce.methods import explanations, learned_methods, learned_pairs
from sb3_uav.reproduce.origin import Origin
from sb3_uav.reproduce.pair_training import PairTraining, TrainingError, check_complete, training_entry
from sb3_uav.reproduce.pairs import SHIPPED, UNTRAINED, Model, Models
from sb3_uav.reproduce.paper import paper_figure, paper_tables
from sb3_uav.reproduce.scales import _CPU, _PAPER, _SMOKE, MIXTURE, SCALES, Scale, Scenario, scenarios
from sb3_uav.reproduce.table_formats import Column, Table, to_csv, to_latex, to_markdown
from sb3_uav.reproduce.table_layout import _best, lay_out
from sb3_uav.reproduce.tables_1_to_4 import _phase_times, _seconds
from sb3_uav.training.its_schedule import INDEPENDENT, ITS, NO_INTENSIVE

pytest.importorskip("rl_zoo3")

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "reproduce"


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
    several = replace(_SMOKE, universal=False)
    assert [several.trained_for(Scenario(6, size)).n_tasks for size in paper.SIZES] == [80, 80, 200, 200, 200, 200]
    assert {_CPU.trained_for(scenario) for scenario in scenarios()} == {MIXTURE}
    assert [_PAPER.trained_for(Scenario(4, size)).n_tasks for size in (*paper.SIZES, 600, 1500)] == [*paper.SIZES, 500, 500]


@pytest.mark.parametrize("scale", SCALES.values(), ids=str)
def test_scales_are_complete(scale: Any) -> None:
    assert set(scale.n_instances) == {*paper.SIZES, *paper.LARGER_SIZES}
    assert set(scale.exact_sizes) | set(scale.trained_sizes) <= set(paper.SIZES)
    assert scale is _PAPER or all(0 < scale.time_limits[name] <= 60 for name in ("milp", "ortools-gls", "pyvrp"))


def test_training_entries() -> None:
    """At the paper's scale the zoo's own entry, at the others the changes of the recipe, at every level."""
    entry = training_entry(_PAPER, _PAPER.recipe, Scenario(6, 300), ITS)
    its = entry["callback"][0]["sb3_uav.training.ITSCallback"]
    assert (entry["n_envs"], entry["instances_per_epoch"], entry["learning_rate"]) == (256, 1_280_000, 1e-4)
    assert (its["n_epochs"], its["n_intensive_epochs"], its["n_continuous_epochs"]) == (100, 12, 6)
    assert entry["n_timesteps"] >= 100 * 1_280_000 * 300
    assert len(entry["callback"]) == 2
    # At the others those of two cores; Fig. 4 needs evaluations of a pair for all situations during its training.
    cpu = training_entry(_CPU, _CPU.recipe, MIXTURE, INDEPENDENT)
    its = cpu["callback"][0]["sb3_uav.training.ITSCallback"]
    assert (cpu["env_kwargs"], cpu["baseline"], len(cpu["callback"])) == ({"n_tasks": 500, "max_distance": 2.0}, "shared", 2)
    evaluation = cpu["callback"][1]["sb3_uav.training.FixedSetEvalCallback"]
    assert [6, 300, 8] in evaluation["sizes"] and len(evaluation["sizes"]) == 12 and evaluation["n_samples"] == 0
    assert (its["strategy"], its["n_pretraining_epochs"], its["router"]["lr_decay"]) == ("independent", 0, 0.9)
    assert "preset" not in cpu["policy_kwargs"] and its["warm_start"]["n_updates"] > 0
    assert _CPU.ablation is not None
    ablation = training_entry(_CPU, _CPU.ablation, Scenario(4, 80), NO_INTENSIVE)
    its = ablation["callback"][0]["sb3_uav.training.ITSCallback"]
    assert (its["warm_start"], its["n_pretraining_epochs"], its["strategy"]) == (None, 5, "no-intensive")
    assert len(ablation["callback"]) == 1
    assert training_entry(_SMOKE, _SMOKE.recipe, Scenario(4, 80), ITS)["env_kwargs"] == {"n_tasks": 8, "max_distance": 1.0}


def test_methods(tmp_path: Path) -> None:
    """DL-DRL-I is compared with the pair that is trained as long as it."""
    assert learned_methods(Models(_CPU, tmp_path)) == {
        "DL-DRL-I": INDEPENDENT,
        "DL-DRL": SHIPPED,
        "DL-DRL short": ITS,
        "Untrained": UNTRAINED,
    }
    trained = {"DL-DRL-I": INDEPENDENT, "DL-DRL": ITS, "Untrained": UNTRAINED}
    assert learned_methods(Models(_CPU, tmp_path, train_pair=True)) == trained
    assert learned_methods(Models(_CPU, tmp_path, given=tmp_path)) == learned_methods(Models(_PAPER, tmp_path)) == trained
    pairs = learned_pairs(Models(_CPU, tmp_path, training=False), [Scenario(6, 900)])
    assert {method: model.label for (_, method), model in pairs.items()} == {"DL-DRL": "universal", "Untrained": "mixture"}
    assert not any("compare these two" in note for note in explanations(Models(_PAPER, tmp_path)))


def test_instances_that_no_campaign_used() -> None:
    seeds = [value for name, value in vars(random_streams).items() if name.endswith("_SEED")]
    assert seeds.count(random_streams.REPRODUCTION_SEED) == 1
    generator = UniformGenerator(80, 4)
    found = Evaluator(_CPU, Path("unused")).instances(Scenario(4, 80), n_instances=2)
    for seed in seeds:
        others = generator(2, random_streams.keyed_generator(seed, 0, 4, 80))
        assert th.equal(found.tasks, others.tasks) == (seed == random_streams.REPRODUCTION_SEED)


def training(scale: Scale, scenario: Scenario, strategy: str) -> PairTraining:
    entry = training_entry(scale, scale.recipe, scenario, strategy)
    return PairTraining(scenario, strategy, entry, Path("runs"), Path("models"), 0, "cpu", 1)


@pytest.mark.parametrize("scale", SCALES.values(), ids=str)
def test_the_independent_router_is_trained_as_long_as_that_of_its(scale: Scale) -> None:
    """The fault: only in the epochs of pre-training, so that DL-DRL-I and K-means+AM had a router of five epochs."""
    for scenario in scenarios():
        independent, its = (training(scale, scenario, strategy).schedule for strategy in (INDEPENDENT, ITS))
        assert independent.n_router_epochs == independent.n_pretraining_epochs == its.n_router_epochs
        assert its.n_router_epochs > its.n_pretraining_epochs and independent.n_epochs == its.n_epochs
    assert training(_PAPER, Scenario(4, 80), INDEPENDENT).schedule.n_router_epochs == 5 + 8 + 92


def test_pairs_of_earlier_versions(tmp_path: Path) -> None:
    """The paper's names of the strategies mean the same; routers of DL-DRL-I that were trained too briefly are not used."""
    for strategy, old_name, fits in ((NO_INTENSIVE, "ITS/intensive", True), (INDEPENDENT, "independent", False)):
        job = replace(training(_SMOKE, Scenario(4, 80), strategy), model_folder=tmp_path / strategy)
        entry = json.loads(json.dumps(job.entry))
        entry["callback"][0]["sb3_uav.training.ITSCallback"]["strategy"] = old_name
        job.model_folder.mkdir()
        (job.model_folder / "training.json").write_text(json.dumps({"seed": 0, "entry": entry}))
        if fits:
            assert check_complete(job)
        else:
            with pytest.raises(TrainingError, match="was trained with other settings"):
                check_complete(job)


def test_tables_have_the_papers_names_of_the_strategies() -> None:
    titles = [paper.STRATEGY_TITLES[strategy] for strategy in paper.ABLATION_STRATEGIES]
    assert titles == ["ITS", "ITS/pre-training", "ITS/intensive", "ITS/pre-training&intensive"]


def test_test_instances() -> None:
    """Fewer are the first of more; seeds and scenarios differ."""
    evaluator = Evaluator(_CPU, Path("unused"))
    some, more = (evaluator.instances(Scenario(4, 80), n_instances=n) for n in (3, 5))
    assert th.equal(some.tasks, more[:3].tasks) and th.equal(some.depot, more[:3].depot)
    others = [
        Evaluator(_CPU, Path("unused"), seed=1).instances(Scenario(4, 80), n_instances=3),
        evaluator.instances(Scenario(6, 80), n_instances=3),
        evaluator.instances(Scenario(4, 80), 1234, 3),
    ]
    assert all(not th.equal(some.tasks, other.tasks) for other in others)
    assert len(evaluator.instances(Scenario(4, 80))) == _CPU.n_instances[80]
    assert float(more.max_distance[0]) == 2.0 and more.n_tasks == 80


# ------------------------------------------------------------------------------------------------------------------- tables


def test_best_of_what_is_shown() -> None:
    assert _best(["1.00", "2.00", "-", "2.00"]) == [1, 3]
    assert _best(["1.00", "2.00", "-"], smallest=True) == [0]
    # Small times are shown with more digits than others.
    assert [_seconds(time) for time in (0.0012, 0.00119, 0.2)] == ["0.0012", "0.0012", "0.20"]
    assert _best(["0.0012", "0.0038", "0.0012", "0.20"], smallest=True) == [0, 2]


def test_a_method_alone_is_not_the_best() -> None:
    """There is nothing that it is better than."""
    assert _best(["0.00", "-", "-"], smallest=True) == _best(["-", "5.00"]) == _best(["-", "-"]) == []
    columns = [*map(Column, ("Number of tasks", "Measure", "Source")), Column("Gurobi", "30"), Column("DL-DRL", "30")]
    table = Table("Table II", "Results", [*columns, Column("OR-tools", "500"), Column("DL-DRL", "500")])
    table.add(["80", "Obj.", "ours", "5.00", "-", "1.00", "2.00"])
    table.add(["80", "Gap", "ours", "0.00", "-", "50.00", "0.00"])
    table.add(["80", "Time(s)", "ours", "0.00", "-", "50.00", "0.00"])
    table.add(["100", "Obj.", "ours", "-", "-", "-", "7.00"])
    lay_out(table)
    assert table.bold == {(0, 6), (1, 6)} and table.rules == [0, 3]


def test_best_methods_of_each_fleet_and_source() -> None:
    columns = [*map(Column, ("Fleet", "Method", "Source")), Column("Obj.", "N=600"), Column("Time(s)", "N=600")]
    table = Table("Table IV", "Larger", columns)
    for cells in ("U4 a paper 1.00 9.00", "U4 a ours 3.00 8.00", "U4 b paper 2.00 7.00", "U4 b ours 2.00 6.00"):
        table.add(cells.split())
    table.add("U6 a ours 1.00 1.00".split())
    lay_out(table)
    assert table.bold == {(2, 3), (1, 3), (2, 4), (3, 4)} and table.rules == [0, 4]


def test_a_table_in_three_formats() -> None:
    table = Table("Table V", "A & B", [Column("Name"), Column("x", "all"), Column("y", "all")], notes=["50 % of a_b"])
    table.add(["one|two", "1.00", "-"])
    table.add(["R&D", "2.00", "3.00"])
    table.bold, table.rules = {(0, 1), (0, 2)}, [0, 1]
    markdown = to_markdown(table, ["Seed: 1"])
    assert markdown.startswith("# Table V: A & B\n")
    assert "| Name | all: x | all: y |\n| --- | ---: | ---: |\n| one\\|two | **1.00** | **-** |\n" in markdown
    assert "- 50 % of a_b" in markdown and "- Seed: 1" in markdown
    latex = to_latex(table, ["Seed: 1"])
    assert latex.startswith("% Seed: 1\n") and r"\multicolumn{2}{c}{all}" in latex and r"\cmidrule(lr){2-3}" in latex
    assert r"\begin{tabular}{lrr}" in latex and "R\\&D & 2.00 & 3.00 \\\\" in latex and r"50 \% of a\_b" in latex
    assert latex.count(r"\midrule") == 2 and latex.count("{") == latex.count("}")
    assert to_csv(table, ["Seed: 1"]).splitlines()[-3:] == ["Name,all: x,all: y", "one|two,1.00,", "R&D,2.00,3.00"]
    with pytest.raises(ValueError, match="2 cells, the table 3 columns"):
        table.add(["too", "few"])


def test_captions_do_not_print_the_number_twice() -> None:
    """LaTeX writes "Table 1: " before a caption by itself."""
    latex = to_latex(Table("Table II", "Results", [Column("a")], [["1"]]), [])
    assert r"\caption{Results}" in latex and "Table II" not in latex


# ---------------------------------------------------------------------------------------------------------- written again


@pytest.fixture
def committed(tmp_path: Path) -> Path:
    """A copy of the results in the repository, without what can be made from the CSV files."""
    for path in RESULTS.glob("*.csv"):
        shutil.copyfile(path, tmp_path / path.name)
    return tmp_path


def test_committed_files_are_what_the_command_writes(committed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """But for the pictures, which depend on the version of matplotlib."""
    assert cli.main(["reproduce", "all", "--redraw", "--out", str(committed)]) == 0
    written = {path.name for path in committed.iterdir()}
    printed = {Path(line).name for line in capsys.readouterr().out.splitlines()}
    assert written == {path.name for path in RESULTS.iterdir()} == printed
    for path in RESULTS.iterdir():
        if path.suffix in (".md", ".tex", ".csv"):
            assert (committed / path.name).read_text() == path.read_text(), path.name
        else:
            found, expected = ((folder / path.name).stat().st_size for folder in (committed, RESULTS))
            assert found == pytest.approx(expected, rel=0.3), path.name


def test_pictures_of_the_same_data_are_equal(committed: Path) -> None:
    """They hold no time, so that only what changed is written to the repository."""
    contents = []
    for _ in range(2):
        assert cli.main(["reproduce", "fig5", "--redraw", "--out", str(committed)]) == 0
        contents.append([(committed / f"fig5{suffix}").read_bytes() for suffix in (".png", ".pdf")])
    assert contents[0] == contents[1]


def test_pictures_say_where_they_come_from_without_the_name_of_the_machine() -> None:
    origin = Origin.of("sb3-uav reproduce fig5", _CPU, 3)
    (machine,) = (line for line in origin.lines if line.startswith("Machine: "))
    assert re.fullmatch(r"Machine: \w+ \w+, \d+ CPUs", machine)
    assert platform.release() not in " ".join(origin.lines) and platform.node() not in machine
    assert origin.metadata(".png")["Description"] == origin.metadata(".pdf")["Subject"] == " | ".join(origin.lines)
    assert origin.footer() == "sb3-uav reproduce, scale cpu, seed 3"
    assert Origin.read([*origin.lines, "a note"]) == (origin, ["a note"])


@pytest.mark.parametrize(
    "content, message",
    [
        ("", "is no table that `sb3-uav reproduce` wrote"),
        ("a,b\n1,2\n", "is no table that `sb3-uav reproduce` wrote"),
        ("# Fig. 6: x\na,b\n1\n", "1 cells, the table 2 columns"),
        ("# Fig. 6: x\n# y\na,b\n1,2\n", "its comments do not begin with Command, Scale, Seed"),
    ],
)
def test_damaged_csv_files(content: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "fig6.csv").write_text(content)
    assert cli.main(["reproduce", "fig6", "--redraw", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert f"{tmp_path / 'fig6.csv'}: " in error and message in error


def test_nothing_to_redraw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["reproduce", "fig6", "--redraw", "--out", str(tmp_path)]) == 2
    assert "holds no CSV of fig6; give a folder" in capsys.readouterr().err


# --------------------------------------------------------------------------------------------------------- logs of trainings


@pytest.fixture
def logged(tmp_path: Path) -> Model:
    (tmp_path / "its_log.csv").write_text(LOG)
    return Model(Scenario(4, 80), ITS, tmp_path, "U4-80")


def test_phase_times(logged: Model) -> None:
    """Per instance, without the first epoch and without the router's instances in its own time."""
    assert _phase_times(logged) == pytest.approx((0.18, 4 / 50, 2 / 50, 100))
    # What earlier versions wrote does not tell them apart.
    lines = [line.rpartition(",")[0] for line in LOG.splitlines()]
    (logged.folder / "its_log.csv").write_text("\n".join(lines) + "\n")
    upper, lower, generation, _ = _phase_times(logged)
    assert upper == pytest.approx(0.18) and np.isnan(lower) and np.isnan(generation)


def test_curves(logged: Model) -> None:
    assert logged.its_log is not None
    curves = read_logged_curves(logged.its_log)
    assert curves["allocator"].cost.tolist() == [-30.0, -31.0]
    assert curves["allocator"].minutes.tolist() == pytest.approx([18 / 60, 41 / 60])
    assert curves["router"].phase.count("pre-training") == 1 and curves["router"].minutes[-1] == pytest.approx(47 / 60)
    assert curves["router"].generation_minutes == pytest.approx(3 / 60)


def test_curves_have_cpu_times(logged: Model) -> None:
    """Wall times are those of a machine that may be busy; old logs have no others."""
    assert logged.its_log is not None
    header, *lines = LOG.splitlines()
    logged.its_log.write_text("\n".join([f"{header},cpu_seconds", *(f"{line},3.0" for line in lines)]) + "\n")
    assert read_logged_curves(logged.its_log)["allocator"].minutes.tolist() == pytest.approx([6 / 60, 12 / 60])


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
    for read in (lambda: _phase_times(logged), lambda: read_logged_curves(logged.folder / "its_log.csv")):
        with pytest.raises(ValueError, match=re.escape(str(logged.its_log)) + message):
            read()

"""`sb3-uav reproduce`: the files that the ten commands write at the smallest scale."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest
import torch as th
from its_logs import LOG
from PIL import Image

from sb3_uav.cli import main as cli
from sb3_uav.evaluation.summary import gaps
from sb3_uav.policies.loading import load_policy
from sb3_uav.reproduce.output_files import COMPANIONS
from sb3_uav.reproduce.paper import (
    EXACT_COLUMNS,
    FULL_COLUMNS,
    LARGER_METHODS,
    LARGER_SIZES,
    MEASURES,
    PHASES,
    SIZES,
    paper_figure,
)
from sb3_uav.reproduce.scales import _SMOKE, SCALES, scenarios
from sb3_uav.reproduce.targets import TARGETS

pytest.importorskip("rl_zoo3")


def read_table(path: Path) -> tuple[list[str], list[dict[str, str]], list[str]]:
    """Columns, rows and comments of a CSV of ours."""
    lines = path.read_text().splitlines(keepends=True)
    comments = [line for line in lines if line.startswith("#")]
    reader = csv.DictReader(io.StringIO("".join(lines[len(comments) :])))
    rows = list(reader)
    assert all(None not in row and None not in row.values() for row in rows)
    return list(reader.fieldnames or ()), rows, comments


def numbers(row: dict[str, str], *columns: str) -> list[float]:
    return [float(row[column]) for column in columns]


# ------------------------------------------------------------------------------------------------------------ all ten of them


def run(*arguments: str | Path) -> int:
    return cli.main(["reproduce", *map(str, arguments), "--num-threads", "1"])


def given_pair(models: Path, log: str, folder: str = "U4-N80/ITS") -> None:
    """What is looked for in a folder of --models; the zips need not be any as long as none is loaded."""
    for name, text in (("allocator.zip", ""), ("router.zip", ""), ("its_log.csv", log)):
        (models / folder).mkdir(parents=True, exist_ok=True)
        (models / folder / name).write_text(text)


def test_table1_of_own_pairs(tmp_path: Path) -> None:
    """Also at the scale that has trainings of its own for it."""
    given_pair(tmp_path / "mine", LOG)
    arguments = ("--scale", "cpu", "--models", tmp_path / "mine", "--no-training", "--out", tmp_path / "out")
    assert run("table1", *arguments) == 0
    _, rows, comments = read_table(tmp_path / "out" / "table1.csv")
    (measured,) = [row for row in rows if row[f"{PHASES[0]}: ours"]]
    assert measured["Situation"] == "U4-80" and float(measured[f"{PHASES[0]}: ours"]) > 0
    assert any("given pairs (--models): U4-80." in comment for comment in comments)
    assert not any("Our runs have the paper's networks" in comment for comment in comments)


def test_fig5_without_the_upper_level(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = "".join(line for line in LOG.splitlines(keepends=True) if "allocator" not in line)
    given_pair(tmp_path / "mine", log)
    assert run("fig5", "--models", tmp_path / "mine", "--no-training", "--out", tmp_path / "out") == 2
    assert "U4-N80/ITS/its_log.csv: has no epochs of the allocator" in capsys.readouterr().err


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `sb3-uav reproduce all` writes."""
    folder = tmp_path_factory.mktemp("reproduction")
    assert run("all", "--scale", "smoke", "--out", folder) == 0
    return folder


@pytest.fixture
def threads() -> Iterator[None]:
    yield
    th.set_num_threads(1)


@pytest.mark.slow
def test_every_file_says_where_it_comes_from(out: Path) -> None:
    for name in (*TARGETS, *COMPANIONS["claims"]):
        for suffix in (".md", ".tex", ".csv"):
            text = (out / f"{name}{suffix}").read_text()
            for part in ("sb3-uav reproduce all --scale smoke", "Seed: 0", "Scale: smoke", "torch 2.", "X. Mao"):
                assert part in text, (name, suffix, part)
            assert "cannot be compared with the paper's" in text, (name, suffix)


@pytest.mark.slow
def test_pictures_have_content(out: Path) -> None:
    for name in ("fig3", "fig4", "fig5", "fig6", "fig7"):
        picture = matplotlib.image.imread(out / f"{name}.png")[..., :3]
        assert picture.shape[0] > 500 and picture.shape[1] > 1000, name
        # Colored lines, not an empty frame.
        assert ((picture.max(-1) - picture.min(-1)) > 0.3).mean() > 0.001, name
        with Image.open(out / f"{name}.png") as image:
            assert "Seed: 0" in image.info["Description"], name
        assert (out / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    assert not list(out.glob("*.tmp"))


@pytest.mark.slow
def test_table1(out: Path) -> None:
    columns, rows, _ = read_table(out / "table1.csv")
    assert columns == ["Situation", *(f"{phase}: {source}" for phase in PHASES for source in ("paper", "ours"))]
    assert [row["Situation"] for row in rows] == [scenario.name for scenario in scenarios()]
    for row in rows:
        for phase in PHASES:
            assert float(row[f"{phase}: paper"]) == paper_figure("table1", row["Situation"], phase)
            ours = row[f"{phase}: ours"]
            assert (ours != "") == (row["Situation"].split("-")[1] in ("80", "200"))
            assert ours == "" or float(ours) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table2", "table3"])
def test_tables2_and_3(name: str, out: Path) -> None:
    columns, rows, comments = read_table(out / f"{name}.csv")
    exact, printed, further = (
        [f"{block}: {m}" for m in methods]
        for block, methods in (
            ("30 instances", EXACT_COLUMNS),
            ("500 instances", FULL_COLUMNS),
            ("500 instances", [f"{m} ({d})" for m in ("DL-DRL short", "Untrained") for d in ("Greedy", "Sampling")]),
        )
    )
    full = [*printed, *further]
    assert columns == ["Number of tasks", "Measure", "Source", *exact, *full]
    keys = [(row["Number of tasks"], row["Measure"], row["Source"]) for row in rows]
    assert keys == [(str(n), measure, source) for n in SIZES for measure in MEASURES for source in ("paper", "ours")]
    cells = {key: row for key, row in zip(keys, rows, strict=True)}
    for (size, measure, source), row in cells.items():
        if source == "paper":
            for column in (*exact, *printed):
                assert float(row[column]) == paper_figure(name, size, *column.split(": "), MEASURES[measure])
            assert all(row[column] == "" for column in further)
    always = [column for column in full if "OR-tools" not in column]
    for size in map(str, SIZES):
        n_tasks = int(size) // 10
        assert all(0 <= value <= n_tasks for value in numbers(cells[size, "Obj.", "ours"], *always, *exact[1:]))
        assert all(value > 0 for value in numbers(cells[size, "Time(s)", "ours"], *always, *exact[1:]))
        for block in (exact, full):
            objectives, shown = cells[size, "Obj.", "ours"], cells[size, "Gap", "ours"]
            known = [column for column in block if objectives[column]]
            assert [column for column in block if shown[column]] == known
            assert numbers(shown, *known) == pytest.approx(gaps(numbers(objectives, *known)), abs=0.1)
    # What the scale leaves out has no figure of ours, and is named.
    assert all(cells[size, "Obj.", "ours"][exact[0]] == "" for size in map(str, SIZES[1:]))
    assert "# The exact solver does not run with 100, 150, 200, 300, 500 tasks at scale smoke.\n" in comments
    # Sampling keeps the best of what it draws, but need not beat greedy; the best of each block stands out.
    assert "**0.00**" in (out / f"{name}.md").read_text() and r"\textbf{0.00}" in (out / f"{name}.tex").read_text()


@pytest.mark.slow
def test_table4(out: Path) -> None:
    columns, rows, _ = read_table(out / "table4.csv")
    assert columns[:3] == ["Fleet", "Method", "Source"]
    assert columns[3:] == [f"N={size}: {measure}" for size in LARGER_SIZES for measure in ("Obj.", "Time(s)")]
    keys = [(row["Fleet"], row["Method"], row["Source"]) for row in rows]
    methods = [(m, s) for m in LARGER_METHODS for s in ("paper", "ours")]
    methods += [("DL-DRL short", "ours"), ("Untrained", "ours")]
    assert keys == [(fleet, method, source) for fleet in ("U4", "U6") for method, source in methods]
    for (fleet, method, source), row in zip(keys, rows, strict=True):
        for size in LARGER_SIZES:
            objective = row[f"N={size}: Obj."]
            if source == "paper":
                printed = paper_figure("table4", fleet, str(size), method, "objective")
                assert objective == ("" if printed is None else f"{printed:.2f}")
            elif method != "OR-tools":
                assert 0 <= float(objective) <= size // 10 and float(row[f"N={size}: Time(s)"]) > 0


@pytest.mark.slow
def test_fig3(out: Path) -> None:
    _, rows, _ = read_table(out / "fig3.csv")
    assert [row["Situation"] for row in rows] == [scenario.name for scenario in scenarios()]
    for row in rows:
        n_uavs, n_tasks = (int(number) for number in row["Situation"][1:].split("-"))
        counts = [int(count) for count in row["Tasks by UAV"].split()]
        assert int(row["Tasks"]) == n_tasks // 10 and sum(counts) == int(row["Visited"]) <= n_tasks // 10
        assert len(counts) <= n_uavs and float(row["Total length"]) <= n_uavs * _SMOKE.max_distance


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, trainings, log",
    [
        ("fig4", ["mixture", *(scenario.name for scenario in scenarios())], "models/mixture/ITS"),
        ("fig5", ["ITS", "ITS/pre-training", "ITS/intensive", "ITS/pre-training&intensive"], "ablation/U4-N80/ITS/seed1"),
    ],
)
def test_curves_of_every_epoch(name: str, trainings: list[str], log: str, out: Path) -> None:
    """Those of the logs, with the opposite sign; in Fig. 5 of two seeds."""
    _, rows, _ = read_table(out / f"{name}_curves.csv")
    assert list(dict.fromkeys(row["Training"] for row in rows)) == trainings
    seeds = ("0", "1") if name == "fig5" else (None,)
    for training in trainings:
        for seed in seeds:
            of_seed = [row for row in rows if (row["Training"], row.get("Seed")) == (training, seed)]
            upper = [row for row in of_seed if row["Level"] == "Upper level"]
            # The evaluations of the situations begin before the first epoch.
            assert [int(row["Epoch"]) for row in upper] == [0, 1, 2, 3, 4][upper[0]["Phase"] != "evaluation" :]
            assert all(float(row["Cost"]) <= 0 for row in upper) and float(upper[-1]["Minutes"]) > 0
    with (out / log / "its_log.csv").open() as file:
        logged = [-float(row["objective"]) for row in csv.DictReader(file) if row["level"] == "allocator"]
    mine = [r for r in rows if (r["Training"], r.get("Seed")) == (trainings[0], seeds[-1])]
    drawn = [float(row["Cost"]) for row in mine if row["Level"] == "Upper level"]
    assert drawn == pytest.approx(logged, abs=1e-4)
    if name == "fig4":
        with (out / log / "size_grid.csv").open() as file:
            evaluated = [-float(row["U6-N20"]) for row in csv.DictReader(file)]
        assert [float(row["Cost"]) for row in rows if row["Training"] == "U6-200"] == pytest.approx(evaluated, abs=1e-4)


@pytest.mark.slow
def test_routers_of_both_strategies_have_as_many_epochs(out: Path) -> None:
    """DL-DRL-I trains its router as long as DL-DRL short, before the allocator's first epoch."""
    phases = {}
    for strategy in ("ITS", "independent"):
        with (out / f"models/mixture/{strategy}/its_log.csv").open() as file:
            phases[strategy] = [row["phase"] for row in csv.DictReader(file) if row["level"] == "router"]
    assert len(phases["ITS"]) == len(phases["independent"]) == 2 + 2
    assert set(phases["independent"]) == {"pre-training"} != set(phases["ITS"])


@pytest.mark.slow
def test_fig5_leaves_out_what_it_says(out: Path) -> None:
    _, rows, _ = read_table(out / "fig5_curves.csv")
    phases: dict[str, set[str]] = {}
    for row in rows:
        phases.setdefault(row["Training"], set()).add(row["Phase"])
    assert phases == {
        "ITS": {"pre-training", "intensive", "alternate"},
        "ITS/pre-training": {"intensive", "alternate"},
        "ITS/intensive": {"pre-training", "alternate"},
        "ITS/pre-training&intensive": {"alternate"},
    }


@pytest.mark.slow
def test_without_the_shipped_pair(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(out / "models", tmp_path / "models")
    assert run("fig7", "--train-pair", "--scale", "smoke", "--solvers", "kmeans-am", "--out", tmp_path) == 0
    _, rows, comments = read_table(tmp_path / "fig7.csv")
    assert [row["Method"] for row in rows] == ["mixture", "K-means+AM", "DL-DRL-I", "Untrained"]
    assert any(comment.startswith("# mixture: DL-DRL.") for comment in comments)
    assert "K-means+AM mixture on U6-N80" in capsys.readouterr().err and not (tmp_path / "training").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name, fleet", [("fig6", "U4"), ("fig7", "U6")])
def test_figs6_and_7(name: str, fleet: str, out: Path) -> None:
    columns, rows, _ = read_table(out / f"{name}.csv")
    assert columns == ["Method", *(f"N-{size}" for size in SIZES)]
    pairs = ["universal", "mixture", "U4-80"] if fleet == "U4" else ["universal", "mixture"]
    assert [row["Method"] for row in rows] == [*pairs, "K-means+VND", "K-means+AM", "DL-DRL-I", "Untrained"]
    for row in rows:
        assert all(0 <= value <= size // 10 for size, value in zip(SIZES, numbers(row, *columns[1:]), strict=True))
    # The same results as in the table.
    _, table, _ = read_table(out / f"{'table2' if fleet == 'U4' else 'table3'}.csv")
    ours = {r["Number of tasks"]: r for r in table if r["Measure"] == "Obj." and r["Source"] == "ours"}
    assert rows[0]["N-80"] == ours["80"]["500 instances: DL-DRL (Sampling)"]
    assert rows[1]["N-500"] == ours["500"]["500 instances: DL-DRL short (Sampling)"]
    assert rows[-1]["N-300"] == ours["300"]["500 instances: Untrained (Sampling)"]


@pytest.mark.slow
def test_claims(out: Path) -> None:
    """The differences of the tables, and ratios of their cells."""
    _, verdicts, _ = read_table(out / "claims.csv")
    _, comparisons, _ = read_table(out / "claims_comparisons.csv")
    _, ratios, _ = read_table(out / "claims_ratios.csv")
    _, table, _ = read_table(out / "table3.csv")
    (cells,) = (r for r in table if (r["Number of tasks"], r["Measure"], r["Source"]) == ("300", "Obj.", "ours"))
    independent, vnd, ortools = (float(cells[f"500 instances: {m}"]) for m in ("DL-DRL-I (Greedy)", "K-means+VND", "OR-tools"))
    text = "DL-DRL-I (Greedy) visits more tasks than K-means+VND"
    (compared,) = (r for r in comparisons if r["Claim"] == text and r["Comparison"] == "U6-300")
    assert float(compared["Difference"]) == pytest.approx(independent - vnd, abs=0.011) and compared["n"] == "2"
    assert float(compared["Low"]) <= float(compared["Difference"]) <= float(compared["High"])
    (verdict,) = (r for r in verdicts if (r["Where"], r["Claim"]) == ("Table III", text))
    assert sum(int(verdict[side]) for side in ("For", "Open", "Against")) == 6
    assert verdict["Verdict"] in ("holds", "not decided", "does not hold")
    (ratio,) = (r for r in ratios if (r["Situation"], r["Method"]) == ("U6-300", "K-means+VND"))
    assert float(ratio["Ours"]) == pytest.approx(vnd / ortools, abs=0.002) and float(ratio["Paper"]) == 0.64
    assert not any(r["Verdict"] == "no data" for r in verdicts if r["Where"] != "Fig. 7")


@pytest.mark.slow
def test_pairs_before_training(out: Path) -> None:
    """Those of the recipe, which the trained ones of the same seed are not any more."""
    for level in ("allocator", "router"):
        new, trained = (load_policy(out / f"models/mixture/{name}/{level}.zip") for name in ("untrained-seed0", "ITS"))
        parameters = new.state_dict()
        assert parameters.keys() == trained.state_dict().keys()
        assert any(not th.equal(value, parameters[key]) for key, value in trained.state_dict().items())


@pytest.mark.slow
def test_one_pair_for_every_situation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The structure of scale paper: no shipped pair, and Fig. 5 shares its training with the tables."""
    assert _SMOKE.ablation is not None
    scale = replace(_SMOKE, universal=False, trained_sizes=(80,), recipe=_SMOKE.ablation, ablation=None, timing=None)
    monkeypatch.setitem(SCALES, "smoke", scale)
    assert run("table1", "fig5", "fig6", "--solvers", "kmeans-am", "--scale", "smoke", "--out", tmp_path) == 0
    _, rows, _ = read_table(tmp_path / "fig6.csv")
    assert [row["Method"] for row in rows] == ["U4-80", "K-means+AM", "DL-DRL-I", "Untrained"]
    assert all(0 <= float(row["N-500"]) <= 50 for row in rows)
    trained = {path.parent.relative_to(tmp_path).as_posix() for path in tmp_path.glob("models/*/*/training.json")}
    strategies = ("ITS", "ITS-without-pre-training", "ITS-without-intensive", "ITS-without-both", "independent")
    assert trained == {*(f"models/U4-N80/{strategy}" for strategy in strategies), "models/U6-N80/ITS"}
    _, rows, _ = read_table(tmp_path / "fig5.csv")
    assert [row["Seed"] for row in rows] == ["0"] * 4


@pytest.mark.slow
def test_the_second_time_nothing_is_done_again(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = [
        *(out / "models").rglob("*/its_log.csv"),
        *(out / "ablation").rglob("*"),
        *(out / "evaluations").rglob("results.csv"),
    ]
    before = {path: path.read_bytes() for path in kept if path.is_file()}
    assert run("table2", "fig5", "--scale", "smoke", "--out", out) == 0
    assert {path: path.read_bytes() for path in before} == before
    text = capsys.readouterr()
    assert "training" not in text.err and "2 of them done before" in text.err
    assert text.out.splitlines()[0] == str(out / "table2.md")


@pytest.mark.slow
def test_own_pairs(out: Path, tmp_path: Path, threads: None, capsys: pytest.CaptureFixture[str]) -> None:
    """One pair for a scenario, one for all sizes of another fleet, and nothing else."""
    models = tmp_path / "mine"
    shutil.copytree(out / "ablation/U4-N80/ITS/seed0", models / "U4-N80/ITS")
    shutil.copytree(out / "models/mixture/ITS", models / "U6/ITS")
    results = tmp_path / "results"
    assert run("fig3", "fig7", "--scale", "smoke", "--models", models, "--no-training", "--solvers", "--out", results) == 0
    _, rows, comments = read_table(results / "fig3.csv")
    situations = [row["Situation"] for row in rows]
    assert situations == ["U4-80", *(scenario.name for scenario in scenarios() if scenario.n_uavs == 6)]
    assert any("There is no pair for U4-500, and --no-training forbids training one" in comment for comment in comments)
    _, rows, comments = read_table(results / "fig7.csv")
    assert [row["Method"] for row in rows] == ["U6", "Untrained"]
    assert any("K-means+VND was not requested" in comment for comment in comments)
    assert not (results / "training").exists() and "training 1" not in capsys.readouterr().err
    (models / "U4-N80/ITS/router.zip").unlink()
    assert run("fig3", "--scale", "smoke", "--models", models, "--no-training", "--out", results) == 2
    assert "router.zip: no such file; --models needs both zips of a pair" in capsys.readouterr().err


@pytest.mark.slow
def test_a_license_that_is_too_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The solver is left out of the table, which says why."""

    def no_license(spec: str, **_: Any) -> Any:
        raise ValueError(f"{spec}: no license")

    monkeypatch.setattr("sb3_uav.reproduce.evaluator.make_solver", no_license)
    arguments = ("--scale", "smoke", "--no-training", "--solvers", "milp", "--exact-backend", "gurobi", "--out", tmp_path)
    assert run("table2", *arguments) == 0
    _, rows, comments = read_table(tmp_path / "table2.csv")
    assert {row["30 instances: Gurobi (1800s)"] for row in rows if row["Source"] == "ours"} == {""}
    (failure,) = (comment for comment in comments if comment.startswith("# milp with gurobi (1 s) failed on 2 of 2 instances"))
    assert "milp:time_limit=1,backend=gurobi: no license" in failure and "solved by gurobi" in "".join(comments)
    # The others are not.
    assert all(float(row["30 instances: DL-DRL (Greedy)"]) > 0 for row in rows if row["Measure"] == "Obj.")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["table1", "--models", "nowhere"], "--models nowhere: no such folder; give one that holds U4-N80/ITS/allocator.zip"),
        (["table1", "--solvers", "gurobi"], "--solvers: 'gurobi' is not one of ["),
        (["table1", "--solvers", "dl-drl"], "trained pairs are always included"),
        (["table1", "--solvers", "kmeans-am", "kmeans-am"], "names 'kmeans-am' twice"),
        (["table1", "--jobs", "0"], "--jobs is 0; it must be at least 1"),
        (["table1", "--seed", "-1"], "--seed is -1; it must be at least 0"),
    ],
)
def test_wrong_arguments(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*arguments, "--out", tmp_path / "out") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_unknown_target(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        run("table5")
    assert error.value.code == 2 and "invalid choice: 'table5'" in capsys.readouterr().err

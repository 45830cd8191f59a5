"""`sb3-uav reproduce`: the files that the nine commands write at the smallest scale."""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.image
import pytest
import torch as th
from its_logs import LOG
from PIL import Image

from sb3_uav.cli import main as cli
from sb3_uav.evaluation.summary import gaps
from sb3_uav.policies.loading import load_policy
from sb3_uav.reproduce.pair_training import PairTraining, TrainingError, train_pair, training_entry
from sb3_uav.reproduce.pairs import Models
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
from sb3_uav.reproduce.scales import _SMOKE, Scenario, scenarios
from sb3_uav.reproduce.targets import TARGETS
from sb3_uav.reproduce.training_processes import _train_in_process, _TrainingProcess, train_pairs
from sb3_uav.training.its_checkpoint import read_state, write_checkpoint
from sb3_uav.training.its_schedule import INDEPENDENT, ITS

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


# ------------------------------------------------------------------------------------------------------------ all nine of them


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
    for name in TARGETS:
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
    exact, full = (
        [f"{block}: {m}" for m in methods]
        for block, methods in (("30 instances", EXACT_COLUMNS), ("500 instances", FULL_COLUMNS))
    )
    assert columns == ["Number of tasks", "Measure", "Source", *exact, *full]
    keys = [(row["Number of tasks"], row["Measure"], row["Source"]) for row in rows]
    assert keys == [(str(n), measure, source) for n in SIZES for measure in MEASURES for source in ("paper", "ours")]
    cells = {key: row for key, row in zip(keys, rows, strict=True)}
    for (size, measure, source), row in cells.items():
        if source == "paper":
            for column in (*exact, *full):
                assert float(row[column]) == paper_figure(name, size, *column.split(": "), MEASURES[measure])
    always = [column for column in full if "DL-DRL" in column or "K-means" in column]
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
    assert keys == [(f, m, s) for f in ("U4", "U6") for m in LARGER_METHODS for s in ("paper", "ours")]
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
@pytest.mark.parametrize("name, n_trainings", [("fig4", 4), ("fig5", 4)])
def test_curves_of_every_epoch(name: str, n_trainings: int, out: Path) -> None:
    """Those of the logs, with the opposite sign."""
    _, rows, _ = read_table(out / f"{name}_curves.csv")
    trainings = list(dict.fromkeys(row["Training"] for row in rows))
    assert len(trainings) == n_trainings
    for training in trainings:
        upper = [row for row in rows if row["Training"] == training and row["Level"] == "Upper level"]
        assert [int(row["Epoch"]) for row in upper] == [1, 2, 3, 4]
        assert all(float(row["Cost"]) <= 0 for row in upper)
        assert float(upper[-1]["Minutes"]) > 0
    with (out / "models/U4-N80/ITS/its_log.csv").open() as file:
        logged = [-float(row["objective"]) for row in csv.DictReader(file) if row["level"] == "allocator"]
    drawn = [float(r["Cost"]) for r in rows if r["Training"] in ("U4-80", "ITS") and r["Level"] == "Upper level"]
    assert drawn == pytest.approx(logged, abs=1e-4)


@pytest.mark.slow
def test_routers_of_both_strategies_have_as_many_epochs(out: Path) -> None:
    """DL-DRL-I trains its router as long as DL-DRL, before the allocator's first epoch."""
    phases = {}
    for strategy in ("ITS", "independent"):
        with (out / f"models/U4-N80/{strategy}/its_log.csv").open() as file:
            phases[strategy] = [row["phase"] for row in csv.DictReader(file) if row["level"] == "router"]
    assert len(phases["ITS"]) == len(phases["independent"]) == 1 + 2 + 2
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
@pytest.mark.parametrize("name, fleet", [("fig6", "U4"), ("fig7", "U6")])
def test_figs6_and_7(name: str, fleet: str, out: Path) -> None:
    columns, rows, _ = read_table(out / f"{name}.csv")
    assert columns == ["Method", *(f"N-{size}" for size in SIZES)]
    assert [row["Method"] for row in rows] == [f"{fleet}-80", f"{fleet}-200", "K-means+VND", "K-means+AM", "DL-DRL-I"]
    for row in rows:
        assert all(0 <= value <= size // 10 for size, value in zip(SIZES, numbers(row, *columns[1:]), strict=True))
    # The same results as in the table.
    _, table, _ = read_table(out / f"{'table2' if fleet == 'U4' else 'table3'}.csv")
    sampling = {
        r["Number of tasks"]: r["500 instances: DL-DRL (Sampling)"]
        for r in table
        if r["Measure"] == "Obj." and r["Source"] == "ours"
    }
    assert rows[0]["N-80"] == sampling["80"] and rows[1]["N-500"] == sampling["500"]


@pytest.mark.slow
def test_the_second_time_nothing_is_done_again(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = [*(out / "models").rglob("*"), *(out / "evaluations").rglob("results.csv")]
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
    shutil.copytree(out / "models/U4-N80/ITS", models / "U4-N80/ITS")
    shutil.copytree(out / "models/U6-N200/ITS", models / "U6/ITS")
    results = tmp_path / "results"
    assert run("fig3", "fig7", "--scale", "smoke", "--models", models, "--no-training", "--solvers", "--out", results) == 0
    _, rows, comments = read_table(results / "fig3.csv")
    situations = [row["Situation"] for row in rows]
    assert situations == ["U4-80", "U4-100", *(scenario.name for scenario in scenarios() if scenario.n_uavs == 6)]
    assert any("There is no pair for U4-500, and --no-training forbids training one" in comment for comment in comments)
    _, rows, comments = read_table(results / "fig7.csv")
    assert [row["Method"] for row in rows] == ["U6"]
    assert any("K-means+VND was not requested" in comment for comment in comments)
    assert not (results / "models").exists() and "training 1" not in capsys.readouterr().err
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
    expected = "# U4-80: milp with gurobi (1 s): milp:time_limit=1,backend=gurobi: no license\n"
    assert expected in comments and "solved by gurobi" in "".join(comments)


def job(folder: Path, strategy: str = ITS, **its: Any) -> PairTraining:
    entry = training_entry(_SMOKE, _SMOKE.recipe, Scenario(4, 80), strategy)
    entry["callback"][0]["sb3_uav.training.ITSCallback"].update(its)
    return PairTraining(Scenario(4, 80), strategy, entry, folder / "training", folder / "models" / strategy, 0, "cpu", 1)


@pytest.mark.slow
def test_an_interrupted_training_goes_on(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: None) -> None:
    """With the same result as if it had not been interrupted."""

    def interrupted(folder: Path, *args: Any) -> None:
        write_checkpoint(folder, *args)
        if read_state(folder)["epoch"] == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sb3_uav.training.its.write_checkpoint", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train_pair(job(tmp_path))
    assert not (tmp_path / "models").exists()
    with pytest.raises(TrainingError, match="holds an unfinished training with other settings; delete it"):
        train_pair(job(tmp_path, n_epochs=5))
    train_pair(job(tmp_path))
    for name in ("allocator.zip", "router.zip"):
        resumed, unbroken = load_policy(tmp_path / "models/its" / name), load_policy(out / "models/U4-N80/ITS" / name)
        assert all(th.equal(value, resumed.state_dict()[key]) for key, value in unbroken.state_dict().items()), name
    columns = ("epoch", "level", "phase", "n_instances", "objective")
    logs = []
    for path in (tmp_path / "models/its/its_log.csv", out / "models/U4-N80/ITS/its_log.csv"):
        with path.open() as file:
            logs.append([[row[column] for column in columns] for row in csv.DictReader(file)])
    assert logs[0] == logs[1]
    about = json.loads((tmp_path / "models/its/training.json").read_text())
    assert about["strategy"] == ITS and about["seed"] == 0 and "torch" in about["versions"]


@pytest.mark.slow
def test_trainings_in_parallel(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jobs = [job(tmp_path / str(index), strategy, n_epochs=1) for index, strategy in enumerate((ITS, INDEPENDENT))]
    train_pairs(jobs, 2)
    assert all((j.model_folder / "allocator.zip").is_file() and (j.model_folder / "its_log.csv").is_file() for j in jobs)
    assert "2 trainings, 2 at once: U4-80, independent: allocator epoch 1 of 1" in capsys.readouterr().err


@pytest.mark.slow
def test_a_failed_training_says_where_to_look(tmp_path: Path) -> None:
    broken = job(tmp_path)
    broken.entry["learning_rat"] = 1.0
    with pytest.raises(TrainingError, match=r"Training U4-80, its failed: .*did you mean 'learning_rate'.*output\.txt"):
        train_pair(broken)


@pytest.mark.slow
def test_a_failed_process_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = job(tmp_path)
    broken.entry["learning_rat"] = 1.0
    over = SimpleNamespace(join=lambda: None, exitcode=1)
    receiver, sender = multiprocessing.Pipe(duplex=False)
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(signal, "signal", lambda *_: None)
        _train_in_process(broken, sender)
    with pytest.raises(TrainingError, match=r"failed: .*did you mean 'learning_rate'"):
        _TrainingProcess(broken, over, receiver).check()  # type: ignore[arg-type]
    sender.close()
    with pytest.raises(TrainingError, match="U4-80, its failed: its process died; was it out of memory"):
        _TrainingProcess(broken, over, receiver).check()  # type: ignore[arg-type]


@pytest.mark.slow
def test_pairs_of_other_settings_are_not_used(out: Path, tmp_path: Path) -> None:
    shutil.copytree(out / "models/U4-N80/ITS", tmp_path / "models/U4-N80/ITS")
    with pytest.raises(TrainingError, match="was trained with other settings or another seed; delete it"):
        Models(_SMOKE, tmp_path, seed=1).get([(Scenario(4, 80), ITS)])
    (tmp_path / "models/U4-N80/ITS/training.json").write_text("{")
    with pytest.raises(TrainingError, match=r"training\.json: is damaged"):
        Models(_SMOKE, tmp_path).get([(Scenario(4, 80), ITS)])


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

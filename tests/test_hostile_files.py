"""Kinds of damaged and hostile files that the fuzz run found, one test for each."""

from __future__ import annotations

import io
import json
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_uav.common.errors import run_command
from sb3_uav.common.imports import import_object
from sb3_uav.common.json_text import parse_json
from sb3_uav.common.npz import read_npz
from sb3_uav.common.saved_tensors import load_tensors
from sb3_uav.envs import UniformGenerator
from sb3_uav.evaluation import evaluate
from sb3_uav.plots.learning_curves import plot_learning_curves
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.solvers import make_solver


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_an_npz_that_grows_a_thousandfold_is_refused_before_it_does(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("tasks.npy", _npy(np.zeros(130 * 2**20, np.uint8)))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"a\.npz.*would become 136\d+ bytes"):
            read_npz(path, "write it again")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_small_repetitive_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, ones=np.ones((1000, 1000)))
    assert read_npz(path, "")["ones"].shape == (1000, 1000)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_that_stands_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        for value in (1, 2):
            file.writestr("tasks.npy", _npy(np.array(value)))
    with pytest.raises(ValueError, match="'tasks': it stands twice"):
        read_npz(path, "write it again")


def _saved(content: Any) -> bytes:
    file = io.BytesIO()
    th.save(content, file)
    return file.getvalue()


def test_plain_tensors_are_read() -> None:
    content: dict[str, Any] = {"a": th.arange(3), "b": [th.ones(2, 2).T, {"c": 1.5}], "empty": th.zeros(0, 4)}
    read = load_tensors(_saved(content))
    assert th.equal(read["a"], content["a"]) and read["b"][1] == {"c": 1.5} and read["empty"].shape == (0, 4)


@pytest.mark.parametrize(
    "tensor",
    [
        th.zeros(1).expand(10**12),
        th.zeros(1).as_strided((1000, 1000), (0, 0)),
        th.eye(3).to_sparse(),
        th.eye(3).to_sparse_csr(),
    ],
)
@pytest.mark.filterwarnings("ignore:Sparse CSR")
def test_tensors_whose_numbers_are_not_all_there_are_refused(tensor: th.Tensor) -> None:
    with pytest.raises(ValueError):
        load_tensors(_saved({"a": [tensor]}))


def test_packed_tensors_are_refused() -> None:
    """``torch.save`` never packs; its reader would unpack whatever the file declares."""
    packed = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(_saved(th.zeros(2**20)))) as old,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for member in old.infolist():
            new.writestr(member.filename, old.read(member))
    with pytest.raises(ValueError, match="declares more than the file holds"):
        load_tensors(packed.getvalue())


@pytest.mark.parametrize("data", [b"", b"PK", b"\x80\x04N.", _saved(th.ones(2))[:-30]])
def test_what_is_no_file_of_tensors_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        load_tensors(data)


def test_json_nested_without_end_is_a_value_error() -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json("[" * 100_000)


def test_schedules_and_settings_nested_without_end_are_damaged(tmp_path: Path) -> None:
    """RecursionError is no ValueError."""
    instances, solver = UniformGenerator(4, 2)(2, np.random.default_rng(0)), make_solver("greedy-insertion")
    evaluate([solver], instances, tmp_path)
    for name in ("schedules.jsonl", "evaluation.json"):
        content = (tmp_path / name).read_text()
        (tmp_path / name).write_text("[" * 100_000 + "\n")
        with pytest.raises(ValueError, match=name):
            evaluate([solver], instances, tmp_path, resume=True)
        (tmp_path / name).write_text(content)


@pytest.mark.parametrize(("field", "value"), [("n_instances", float("nan")), ("sha256", True), ("sha256", 7)])
def test_settings_of_an_evaluation_of_other_kinds(tmp_path: Path, field: str, value: Any) -> None:
    """NaN cannot be written again, and a digest that is a number has no first digits."""
    instances, solver = UniformGenerator(4, 2)(2, np.random.default_rng(0)), make_solver("greedy-insertion")
    evaluate([solver], instances, tmp_path)
    path = tmp_path / "evaluation.json"
    about = json.loads(path.read_text())
    about["instances"][0][field] = value
    path.write_text(json.dumps(about))
    with pytest.raises(ValueError, match=str(tmp_path)):
        evaluate([solver], instances, tmp_path, resume=True)


@pytest.mark.parametrize(("column", "value"), [("unserved", -(2**40)), ("batch_size", 10**30), ("instance", -1)])
def test_counts_in_results_that_are_none(tmp_path: Path, column: str, value: int) -> None:
    """They do not fit into the columns that hold them, or name another row from the end."""
    instances, solver = UniformGenerator(4, 2)(2, np.random.default_rng(0)), make_solver("greedy-insertion")
    evaluate([solver], instances, tmp_path)
    path = tmp_path / "results.csv"
    header, *rows = path.read_text().splitlines()
    cells = rows[0].split(",")
    cells[header.split(",").index(column)] = str(value)
    path.write_text("\n".join([header, ",".join(cells), *rows[1:]]) + "\n")
    with pytest.raises(ValueError, match=rf"results\.csv, line 2: is damaged \({column} is {value}"):
        evaluate([solver], instances, tmp_path, resume=True)


@pytest.mark.parametrize("data", [b"\xff", b"epoch,level\0", b'epoch,level,phase,objective\n1,"' + b"a" * 200_000])
def test_a_log_that_is_no_csv_is_named(tmp_path: Path, data: bytes) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "its_log.csv").write_bytes(data)
    with pytest.raises(ValueError, match=r"its_log\.csv"):
        plot_learning_curves(tmp_path / "its_log.csv", tmp_path / "a.png")


def test_a_changed_mission_is_named(tmp_path: Path) -> None:
    """The tasks of a mission came from another file, which is not the one that is wrong."""
    from sb3_uav.missions.fleet import Fleet
    from sb3_uav.missions.plan_file import load_plan, save_plan
    from sb3_uav.missions.search import solve
    from sb3_uav.missions.tasks import TaskList

    tasks = TaskList.of("ab", [[0, 0], [900, 900]], "plane", [1, 1], depot=(500.0, 500.0), source="other.csv")
    path = tmp_path / "mission.json"
    save_plan(solve(tasks, Fleet.of_equal(1, 5000.0), "greedy-insertion", 0.01), path)
    data = json.loads(path.read_text())
    data["tasks"][0]["service_s"] = 5
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=r"mission\.json: .*speed"):
        load_plan(path)


def test_long_messages_lose_their_middle(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise ValueError("a.csv: row 1 is " + "x" * 70_000 + "; correct it.")

    assert run_command("prog", fail) == 2
    said = capsys.readouterr().err
    assert said.startswith("prog: error: a.csv: row 1 is xxx") and said.endswith("xx; correct it.\n") and len(said) < 3100


@pytest.mark.parametrize("path", [7, None, ["os.abort"], "a" * 9999])
def test_paths_of_objects_that_are_none(path: Any) -> None:
    with pytest.raises(ValueError, match=r"no dotted path"):
        import_object(path)


@pytest.mark.parametrize(("name", "value"), [("mixed_precision", float("inf")), ("use_values", "no"), ("n_layers", True)])
def test_settings_of_networks_of_other_kinds(name: str, value: Any) -> None:
    """They would fail in the middle of the training, or be taken for yes."""
    with pytest.raises(ValueError, match=f"{name} is "):
        NetworkSettings(**{name: value})

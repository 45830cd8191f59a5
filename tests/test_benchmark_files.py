"""Files of public benchmarks: what is read from them, and what is said of damaged ones."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from benchmark_files import BEST_KNOWN, FILES, chao_text, oplib_text
from conftest import whole_batches
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.evaluation.benchmarks import read_best_known, read_folder
from sb3_uav.evaluation.benchmarks.chao import read_chao
from sb3_uav.evaluation.benchmarks.collection import batch_of, evaluation_sets
from sb3_uav.evaluation.benchmarks.oplib import UnsupportedMetricError, read_oplib

ANYWHERE = Path("some.txt")
CHAO = (FILES / "b1.2.a.txt").read_text(encoding="utf-8")
OPLIB = (FILES / "road8.oplib").read_text(encoding="utf-8")

needs_vrplib = pytest.mark.skipif(find_spec("vrplib") is None, reason="vrplib reads OPLib files")


def same(a: Instances, b: Instances) -> bool:
    return a.digest() == b.digest()


# ------------------------------------------------------------------------------------------------------ Chao


def test_chao_file_with_an_open_way() -> None:
    found = read_chao(FILES / "b1.2.a.txt", CHAO, "b1")
    instance = found.instances
    assert (found.name, found.group, found.is_rounded) == ("b1.2.a", "b1", False)
    assert instance.n_uavs == 2 and instance.n_tasks == 7 and instance.start is None and instance.end is not None
    assert instance.depot[0].tolist() == [0.0, 0.0] and instance.end[0].tolist() == [[20.0, 18.0]] * 2
    # Of each vehicle, not of the fleet.
    assert instance.max_distance.tolist() == [30.0]
    # The start is point 1, the end point 9.
    assert found.nodes == (2, 3, 4, 5, 6, 7, 8)


def test_chao_file_with_one_depot_is_plain() -> None:
    path = FILES / "a1.2.a.txt"
    instance = read_chao(path, path.read_text(encoding="utf-8"), "a1").instances
    assert instance.is_plain and instance.depot[0].tolist() == [10.0, 10.0]
    assert instance.values[0].tolist() == [5, 15, 10, 5, 5, 10, 5] and instance.tasks[0, 1].tolist() == [1.4, 10.7]


@given(whole_batches(), st.sampled_from(["{x!r}\t{y!r}\t{score!r}", " {x:.17g}   {y:.17g} {score:.17g} "]))
def test_chao_files_are_read_as_they_are_written(batch: Instances, order: str) -> None:
    row = batch[0]
    n_tasks = max(int(row.task_mask.sum()), 1)
    row = row.trim(n_tasks)
    # The format knows neither service costs nor different vehicles.
    end = row.uav_end[0, :1].numpy().repeat(row.n_uavs, 0)
    instance = Instances.from_arrays(
        row.depot[0], row.tasks[0], row.values[0], float(row.unit[0]), row.n_uavs, end=end, source="test"
    )
    for text in (chao_text(instance, order), chao_text(instance, order).replace("\n", "\r\n") + "\r\n\r\n"):
        assert same(read_chao(ANYWHERE, text, "").instances, instance)


def changed(text: str, line: int, to: str | None) -> str:
    lines = text.splitlines()
    lines[line - 1 : line] = [] if to is None else [to]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("line", "to", "message"),
    [
        (1, None, "some.txt, line 1: expected 'n NUMBER', found 'm 2'"),
        (1, "n 10", "says n 10, but 9 lines of points follow"),
        (1, "n 8", "says n 8, but 9 lines of points follow"),
        (1, "n 9.5", "'n' is 9.5, but must be a whole number of at least 3"),
        (1, "n 2", "'n' is 2, but must be a whole number of at least 3"),
        (1, "n nine", "line 1: expected 'n NUMBER', found 'n nine'"),
        (1, "n 99999999999999", "says n 1e+14, but 9 lines of points follow"),
        (2, "m 0", "'m' is 0, but must be a whole number of at least 1"),
        (2, "m 1_0", "line 2: expected 'm NUMBER', found 'm 1_0'"),
        (2, None, "line 2: expected 'm NUMBER', found 'tmax 30.0'"),
        (2, "m 1e12", "'m' is 1e+12, but must be at most 10000"),
        (3, "tmax 0", "'tmax' is 0, but must be more than 0"),
        (3, "tmax nan", "line 3: expected 'tmax NUMBER', found 'tmax nan'"),
        (3, None, "line 3: expected 'tmax NUMBER', found"),
        (5, None, "says n 9, but 8 lines of points follow"),
        (5, "1.0 2.0", "line 5: expected x, y and score, three numbers, but found '1.0 2.0'"),
        (5, "1.0 two 5", "line 5: expected x, y and score, three numbers, but 'two' is no finite number"),
        (5, "1.0 nan 5", "line 5: expected x, y and score, three numbers, but 'nan' is no finite number"),
        (5, "1.0 2.0 inf", "line 5: expected x, y and score, three numbers, but 'inf' is no finite number"),
        (5, "1.0 2.0 -5", "line 5: the score is -5, but must be at least 0"),
        (5, "", "line 5: expected x, y and score, three numbers, but found ''"),
        (4, "0 0 5", "line 4: the start has the score 5, which must be 0"),
        (12, "20 18 5", "line 12: the end has the score 5, which must be 0"),
    ],
)
def test_damaged_chao_files(line: int, to: str | None, message: str) -> None:
    with pytest.raises(ValueError) as error:
        read_chao(ANYWHERE, changed(CHAO, line, to), "")
    assert message in str(error.value) and "some.txt" in str(error.value)


def test_empty_chao_file() -> None:
    with pytest.raises(ValueError, match="line 1: expected 'n NUMBER', found 'nothing'"):
        read_chao(ANYWHERE, "", "")


@given(st.integers(0, len(CHAO)), st.text(max_size=3), st.integers(0, 4))
def test_no_damage_ends_in_another_error(place: int, inserted: str, n_lost: int) -> None:
    for read, text in ((read_chao, CHAO), (read_oplib, OPLIB)):
        try:
            found = read(ANYWHERE, text[:place] + inserted + text[place + n_lost :], "")
        except (ValueError, ImportError) as error:
            assert "some.txt" in str(error) or isinstance(error, ImportError)
        else:
            found.instances.validate()


# ------------------------------------------------------------------------------------------------------ OPLib


@needs_vrplib
def test_oplib_file() -> None:
    found = read_oplib(FILES / "road8.oplib", OPLIB, "road")
    instance = found.instances
    assert (found.name, found.group, found.is_rounded) == ("road8", "road", True)
    assert instance.is_plain and instance.n_uavs == 1 and instance.max_distance.tolist() == [20.0]
    assert instance.depot[0].tolist() == [3, 0] and instance.tasks[0, 0].tolist() == [8, 0]
    assert instance.values[0].tolist() == [7, 5, 6, 4, 4, 6, 6] and found.nodes == (2, 3, 4, 5, 6, 7, 8)


@needs_vrplib
def test_the_score_of_the_depot_is_kept_apart() -> None:
    """Best-known values of OPLib include it."""
    assert read_oplib(ANYWHERE, OPLIB, "").depot_score == 0
    found = read_oplib(ANYWHERE, OPLIB.replace("\n1 0\n", "\n1 5\n"), "")
    assert found.depot_score == 5 and found.instances.values.sum() == 38


@needs_vrplib
@given(st.integers(1, 6), st.integers(0, 2**31), st.data())
def test_oplib_files_are_read_as_they_are_written(n_tasks: int, seed: int, data: st.DataObject) -> None:
    depot = data.draw(st.integers(1, n_tasks + 1))
    rng = np.random.default_rng(seed)
    whole = data.draw(st.booleans())
    points = rng.integers(-50, 50, (n_tasks + 1, 2)) if whole else rng.normal(0, 100, (n_tasks + 1, 2))
    instance = Instances.from_arrays(points[0], points[1:], rng.integers(0, 9, n_tasks), rng.uniform(1, 99), 1)
    found = read_oplib(ANYWHERE, oplib_text(instance, depot), "")
    assert same(found.instances, instance)
    assert found.nodes == tuple(number for number in range(1, n_tasks + 2) if number != depot)


@needs_vrplib
@pytest.mark.parametrize("metric", ["GEO", "CEIL_2D", "ATT", "EXPLICIT", "MAN_2D", "missing"])
def test_other_metrics_are_refused_by_name(metric: str) -> None:
    line = "" if metric == "missing" else f"EDGE_WEIGHT_TYPE : {metric}\n"
    text = OPLIB.replace("EDGE_WEIGHT_TYPE : EUC_2D\n", line)
    with pytest.raises(UnsupportedMetricError, match=rf"some\.txt: EDGE_WEIGHT_TYPE is {metric}; only EUC_2D") as error:
        read_oplib(ANYWHERE, text, "")
    assert error.value.metric == metric


@needs_vrplib
def test_matrices_are_refused_by_name() -> None:
    """vrplib would build the matrix, and fail in its own way on a damaged one."""
    sections = "EDGE_WEIGHT_TYPE : EXPLICIT\nEDGE_WEIGHT_FORMAT : LOWER_DIAG_ROW\nEDGE_WEIGHT_SECTION\n0 1 0 1 2 0\n"
    for text in (OPLIB.replace("EDGE_WEIGHT_TYPE : EUC_2D\n", sections),):
        with pytest.raises(UnsupportedMetricError, match="EDGE_WEIGHT_TYPE is EXPLICIT"):
            read_oplib(ANYWHERE, text, "")


@needs_vrplib
@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("TYPE : OP\n", "TYPE : TSP\n", "TYPE is TSP; only OP can be solved"),
        ("TYPE : OP\n", "", "TYPE is missing; only OP can be solved"),
        ("COST_LIMIT : 20\n", "", "COST_LIMIT is missing, but must be a number"),
        ("COST_LIMIT : 20\n", "COST_LIMIT : far\n", "COST_LIMIT is 'far', but must be a number"),
        ("COST_LIMIT : 20\n", "COST_LIMIT : nan\n", "COST_LIMIT is nan, but must be a number"),
        ("COST_LIMIT : 20\n", "COST_LIMIT : -3\n", "field 'max_distance' is -3.0"),
        ("DIMENSION : 8\n", "DIMENSION : 9\n", "DIMENSION is 9, but NODE_COORD_SECTION has 8 lines"),
        ("DIMENSION : 8\n", "", "DIMENSION is missing"),
        ("DIMENSION : 8\n", "DIMENSION : 1\n", "DIMENSION is 1, but must be a whole number of at least 2"),
        ("3 2 3\n", "", "line 10: NODE_COORD_SECTION: expected 3, then x and y, found '4 0 0'"),
        ("3 2 3\n", "3 2 two\n", "line 10: NODE_COORD_SECTION: 'two' is no finite number"),
        ("3 2 3\n", "3 2 nan\n", "line 10: NODE_COORD_SECTION: 'nan' is no finite number"),
        ("3 2 3\n", "3 2\n", "line 10: NODE_COORD_SECTION: expected 3, then x and y, found '3 2'"),
        ("3 2 3\n", "3 2 3 4\n", "line 10: NODE_COORD_SECTION: expected 3, then x and y, found '3 2 3 4'"),
        ("8 5 4\n", "", "DIMENSION is 8, but NODE_COORD_SECTION has 7 lines"),
        ("8 6\n", "", "DIMENSION is 8, but NODE_SCORE_SECTION has 7 lines"),
        ("7 6\n8 6\n", "8 6\n7 6\n", "line 23: NODE_SCORE_SECTION: expected 7, then the score, found '8 6'"),
        ("2 7\n", "2 -7\n", "line 18: NODE_SCORE_SECTION: the score is -7, but must be at least 0"),
        ("NODE_SCORE_SECTION\n", "", "NODE_COORD_SECTION: expected 9, then x and y, found '1 0'"),
        ("DEPOT_SECTION\n1\n", "DEPOT_SECTION\n", "DEPOT_SECTION names no node, but must name one of nodes 1 to 8"),
        ("DEPOT_SECTION\n1\n", "DEPOT_SECTION\n9\n", "DEPOT_SECTION names 9, but must name one of nodes 1 to 8"),
        ("DEPOT_SECTION\n1\n", "DEPOT_SECTION\n1\n2\n", "DEPOT_SECTION names 1, 2, but must name one of nodes 1 to 8"),
        ("DEPOT_SECTION\n1\n-1\n", "", "DEPOT_SECTION names no node"),
        ("COMMENT :", "COMMENT", "is no intact OPLib file (Instance does not conform to the VRPLIB format.)"),
    ],
)
def test_damaged_oplib_files(before: str, after: str, message: str) -> None:
    assert before in OPLIB
    with pytest.raises(ValueError) as error:
        read_oplib(ANYWHERE, OPLIB.replace(before, after, 1), "")
    assert message in str(error.value) and "some.txt" in str(error.value)


# ------------------------------------------------------------------------------------------------------ folders


@needs_vrplib
def test_the_folder_of_the_tests() -> None:
    folder = read_folder(FILES)
    assert list(folder.instances) == ["a1.2.a", "a1.2.b", "b1.1.a", "b1.2.a", "b1.2.b", "road8"]
    assert [found.group for found in folder.instances.values()] == ["a1", "a1", "b1", "b1", "b1", "road8"]
    assert not folder.skipped and not folder.unsupported
    sets = evaluation_sets(list(folder.instances.values()))
    assert {name: [found.name for found in members] for name, members in sets.items()} == {
        "a1": ["a1.2.a", "a1.2.b"],
        "b1, 1 UAV": ["b1.1.a"],
        "b1, 2 UAVs": ["b1.2.a", "b1.2.b"],
        "road8": ["road8"],
    }
    assert list(read_folder(FILES, ["b1.2.*", "a1.*.b"]).instances) == ["a1.2.b", "b1.2.a", "b1.2.b"]
    assert list(read_folder(FILES / "b1.1.a.txt").instances) == ["b1.1.a"]


def test_sets_hold_only_what_goes_together(tmp_path: Path, rng: np.random.Generator) -> None:
    """Batches are padded, and a solver refuses a batch as a whole."""
    for name, n_tasks, end in (("a", 5, False), ("b", 8, False), ("c", 9, False), ("d", 8, True)):
        instance = UniformGenerator(n_tasks, n_uavs=2)(1, rng)
        if end:
            instance = Instances.from_arrays(
                instance.depot[0], instance.tasks[0], n_uavs=2, end=instance.depot[0].numpy() + np.zeros((2, 2)) + 0.1
            )
        instance.save(tmp_path / f"x.{name}.npz")
    folder = read_folder(tmp_path)
    sets = evaluation_sets(list(folder.instances.values()))
    assert {name: [found.name for found in members] for name, members in sets.items()} == {
        "x, as in the paper, up to 8 tasks": ["x.a", "x.b"],
        "x, as in the paper, up to 16 tasks": ["x.c"],
        "x, beyond the paper, up to 8 tasks": ["x.d"],
    }
    batch = batch_of(next(iter(sets.values())))
    assert batch.is_plain and batch.task_mask.sum(1).tolist() == [5, 8]


def test_npz_files_have_a_name_for_each_row(tmp_path: Path, instances: Instances) -> None:
    instances.save(tmp_path / "mine.npz")
    instances[0].save(tmp_path / "one.npz")
    folder = read_folder(tmp_path)
    assert list(folder.instances) == ["mine.0", "mine.1", "mine.2", "mine.3", "mine.4", "one"]
    last = folder.instances["mine.4"]
    assert same(last.instances, instances[4].trim(6)) and last.nodes == (0, 1, 2, 3, 4, 5)
    assert list(read_folder(tmp_path, ["mine.3"]).instances) == ["mine.3"]
    # As other systems write it.
    (tmp_path / "mine.npz").rename(tmp_path / "mine.NPZ")
    assert list(read_folder(tmp_path).instances) == list(folder.instances)
    assert list(read_folder(tmp_path, ["mine.3"]).instances) == ["mine.3"]


def test_folders_in_the_folder_are_groups(tmp_path: Path) -> None:
    for place in ("gen1", "gen2/easy", ".hidden"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / f"{place[:4]}.txt").write_text(CHAO, encoding="utf-8")
    (tmp_path / "gen1" / "x.2.txt").write_text(CHAO, encoding="utf-8")
    (tmp_path / "gen2" / "easy" / "x.3.txt").write_text(CHAO, encoding="utf-8")
    (tmp_path / "gen1" / "README.md").write_text("text", encoding="utf-8")
    (tmp_path / "gen1" / "LICENSE.txt").write_text("text", encoding="utf-8")
    folder = read_folder(tmp_path)
    assert {name: found.group for name, found in folder.instances.items()} == {
        "gen1": "gen1",
        "x.2": "gen1",
        "gen2": "gen2/easy",
        "x.3": "gen2/easy",
    }
    assert [path.name for path in folder.skipped] == ["LICENSE.txt"]
    (tmp_path / "gen2" / "x.2.txt").write_text(CHAO, encoding="utf-8")
    with pytest.raises(ValueError, match=r"x\.2 is the name of an instance in .*x\.2\.txt too; rename one of them"):
        read_folder(tmp_path)


def test_groups_of_one_are_joined(tmp_path: Path) -> None:
    """OPLib's names have no dots."""
    for name in ("alpha", "beta", "gamma"):
        (tmp_path / f"{name}.txt").write_text(CHAO, encoding="utf-8")
    assert {found.group for found in read_folder(tmp_path).instances.values()} == {tmp_path.name}


@needs_vrplib
def test_files_with_other_metrics_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "round.oplib").write_text(OPLIB.replace("EUC_2D", "GEO"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"have metrics that cannot be solved \(GEO\); only EUC_2D can"):
        read_folder(tmp_path)
    (tmp_path / "flat.oplib").write_text(OPLIB, encoding="utf-8")
    folder = read_folder(tmp_path)
    assert list(folder.instances) == ["flat"] and folder.unsupported == {"round": "GEO"}


def test_a_damaged_file_is_not_skipped_if_its_value_is_known(tmp_path: Path) -> None:
    (tmp_path / "good.txt").write_text(CHAO, encoding="utf-8")
    (tmp_path / "bad.txt").write_text(changed(CHAO, 1, None), encoding="utf-8")
    assert [path.name for path in read_folder(tmp_path).skipped] == ["bad.txt"]
    with pytest.raises(ValueError, match=r"bad\.txt, line 1: expected 'n NUMBER', found 'm 2'"):
        read_folder(tmp_path, known=["bad"])


def test_wrong_folders(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such folder"):
        read_folder(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="holds no benchmark file"):
        read_folder(tmp_path)
    (tmp_path / "a.txt").write_bytes(b"n 3\n\xff\xfe")
    with pytest.raises(ValueError, match=r"a\.txt, line 2: expected 'm NUMBER', found"):
        read_folder(tmp_path)
    with pytest.raises(ValueError, match=r"no instance has a name like q\*"):
        read_folder(FILES, ["q*"])


# ------------------------------------------------------------------------------------------------------ best-known values


def test_best_known_values(tmp_path: Path) -> None:
    assert read_best_known(BEST_KNOWN)["b1.2.b"] == 0 and read_best_known(BEST_KNOWN)["road8"] == 27
    path = tmp_path / "values.csv"
    path.write_text(
        '\ufeffinstance,source, best_known \nx.1,a table, 10\n\nx.2,a table,2.5\nx.1,"b, c",10.0\n', encoding="utf-8"
    )
    assert read_best_known(path) == {"x.1": 10.0, "x.2": 2.5}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: needs the columns instance,best_known, found ''"),
        ("name,value\na,1\n", "line 1: needs the columns instance,best_known, found 'name,value'"),
        ("instance,best_known\n", "holds no best-known value"),
        ("instance,best_known\na,1\nb,many\n", "line 3: best_known of 'b' is 'many'; it must be a finite number"),
        ("instance,best_known\na,\n", "line 2: best_known of 'a' is ''; it must be a finite number"),
        ("instance,best_known\na,nan\n", "line 2: best_known of 'a' is 'nan'; it must be a finite number"),
        ("instance,best_known\na,-1\n", "line 2: best_known of 'a' is -1; it must be at least 0"),
        ("instance,best_known\na\n", "line 2: has 1 cells, expected 2, found 'a'"),
        ("instance,best_known\na,1,2\n", "line 2: has 3 cells, expected 2, found 'a,1,2'"),
        ("instance,best_known\na,1\na,2\n", "line 3: best_known of 'a' is 2, but 1 in a line before"),
        ('instance,best_known\n"a,1\n', "is no CSV in UTF-8"),
    ],
)
def test_wrong_best_known_values(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "values.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError) as error:
        read_best_known(path)
    assert message in str(error.value) and str(path) in str(error.value)


def test_missing_best_known_values(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="give a CSV with the columns instance,best_known"):
        read_best_known(tmp_path / "none.csv")

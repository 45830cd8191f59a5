"""Figures: the files are there and whole, and show the data that they were given."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from sb3_uav.common.optional import install_command
from sb3_uav.envs import Instances, Schedule, UniformGenerator
from sb3_uav.envs.render import UAV_COLORS
from sb3_uav.plots import MapPanel, learning_curves, plot_learning_curves, plot_schedule, plot_schedules
from sb3_uav.plots.learning_curves import _read_its_log
from sb3_uav.plots.schedule_map import schedules_figure

ITS_LOG = """\
epoch,level,phase,n_instances,objective,seconds
1,router,pretraining,100,9.5,1.0
2,router,pretraining,100,11.0,1.0
1,allocator,intensive,100,30.0,1.0
3,router,intensive,100,8.0,1.0
4,router,alternate,100,8.5,1.0
2,allocator,alternate,100,41.5,1.0
"""


@pytest.fixture
def instances() -> Instances:
    return UniformGenerator(12, n_uavs=3)(2, np.random.default_rng(0))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "its_log.csv"
    path.write_text(ITS_LOG)
    return path


def colors_in(path: Path) -> set[str]:
    red, green, blue = np.moveaxis((matplotlib.image.imread(path)[..., :3] * 255).round().astype(np.int64), -1, 0)
    return {f"#{number:06X}" for number in np.unique(red << 16 | green << 8 | blue)}


def only_file_in(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


# ---------------------------------------------------------------------------------------------------------------- the map


def test_map_of_a_schedule(instances: Instances, tmp_path: Path) -> None:
    """The picture is whole, and shows the colors of the UAVs that fly, and of no other."""
    plot_schedule(instances, 1, Schedule([[0, 1, 2], [3, 4]]), tmp_path / "new" / "map.png", "two of three UAVs")
    path = only_file_in(tmp_path / "new")
    height, width = matplotlib.image.imread(path).shape[:2]
    assert width > 600 and height > 700
    assert set(UAV_COLORS[:2]) <= colors_in(path)
    assert UAV_COLORS[2] not in colors_in(path)


def test_legend_and_extent_of_a_map(instances: Instances) -> None:
    """Lengths and counts of every tour, what was skipped as a hollow circle, and a square that holds all points."""
    (axes,) = schedules_figure([MapPanel(instances, 1, Schedule([[0, 1, 2], [3], []]))]).axes
    points = np.vstack([instances.depot[1].numpy(), instances.tasks[1].numpy()])
    loop = np.vstack([points[:4], points[0]])
    length, single = np.linalg.norm(np.diff(loop, axis=0), axis=1).sum(), 2 * np.linalg.norm(points[4] - points[0])
    expected = [
        f"UAV 1: 3 tasks, length {length:.2f}",
        f"UAV 2: 1 task, length {single:.2f}",
        "UAV 3: 0 tasks, length 0.00",
        "depot (D = 2.00)",
        "8 tasks skipped",
    ]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == expected
    hollow = axes.get_legend().legend_handles[-1]
    assert len(hollow.get_facecolor()) == 0 and len(hollow.get_edgecolor()) == 1
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert right - left == pytest.approx(top - bottom)
    assert (points > (left, bottom)).all() and (points < (right, top)).all()


def test_several_maps_side_by_side(instances: Instances, tmp_path: Path) -> None:
    schedule = Schedule([[0], [1], []])
    plot_schedules([MapPanel(instances, 0, schedule)], tmp_path / "one.png")
    plot_schedules([MapPanel(instances, row, schedule, f"{row}") for row in (0, 1, 0)], tmp_path / "three.png")
    plot_schedules([MapPanel(instances, 0, schedule)] * 5, tmp_path / "five.png")
    one, three, five = (matplotlib.image.imread(tmp_path / f"{name}.png").shape for name in ("one", "three", "five"))
    assert three[1] > 2.5 * one[1] and abs(three[0] - one[0]) < 0.1 * one[0]
    assert five[1] > 3.5 * one[1] and five[0] > 1.8 * one[0]


@pytest.mark.parametrize("suffix, start", [(".pdf", b"%PDF"), (".svg", b"<?xml"), (".PNG", b"\x89PNG")])
def test_formats(suffix: str, start: bytes, instances: Instances, tmp_path: Path) -> None:
    plot_schedule(instances, 0, Schedule([[0]]), tmp_path / f"map{suffix}")
    assert only_file_in(tmp_path).name == f"map{suffix}"
    assert only_file_in(tmp_path).read_bytes().startswith(start)


def test_map_of_nothing(instances: Instances, tmp_path: Path) -> None:
    """No UAV flies, every task is skipped, and every task is visited."""
    for name, routes in (("none", []), ("idle", [[], []]), ("all", [list(range(12))])):
        plot_schedule(instances.pad(15), 0, Schedule(routes), tmp_path / f"{name}.png")
        assert matplotlib.image.imread(tmp_path / f"{name}.png").std() > 0
    with pytest.raises(ValueError, match="at least one panel"):
        plot_schedules([], tmp_path / "no.png")


def test_wrong_suffix(instances: Instances, log: Path, tmp_path: Path) -> None:
    for name in ("map", "map.jpg"):
        with pytest.raises(ValueError, match=rf"{name}: the suffix of a figure must be one of \('.png', '.pdf'"):
            plot_schedule(instances, 0, Schedule([[0]]), tmp_path / name)
        with pytest.raises(ValueError, match="the suffix of a figure"):
            plot_learning_curves(log, tmp_path / name)
    assert only_file_in(tmp_path) == log


def test_nothing_is_half_written(instances: Instances, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.png"
    plot_schedule(instances, 0, Schedule([[0]]), path)
    before = path.read_bytes()

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_uav.common.files.os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        plot_schedule(instances, 0, Schedule([[1]]), path)
    assert only_file_in(tmp_path) == path and path.read_bytes() == before


# ------------------------------------------------------------------------------------------------------------------ curves


def drawn(log: Path, path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The figure of a log, before it is written."""
    figures: list[Any] = []
    monkeypatch.setattr(learning_curves, "save_figure", lambda figure, _: figures.append(figure))
    plot_learning_curves(log, path)
    return figures[0]


def test_curves_show_the_log(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    upper, lower = drawn(log, tmp_path / "curves.png", monkeypatch).axes
    assert upper.lines[0].get_xydata().tolist() == [[1, 30.0], [2, 41.5]]
    assert lower.lines[0].get_xydata().tolist() == [[1, 9.5], [2, 11.0], [3, 8.0], [4, 8.5]]
    assert [text.get_text() for text in lower.get_legend().get_texts()] == ["pre-training", "intensive", "alternate"]
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in lower.patches]
    assert spans == [(0.5, 2.5), (2.5, 3.5), (3.5, 4.5)]
    assert len({patch.get_facecolor() for patch in lower.patches}) == 3
    assert "allocator" in upper.get_title("left") and "router" in lower.get_title("left")
    assert upper.get_ylabel() == "tasks completed (mean)" and lower.get_xlabel() == "epoch"


def test_curves_of_long_and_of_unfinished_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One level may have no epochs yet, phases may return, and their names may be new."""
    log = tmp_path / "its_log.csv"
    header, *rows = ITS_LOG.splitlines()
    log.write_text("\n".join([header, *(row for row in rows if "router" in row)]))
    upper, lower = drawn(log, tmp_path / "curves.png", monkeypatch).axes
    assert len(upper.lines) == 0 and upper.texts[0].get_text() == "no epochs"
    assert len(lower.lines[0].get_xydata()) == 4
    phases = ("intensive", "alternate", "intensive", "other")
    log.write_text("\n".join([header, *(f"{e + 1},router,{phases[e // 25]},1,{e},1" for e in range(100))]))
    lower = drawn(log, tmp_path / "curves.png", monkeypatch).axes[1]
    assert [text.get_text() for text in lower.get_legend().get_texts()] == ["intensive", "alternate"]
    assert len(lower.patches) == 3 and lower.lines[0].get_marker() in ("None", None)


def test_curves_on_disk(log: Path, tmp_path: Path) -> None:
    plot_learning_curves(log, tmp_path / "plots" / "curves.png")
    assert only_file_in(tmp_path / "plots").name == "curves.png"
    assert matplotlib.image.imread(tmp_path / "plots" / "curves.png").shape[1] > 1000
    # The folder of a run will do.
    plot_learning_curves(log.parent, tmp_path / "same" / "curves.png")
    same, first = (matplotlib.image.imread(tmp_path / name / "curves.png") for name in ("same", "plots"))
    assert np.array_equal(same, first)


def test_epochs_are_read_in_order(log: Path) -> None:
    header, *rows = ITS_LOG.splitlines()
    log.write_text("\n".join([header, *reversed(rows)]) + "\n")
    epochs = _read_its_log(log)
    assert [epoch.epoch for epoch in epochs["router"]] == [1, 2, 3, 4]
    assert [epoch.phase for epoch in epochs["allocator"]] == ["intensive", "alternate"]


@pytest.mark.parametrize(
    "content, message",
    [
        ("", r"columns \['epoch', 'level', 'objective', 'phase'\] are missing"),
        ("epoch,level,phase\n1,router,intensive\n", r"columns \['objective'\] are missing"),
        ("epoch,level,phase,objective\n", "holds no epochs yet"),
        ("epoch,level,phase,objective\n1,pilot,intensive,3\n", "line 2: level is 'pilot', expected one of"),
        ("epoch,level,phase,objective\n1,router,intensive,3\n2,router,intensive,much\n", "line 3: .* found '2' and 'much'"),
        ("epoch,level,phase,objective\n1,router,intensive\n", "line 2: epoch and objective must be numbers"),
    ],
)
def test_wrong_logs(content: str, message: str, tmp_path: Path) -> None:
    log = tmp_path / "its_log.csv"
    log.write_text(content)
    with pytest.raises(ValueError, match=f"its_log.csv.*{message}"):
        plot_learning_curves(log, tmp_path / "curves.png")
    assert only_file_in(tmp_path) == log


def test_missing_log(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"its_log\.csv: no such log"):
        plot_learning_curves(tmp_path / "its_log.csv", tmp_path / "curves.png")


# ------------------------------------------------------------------------------------------------------------- matplotlib


def test_without_matplotlib(log: Path, instances: Instances, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for draw in (
        lambda: plot_learning_curves(log, tmp_path / "curves.png"),
        lambda: plot_schedule(instances, 0, Schedule([[0]]), tmp_path / "map.png"),
    ):
        with pytest.raises(ImportError, match=re.escape(install_command("plots"))):
            draw()


def test_matplotlib_is_imported_late_and_without_pyplot(log: Path, tmp_path: Path) -> None:
    code = (
        "import sys, sb3_uav.plots as plots\n"
        "assert 'matplotlib' not in sys.modules\n"
        f"plots.plot_learning_curves({str(log)!r}, {str(tmp_path / 'curves.png')!r})\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

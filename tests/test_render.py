"""Pictures of running episodes, of one environment and of many."""

from __future__ import annotations

import logging
import re
import sys
from typing import Any

import numpy as np
import pytest
from env_helpers import act, batched_env, both_levels, env_fns, legal_actions, make, play, rendered, reset
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.common.optional import install_command
from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.render import MapFigure, legend_lines


@both_levels
def test_rgb_array(level: str) -> None:
    """Pictures differ between steps and between episodes, and are equal for equal episodes."""
    env = make(level, n_tasks=5, max_distance=3.0, render_mode="rgb_array")

    def images() -> list[np.ndarray]:
        rng = np.random.default_rng(0)
        env.reset(seed=0)
        shown, terminated = [rendered(env)], False
        while not terminated:
            terminated = env.step(act(env, rng))[2]
            shown.append(rendered(env))
        return shown

    first = images()
    for image in first:
        assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3 and image.std() > 0
        assert image.shape == first[0].shape
    assert len({image.tobytes() for image in first}) == len(first)
    assert all(np.array_equal(a, b) for a, b in zip(first, images(), strict=True))
    env.reset(seed=1)
    assert not np.array_equal(rendered(env), first[0])
    env.close()
    env.close()


@both_levels
def test_human_mode_without_a_display(level: str, caplog: pytest.LogCaptureFixture) -> None:
    """One warning that nothing is shown; the episode continues, and no figure remains open."""
    import matplotlib.pyplot as plt

    env = make(level, n_tasks=4, render_mode="human")
    with caplog.at_level(logging.WARNING):
        play(env, np.random.default_rng(0), seed=0)
        assert env.render() is None
    env.close()
    assert [record.message for record in caplog.records] == [
        "No display was found, so render_mode='human' shows nothing; use render_mode='rgb_array'."
    ]
    assert plt.get_fignums() == []


@both_levels
def test_render_without_a_mode(level: str) -> None:
    env = make(level)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"render\(\) does nothing without a render_mode; make the environment with"):
        assert env.render() is None


def test_drawing_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the command that installs it."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    env = RoutePlanningEnv(n_tasks=3, render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ImportError, match=f"Drawing needs matplotlib; run: {re.escape(install_command('plots'))}"):
        env.render()


@both_levels
def test_images_of_rows(level: str) -> None:
    """One per row, equal to that of a single environment; ``render`` tiles them."""
    fns = env_fns(level, 2, n_tasks=4, render_mode="rgb_array")
    ours, theirs = BatchedVecEnv(fns), DummyVecEnv(fns)
    assert ours.metadata == {"render_modes": ["human", "rgb_array"]}
    for env in (ours, theirs):
        env.seed(0)
        reset(env)
    actions = legal_actions(ours, np.random.default_rng(0))
    for env in (ours, theirs):
        env.step(actions)
    images = ours.get_images()
    assert len(images) == 2 and not np.array_equal(images[0], images[1])  # type: ignore[arg-type]
    for image, expected in zip(images, theirs.get_images(), strict=True):
        assert image is not None and image.dtype == np.uint8 and np.array_equal(image, expected)  # type: ignore[arg-type]
    big = ours.render()
    assert big is not None and np.array_equal(big, theirs.render())  # type: ignore[arg-type]
    (second,) = ours.env_method("render", indices=1)
    assert np.array_equal(second, images[1])  # type: ignore[arg-type]
    ours.close()


@both_levels
def test_no_images_without_a_render_mode(level: str) -> None:
    env = batched_env(level, 2, n_tasks=4)
    reset(env)
    assert list(env.get_images()) == [None, None]
    with pytest.warns(UserWarning, match="no `render_mode` was passed"):
        assert env.render() is None


def test_rows_in_human_mode_without_a_display() -> None:
    """It does not fail, and no figure remains open."""
    import matplotlib.pyplot as plt

    env = batched_env("routing", 2, n_tasks=4, render_mode="human")
    reset(env)
    assert env.render() is None
    env.step(legal_actions(env, np.random.default_rng(0)))
    assert env.render() is None
    env.close()
    assert plt.get_fignums() == []


def axes_of(env: ProblemEnv) -> Any:
    """The picture of the running episode."""
    figure = MapFigure()
    figure.draw(env.episodes, 0)
    return figure.axes


def legend_of(env: ProblemEnv) -> list[str]:
    return [text.get_text() for text in axes_of(env).get_legend().get_texts()]


def lines_of(env: ProblemEnv) -> list[list[list[float]]]:
    """Each line as its points."""
    return [np.stack(line.get_data(), axis=-1).tolist() for line in axes_of(env).get_lines()]


def test_a_running_tour_is_open() -> None:
    """Until the UAV is home there is no closing leg, and tasks are not yet visited instead of skipped."""
    env = RoutePlanningEnv(n_tasks=3, max_distance=8.5)
    instance = Instances.from_arrays([0, 0], [[0, 3], [4, 0], [100, 0]], max_distance=8.5)
    env.reset(options={"instance": instance})
    assert legend_of(env) == ["UAV 1: 0 tasks, 8.50 left", "depot (D = 8.50)", "3 tasks not yet visited"]
    assert lines_of(env) == [[[0.0, 0.0]]]
    env.step(1)
    assert legend_of(env) == ["UAV 1: 1 task, 5.50 left", "depot (D = 8.50)", "2 tasks not yet visited"]
    assert lines_of(env) == [[[0.0, 0.0], [0.0, 3.0]]]
    env.step(0)
    assert legend_of(env) == ["UAV 1: 1 task, length 6.00", "depot (D = 8.50)", "2 tasks skipped"]
    assert lines_of(env) == [[[0.0, 0.0], [0.0, 3.0], [0.0, 0.0]]]


def test_assigned_tasks_are_no_tour_yet() -> None:
    """No UAV flies while tasks are assigned; tours and skipped tasks are known at the end."""
    env = TaskAllocationEnv(n_tasks=3, n_uavs=2)
    instance = Instances.from_arrays([0, 0], [[0, 3], [4, 0], [100, 0]], max_distance=9.0, n_uavs=2)
    env.reset(options={"instance": instance})
    depot = "depot (D = 9.00)"
    assert legend_of(env) == ["UAV 1: 0 tasks, 9.00 left", "UAV 2: 0 tasks, 9.00 left", depot, "3 tasks not yet assigned"]
    env.step(1)
    env.step(0)
    assert legend_of(env) == ["UAV 1: 1 task, 9.00 left", "UAV 2: 1 task, 9.00 left", depot, "1 task not yet assigned"]
    assert lines_of(env) == []
    env.step(1)
    assert legend_of(env) == ["UAV 1: 1 task, length 8.00", "UAV 2: 1 task, length 6.00", depot, "1 task skipped"]
    assert lines_of(env) == [[[0.0, 0.0], [4.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 3.0], [0.0, 0.0]]]


@pytest.mark.parametrize(("max_distance", "shown"), [(3e7, "3e+07"), (0.004, "0.004"), (250.0, "250.00")])
def test_distances_of_any_magnitude_are_legible(max_distance: float, shown: str) -> None:
    env = RoutePlanningEnv(n_tasks=3, max_distance=max_distance)
    env.reset(seed=0)
    assert legend_of(env)[:2] == [f"UAV 1: 0 tasks, {shown} left", f"depot (D = {shown})"]


def test_large_fleets_are_drawn_and_twelve_uavs_named() -> None:
    """All tours, and a legend that fits below the map."""
    env = TaskAllocationEnv(n_tasks=20, n_uavs=40, max_distance=9.0)
    env.reset(seed=0)
    for task in range(20):
        env.step(2 * task)
    legend = legend_of(env)
    assert len(legend) == 15 and legend[12:] == ["8 more UAVs", "depot (D = 9.00)", "0 tasks skipped"]
    assert len(lines_of(env)) == 20
    assert legend_lines(env.episodes.routes(0)) == 8 and legend_lines([[0], [1]]) == 2
    axes = axes_of(env)
    box, page = axes.get_legend().get_window_extent(), axes.figure.bbox
    assert 0 <= box.x0 and box.x1 <= page.width and 0 <= box.y0 and box.y1 <= page.height

"""Pictures of running episodes, of one environment and of many."""

from __future__ import annotations

import logging
import re
import sys
from typing import Any

import numpy as np
import pytest
from env_helpers import act, batched_env, both_levels, env_fns, legal_actions, make, play, rendered, reset
from matplotlib.markers import MarkerStyle
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.common.optional import install_command
from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.problem import Stage
from sb3_uav.envs.render import UAV_COLORS, MapFigure, legend_lines


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


# --------------------------------------------------------------------------------------------------------- the whole problem


def whole_instance() -> Instances:
    """Four UAVs: from the depot and back, from a start to an end, from a depot of its own, and one that cannot fly."""
    return Instances.from_arrays(
        [0.0, 0.0],
        [[1, 0], [2, 0], [0, 3], [0, 4], [5, 5]],
        None,
        [4.0, 9.0, 8.0, 1.0],
        4,
        start=[[0, 0], [0, 1], [6, 6], [3, 3]],
        end=[[0, 0], [0, 6], [6, 6], [90, 3]],
        service=[0.5, 0.25, 0.0, 1.0, 0.0],
        must_serve=[False, True, True, False, False],
    )


def drawn(instance: Instances, routes: list[list[int]], stage: Stage = Stage.FINISHED) -> Any:
    figure = MapFigure()
    figure.draw_routes(instance, routes, stage)
    return figure.axes


def marks(axes: Any) -> dict[tuple[float, float], list[tuple[str, tuple[int, ...]]]]:
    """Of every place with something drawn at it: the outlines and colors of what is drawn there."""
    found: dict[tuple[float, float], list[tuple[str, tuple[int, ...]]]] = {}
    for artist in axes.collections:
        color = (
            tuple((255 * artist.get_facecolor()[0][:3]).round().astype(int).tolist()) if len(artist.get_facecolor()) else ()
        )
        outline = str(len(artist.get_paths()[0]))
        for place in artist.get_offsets().tolist():
            found.setdefault((place[0], place[1]), []).append((outline, color))
    return found


def outline_of(marker: str) -> str:
    return str(len(MarkerStyle(marker).get_path()))


def rgb(color: str) -> tuple[int, ...]:
    return tuple(int(color[i : i + 2], 16) for i in (1, 3, 5))


def test_starts_and_ends_are_marked_where_they_are_not_the_depot() -> None:
    axes = drawn(whole_instance(), [[0], [2, 3], [], []])
    at = marks(axes)
    assert (outline_of(">"), rgb(UAV_COLORS[1])) in at[0.0, 1.0]
    assert (outline_of("X"), rgb(UAV_COLORS[1])) in at[0.0, 6.0]
    assert (outline_of("s"), rgb(UAV_COLORS[2])) in at[6.0, 6.0]
    assert (outline_of(">"), rgb(UAV_COLORS[3])) in at[3.0, 3.0]
    assert at[0.0, 0.0] == [(outline_of("s"), (0, 0, 0))]
    lines = [np.stack(line.get_data(), axis=-1).tolist() for line in axes.get_lines()]
    # Idle UAVs fly straight to their end, or stay.
    assert lines == [[[0, 0], [1, 0], [0, 0]], [[0, 1], [0, 3], [0, 4], [0, 6]], [[6, 6], [6, 6]], [[3, 3]]]
    assert max(axes.get_xlim()) < 10


def test_legend_of_the_whole_problem() -> None:
    """Lengths with service costs, of what each UAV can fly; tasks that must be served; and a place for every line."""
    instance, routes = whole_instance(), [[0], [2, 3], [], []]
    axes = drawn(instance, routes)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "UAV 1: 1 task, length 2.50 of 4.00",
        "UAV 2: 2 tasks, length 6.00 of 9.00",
        "UAV 3: 0 tasks, length 0.00 of 8.00",
        "UAV 4: 0 tasks, cannot reach its end",
        "depot (D = 1.00 to 9.00)",
        "start",
        "end",
        "start and end",
        "2 tasks skipped",
        "2 must be served, 1 skipped",
    ]
    assert legend_lines(routes, instance) == 5 and legend_lines(routes) == 3
    flying = drawn(instance, [[0, 1]], Stage.FLYING)
    assert flying.get_legend().get_texts()[0].get_text() == "UAV 1: 2 tasks, 1.25 left"


def test_tasks_that_must_be_served_are_stars() -> None:
    """Hollow and black where they are not, in the color of their UAV where they are."""
    at = marks(drawn(whole_instance(), [[0], [2, 3], [], []]))
    star, circle = outline_of("*"), outline_of("o")
    assert at[0.0, 3.0] == [(star, rgb(UAV_COLORS[1]))]
    assert at[2.0, 0.0] == [(star, ())]
    assert at[0.0, 4.0] == [(circle, rgb(UAV_COLORS[1]))]
    assert at[5.0, 5.0] == [(circle, ())]


def test_the_legend_of_the_whole_problem_fits() -> None:
    axes = drawn(whole_instance(), [[0], [2, 3], [], []])
    axes.figure.canvas.draw()
    box, page = axes.get_legend().get_window_extent(), axes.figure.bbox
    assert 0 <= box.x0 and box.x1 <= page.width and 0 <= box.y0 and box.y1 <= page.height


def test_an_episode_with_a_start_an_end_and_service() -> None:
    """The tour of a running episode begins where the UAV is, and ends at its end."""
    instance = Instances.from_arrays([0, 0], [[0, 3], [0, 4]], None, 9.0, 1, start=[[0, 1]], end=[[0, 6]], service=[0.0, 1.0])
    env = RoutePlanningEnv(instances=instance)
    env.reset()
    env.step(1)
    assert legend_of(env)[0] == "UAV 1: 1 task, 7.00 left"
    env.step(2)
    assert legend_of(env)[0] == "UAV 1: 2 tasks, 5.00 left"
    assert lines_of(env) == [[[0.0, 1.0], [0.0, 3.0], [0.0, 4.0]]]
    env.step(0)
    assert legend_of(env)[0] == "UAV 1: 2 tasks, length 6.00"
    assert lines_of(env) == [[[0.0, 1.0], [0.0, 3.0], [0.0, 4.0], [0.0, 6.0]]]


def test_a_schedule_with_too_many_routes_is_drawn() -> None:
    """Whoever looks at it wants to see what is wrong."""
    axes = drawn(UniformGenerator(5, 2)(1, np.random.default_rng(0)), [[0], [1], [2]])
    assert axes.get_legend().get_texts()[2].get_text().startswith("UAV 3: 1 task, length")

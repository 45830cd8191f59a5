"""Pictures of running episodes, of one environment and of many."""

from __future__ import annotations

import logging
import re
import sys

import numpy as np
import pytest
from env_helpers import act, batched_env, both_levels, env_fns, legal_actions, make, play, rendered, reset
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.common.optional import install_command
from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv


@both_levels
def test_rgb_array(level: str) -> None:
    """A picture that changes from step to step and from episode to episode, the same for the same episode."""
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
    # The last step of a route only flies home, which the closed tour has shown already.
    n_distinct = len({image.tobytes() for image in first})
    assert n_distinct >= len(first) - 1
    assert all(np.array_equal(a, b) for a, b in zip(first, images(), strict=True))
    env.reset(seed=1)
    assert not np.array_equal(rendered(env), first[0])
    env.close()
    env.close()


@both_levels
def test_human_mode_without_a_display(level: str, caplog: pytest.LogCaptureFixture) -> None:
    """Says once that nothing is shown, plays on, and leaves no figure behind."""
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
    """One per row, as the single environment draws it; tiled by ``render``."""
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
    """Does not crash, and leaves no figure behind."""
    import matplotlib.pyplot as plt

    env = batched_env("routing", 2, n_tasks=4, render_mode="human")
    reset(env)
    assert env.render() is None
    env.step(legal_actions(env, np.random.default_rng(0)))
    assert env.render() is None
    env.close()
    assert plt.get_fignums() == []

"""Shared by all tests: settings, fixtures, Hypothesis strategies for instances, and small helpers."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

# Before anything imports matplotlib: tests never open a window.
os.environ["MPLBACKEND"] = "Agg"

import numpy as np
import pytest
import torch as th
from hypothesis import settings
from hypothesis import strategies as st

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.envs.allocation import UNASSIGNED
from sb3_uav.envs.problem import Dynamics

if TYPE_CHECKING:
    from classical_helpers import Ticks
    from evaluate_cli_helpers import Inputs

# Repeatable on CI; `--hypothesis-profile=explore` tries other examples.
settings.register_profile("repeatable", deadline=None, derandomize=True, print_blob=True)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("repeatable")

# With tiny tensors, more threads only slow each other down.
th.set_num_threads(1)

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="session", autouse=True)
def _sb3_logs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Otherwise, SB3's loggers create a folder per model in the system's temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("sb3_logs")))
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def small() -> Instances:
    """Three instances of 5 tasks and 2 UAVs."""
    return UniformGenerator(n_tasks=5, n_uavs=2)(3, np.random.default_rng(1))


@pytest.fixture
def instances() -> Instances:
    """Five instances of 6 tasks and 2 UAVs, in rows of 8; modules that need others override it."""
    return UniformGenerator(6, n_uavs=2)(5, np.random.default_rng(0)).pad(8)


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """A pair of zips and two files of instances, for the commands that read such files."""
    from evaluate_cli_helpers import Inputs

    return Inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture(scope="module")
def ticks() -> Iterator[Ticks]:
    """PyVRP looks at the clock once per iteration; with this one it makes 1000 iterations a second on any machine."""
    from classical_helpers import Ticks

    from sb3_uav.solvers import limits, milp, ortools_routing, pyvrp_search

    clock = Ticks()
    with pytest.MonkeyPatch.context() as patch:
        for module in (limits, milp, ortools_routing, pyvrp_search):
            patch.setattr(module, "time", clock)
        yield clock


@st.composite
def layouts(draw: st.DrawFn, n_tasks: int) -> np.ndarray:
    """A depot and ``n_tasks`` tasks, ``(n_tasks + 1, 2)``, in about the unit square: in general position, or far from it."""
    generator = np.random.default_rng(draw(seeds))
    kind = draw(st.sampled_from(["uniform", "lattice", "line", "pairs", "point"]))
    if kind == "uniform":
        return generator.random((n_tasks + 1, 2))
    if kind == "lattice":
        return generator.integers(0, 4, (n_tasks + 1, 2)) / 4
    if kind == "line":
        direction = generator.normal(size=2)
        return generator.random((n_tasks + 1, 1)) * direction / np.linalg.norm(direction)
    if kind == "pairs":
        return generator.random((3, 2))[generator.integers(0, 3, n_tasks + 1)]
    return np.repeat(generator.random((1, 2)), n_tasks + 1, axis=0)


@st.composite
def instance_batches(draw: st.DrawFn, max_tasks: int = 8, max_batch: int = 3, uniform_size: bool = False) -> Instances:
    """
    Batches of instances of every kind that is allowed: one task, coincident and collinear points, values 0, padded rows, more
    UAVs than tasks, coordinates and distances of any magnitude, and distances too short for any task.

    :param max_tasks: Largest number of tasks
    :param max_batch: Largest batch
    :param uniform_size: Whether to leave out padding
    """
    batch_size = draw(st.integers(1, max_batch))
    n_tasks = draw(st.integers(1, max_tasks))
    scale = draw(st.sampled_from([1.0, 1.0, 1e-30, 1e-3, 1e6, 1e30]))
    offset = draw(st.sampled_from([0.0, 0.0, 1.0, -1000.0]))
    points = scale * (offset + np.stack([draw(layouts(n_tasks)) for _ in range(batch_size)]))
    reach = draw(st.lists(st.sampled_from([1e-9, 0.3, 1.0, 2.0, 3.0, 40.0]), min_size=batch_size, max_size=batch_size))
    generator = np.random.default_rng(draw(seeds))
    values = None
    if draw(st.booleans()):
        values = generator.random((batch_size, n_tasks)) * 10 * (generator.random((batch_size, n_tasks)) < 0.7)
    n_real = np.full(batch_size, n_tasks) if uniform_size else generator.integers(1, n_tasks + 1, batch_size)
    return Instances.from_arrays(
        depot=points[:, 0],
        tasks=points[:, 1:],
        values=values,
        max_distance=scale * np.array(reach),
        n_uavs=draw(st.integers(1, 5)),
        task_mask=np.arange(n_tasks) < n_real[:, None],
    )


@st.composite
def whole_batches(draw: st.DrawFn, max_tasks: int = 8, max_batch: int = 3) -> Instances:
    """
    Batches of the whole problem: any of starts, ends, distances of each UAV, service costs and tasks that must be served.

    :param max_tasks: Largest number of tasks
    :param max_batch: Largest batch
    """
    plain = draw(instance_batches(max_tasks, max_batch))
    batch_size, n_tasks, n_uavs = plain.batch_size, plain.n_tasks, plain.n_uavs
    rng = np.random.default_rng(draw(seeds))
    unit = plain.max_distance.numpy()

    def near(share: float) -> np.ndarray:
        return plain.depot[:, None].numpy() + share * unit[:, None, None] * (rng.random((batch_size, n_uavs, 2)) - 0.5)

    given: dict[str, Any] = {"max_distance": unit}
    if draw(st.booleans()):
        given["start"] = near(draw(st.sampled_from([0.0, 0.5, 3.0])))
    if draw(st.booleans()):
        given["end"] = near(draw(st.sampled_from([0.0, 0.5, 3.0])))
    if draw(st.booleans()):
        given["max_distance"] = unit[:, None] * (rng.random((batch_size, n_uavs)) * (rng.random((batch_size, n_uavs)) < 0.8))
        given["max_distance"][:, 0] = unit
    if draw(st.booleans()):
        given["service"] = draw(st.sampled_from([0.01, 0.2, 2.0])) * unit[:, None] * rng.random((batch_size, n_tasks))
    if draw(st.booleans()):
        given["must_serve"] = rng.random((batch_size, n_tasks)) < 0.3
    return Instances.from_arrays(
        depot=plain.depot, tasks=plain.tasks, values=plain.values, n_uavs=n_uavs, task_mask=plain.task_mask, **given
    )


def random_legal(mask: th.Tensor, generator: np.random.Generator) -> th.Tensor:
    """
    One legal action per row, uniformly.

    :param mask: ``(..., n_actions)`` bool
    :param generator: Random generator
    :return: ``(...)`` int64
    """
    scores = th.from_numpy(generator.random(tuple(mask.shape)))
    return scores.masked_fill(~mask, -1.0).argmax(-1)


def random_assignment(
    instances: Instances, n_samples: int, generator: np.random.Generator, partial: bool = False
) -> th.Tensor:
    """
    Any UAV for every task.

    :param instances: ``batch`` instances
    :param n_samples: Allocations per instance
    :param generator: Random generator
    :param partial: Whether some tasks are left without a UAV
    :return: ``(batch, n_samples, n_tasks)`` int64
    """
    low = UNASSIGNED if partial else 0
    return th.from_numpy(generator.integers(low, instances.n_uavs, (len(instances), n_samples, instances.n_tasks)))


def play_randomly(
    dynamics: Dynamics, n_samples: int, generator: np.random.Generator, min_steps: int = 1
) -> tuple[th.Tensor, th.Tensor]:
    """
    Complete episodes of random legal actions.

    :param dynamics: Of ``batch`` instances
    :param n_samples: Episodes per instance
    :param generator: Random generator
    :param min_steps: How many steps to play even if all episodes are over
    :return: Actions ``(batch, n_samples, n_steps)`` int64, and the reward of each, float64
    """
    state = dynamics.reset(n_samples)
    actions: list[th.Tensor] = []
    rewards: list[th.Tensor] = []
    while len(actions) < min_steps or not state.done.all():
        chosen = random_legal(state.action_mask, generator)
        state, reward = dynamics.step(state, chosen)
        actions.append(chosen)
        rewards.append(reward)
    return th.stack(actions, dim=-1), th.stack(rewards, dim=-1)


@pytest.fixture
def ctrl_c_works():
    """Ctrl-C as on a terminal, here and in child processes: a suite that runs in the background may have it ignored."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)

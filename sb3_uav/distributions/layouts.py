"""Layouts of maps: where the tasks lie, and where UAVs take off and land. All in about the unit square."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

_N_CLUSTERS = 10
# Smallest and largest standard deviation around the center of a cluster.
_SPREADS = (0.005, 0.15)
# Smallest and largest width of a strip.
_WIDTHS = (0.005, 0.2)


def log_uniform(rng: np.random.Generator, low: float, high: float, size: tuple[int, ...]) -> np.ndarray:
    """
    :param rng: Random generator
    :param low: Smallest number
    :param high: Largest number
    :param size: Shape of the result
    :return: Random numbers whose logarithms are uniform
    """
    return np.exp(rng.uniform(math.log(low), math.log(high), size))


def _uniform(n_rows: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """All layouts have these parameters, and return ``(n_rows, n_tasks, 2)``."""
    return rng.random((n_rows, n_tasks, 2))


def _clustered(n_rows: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """Two to ten clusters of uneven size; every cluster is as wide as its row's spread says, or up to half as wide."""
    centers = rng.random((n_rows, _N_CLUSTERS, 2))
    exists = np.arange(_N_CLUSTERS) < rng.integers(2, _N_CLUSTERS, (n_rows, 1), endpoint=True)
    share = (rng.exponential(size=(n_rows, _N_CLUSTERS)) * exists).cumsum(1)
    cluster = (rng.random((n_rows, n_tasks, 1)) * share[:, None, -1:] > share[:, None]).sum(-1)
    spread = log_uniform(rng, *_SPREADS, (n_rows, 1)) * rng.uniform(0.5, 1.0, (n_rows, _N_CLUSTERS))
    noise = rng.normal(size=(n_rows, n_tasks, 2)) * np.take_along_axis(spread, cluster, axis=1)[..., None]
    return np.take_along_axis(centers, cluster[..., None], axis=1) + noise


def _mixed(n_rows: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """Clusters on a uniform background."""
    is_background = rng.random((n_rows, n_tasks, 1)) < rng.uniform(0.2, 0.8, (n_rows, 1, 1))
    return np.where(is_background, _uniform(n_rows, n_tasks, rng), _clustered(n_rows, n_tasks, rng))


def _lattice(n_rows: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """A grid of equal distances, up to four times as long as wide, with holes in half of the rows."""
    fill = np.where(rng.random(n_rows) < 0.5, 1.0, rng.uniform(0.4, 0.95, n_rows))
    n_columns = np.maximum(np.ceil(np.sqrt(n_tasks / fill * log_uniform(rng, 1.0, 4.0, (n_rows,)))), 2).astype(np.int64)
    n_cells = np.maximum(np.ceil(n_tasks / fill), 4).astype(np.int64)
    # A random choice of the cells, in random order.
    order = rng.random((n_rows, int(n_cells.max())))
    order[np.arange(order.shape[1]) >= n_cells[:, None]] = np.inf
    cell = order.argsort(axis=1)[:, :n_tasks]
    row, column = np.divmod(cell, n_columns[:, None])
    return np.stack([column, row], axis=-1) / (n_columns[:, None, None] - 1)


def _strip(n_rows: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """A long strip along a road or a river, straight in half of the rows."""
    along = rng.random((n_rows, n_tasks))
    across = (rng.random((n_rows, n_tasks)) - 0.5) * log_uniform(rng, *_WIDTHS, (n_rows, 1))
    bend = rng.uniform(0.05, 0.3, (n_rows, 1)) * (rng.random((n_rows, 1)) < 0.5)
    phase = rng.uniform(0.5, 2.0, (n_rows, 1)) * along + rng.random((n_rows, 1))
    return np.stack([along, 0.5 + across + bend * np.sin(2 * math.pi * phase)], axis=-1)


def _ring(n_rows: int, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """A ring, from a third of its radius to almost nothing wide; the whole of it or an arc."""
    arc = np.where(rng.random((n_rows, 1)) < 0.7, 1.0, rng.uniform(0.3, 0.8, (n_rows, 1)))
    angle = 2 * math.pi * (arc * rng.random((n_rows, n_tasks)) + rng.random((n_rows, 1)))
    radius = 0.5 * (1 - rng.random((n_rows, n_tasks)) * log_uniform(rng, 0.01, 0.33, (n_rows, 1)))
    return 0.5 + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


# Kinds of layouts, and how often each is drawn.
LAYOUTS: dict[str, tuple[Callable[[int, int, np.random.Generator], np.ndarray], float]] = {
    "uniform": (_uniform, 0.35),
    "clustered": (_clustered, 0.2),
    "mixed": (_mixed, 0.15),
    "lattice": (_lattice, 0.1),
    "strip": (_strip, 0.1),
    "ring": (_ring, 0.1),
}
# Where the depot is, and how often.
DEPOTS = {"random": 0.45, "center": 0.2, "corner": 0.2, "outside": 0.15}


def draw_tasks(layout: np.ndarray, n_tasks: int, rng: np.random.Generator) -> np.ndarray:
    """
    :param layout: ``(batch,)``, the name of each row's layout
    :param n_tasks: Number of tasks
    :param rng: Random generator
    :return: ``(batch, n_tasks, 2)``
    """
    tasks = np.empty((len(layout), n_tasks, 2))
    for name, (draw, _) in LAYOUTS.items():
        (rows,) = np.nonzero(layout == name)
        if len(rows) > 0:
            tasks[rows] = draw(len(rows), n_tasks, rng)
    return tasks


def draw_depots(kind: np.ndarray, tasks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """
    :param kind: ``(batch,)``, names of :data:`DEPOTS`
    :param tasks: ``(batch, n_tasks, 2)``
    :param rng: Random generator
    :return: ``(batch, 2)``, relative to the box around the tasks
    """
    low, high = tasks.min(1), tasks.max(1)
    inside = rng.random((len(kind), 2))
    angle = rng.uniform(0, 2 * math.pi, len(kind))
    # From the center, in box sizes: beyond its corners.
    away = 0.5 + rng.uniform(0.75, 1.25, (len(kind), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    choices = {"random": inside, "center": np.full_like(inside, 0.5), "corner": np.rint(inside), "outside": away}
    place = np.select([kind[:, None] == name for name in choices], list(choices.values()))
    # A thin box has an outside in both directions.
    size = np.where((kind == "outside")[:, None], (high - low).max(1, keepdims=True), high - low)
    return (low + high) / 2 + (place - 0.5) * size


def places_among(tasks: np.ndarray, n_places: int, rng: np.random.Generator) -> np.ndarray:
    """
    :param tasks: ``(batch, n_tasks, 2)``
    :param n_places: How many places
    :param rng: Random generator
    :return: ``(batch, n_places, 2)``, uniform in the box around the tasks
    """
    low, high = tasks.min(1)[:, None], tasks.max(1)[:, None]
    return low + rng.random((len(tasks), n_places, 2)) * (high - low)

"""Kinds of task values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# A task "far out" is one of this part of the tasks, those farthest from the depot.
_FAR_PART = 0.1
# Values of heavy tails are cut at this multiple of the median, or one task would be all that counts.
_LARGEST = 1e3


def _unit(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """All kinds have these parameters, ``(n_rows, n_tasks)`` distances to the depot first, and return such an array."""
    return np.ones_like(home)


def _to_10(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(1, 10, home.shape, endpoint=True).astype(np.float64)


def _to_100(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(1, 100, home.shape, endpoint=True).astype(np.float64)


def _lognormal(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.minimum(np.exp(rng.normal(size=home.shape) * rng.uniform(0.5, 1.5, (len(home), 1))), _LARGEST)


def _pareto(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Between a tail without a mean and one with a variance."""
    return np.minimum((1 - rng.random(home.shape)) ** (-1 / rng.uniform(0.9, 3.0, (len(home), 1))), _LARGEST)


def _distance(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Whole numbers of 1 to 100 that grow with the distance to the depot, as in benchmarks of the orienteering problem."""
    return 1.0 + np.floor(99 * home / np.maximum(home.max(1, keepdims=True), 1e-12))


def _dear(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Small values, and one task far out that is worth a tenth to all of the others together."""
    values = np.where(rng.random((len(home), 1)) < 0.5, _unit(home, rng), _to_10(home, rng))
    n_far = max(round(_FAR_PART * home.shape[1]), 1)
    rank = rng.integers(n_far, size=len(home))
    rows = np.arange(len(home))
    values[rows, (-home).argsort(1, kind="stable")[rows, rank]] += rng.uniform(0.1, 1.0, len(home)) * values.sum(1)
    return values


def _urgent(home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """
    A few tasks, one of which is worth more than all others together: what tasks that must be served become, see
    :attr:`~sb3_uav.envs.instances.Instances.prizes`.
    """
    values = np.where(rng.random((len(home), 1)) < 0.5, _unit(home, rng), _to_10(home, rng))
    is_urgent = rng.random(home.shape) < rng.uniform(0.01, 0.15, (len(home), 1))
    return values + is_urgent * (2 * values.sum(1, keepdims=True))


# Kinds of values, and how often each is drawn.
VALUES: dict[str, tuple[Callable[[np.ndarray, np.random.Generator], np.ndarray], float]] = {
    "unit": (_unit, 0.35),
    "to_10": (_to_10, 0.15),
    "to_100": (_to_100, 0.1),
    "lognormal": (_lognormal, 0.1),
    "pareto": (_pareto, 0.08),
    "distance": (_distance, 0.1),
    "dear": (_dear, 0.06),
    "urgent": (_urgent, 0.06),
}


def draw_values(kind: np.ndarray, home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """
    :param kind: ``(batch,)``, names of :data:`VALUES`
    :param home: ``(batch, n_tasks)``, distance of every task to the depot
    :param rng: Random generator
    :return: ``(batch, n_tasks)``, with a mean of 1, so that returns of all rows have a similar magnitude
    """
    values = np.ones_like(home)
    for name, (draw, _) in VALUES.items():
        (rows,) = np.nonzero(kind == name)
        if len(rows) > 0:
            drawn = draw(home[rows], rng)
            values[rows] = drawn / drawn.mean(1, keepdims=True)
    return values

"""Named random streams and seeds, so that a resumed run draws the same numbers as an uninterrupted one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

# Names of streams. They are independent of each other and of generators that are seeded with a plain number.
TRAINING_STREAM, HELD_OUT_STREAM, ACTION_STREAM, SUBSET_STREAM, FIXED_SET_STREAM, FIXED_SET_ACTION_STREAM = range(6)
WARM_START_STREAM = 6

# Seeds outside training, far from the seeds that users choose and from those that follow them.
# Offset between the seeds of the training environments and those of the evaluation environments.
EVALUATION_SEED = 1_000_003
# Instances that solvers are tested on.
TEST_SEED = 20_000_003
# Instances of SizeGridCallback.
GRID_SEED = 30_000_001
# Instances of benchmarks/ablation.py.
ABLATION_SEED = 40_000_001
# Instances of `sb3-uav reproduce`, which nothing else may use: no campaign has chosen a network or a setting by them.
REPRODUCTION_SEED = 60_000_011
# Validation set and trained router that all runs of a comparison share.
SHARED_SEED = 0
# The instance on which the compiled kernels of local search are loaded.
WARM_UP_SEED = 0


def random_stream(seed: int, *key: int) -> np.random.Generator:
    """
    :param seed: The seed of a run
    :param key: Stream and counters
    :return: A generator that depends on seed and key only
    """
    # Not default_rng([seed, *key]): it ignores trailing zeros, so that [0, 0] and 0 would give the same numbers.
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def keyed_generator(*key: int) -> np.random.Generator:
    """
    Random numbers for solvers and test sets. Published results depend on them; use :func:`random_stream` for anything new.

    Trailing zeros of the key are ignored, so keys for the same purpose must have the same length.

    :param key: Seed and counters
    :return: A generator that depends on the key only
    """
    return np.random.default_rng(list(key))


def mixed_state(*key: int) -> np.uint64:
    """
    :param key: Seed and counters, as for :func:`keyed_generator`
    :return: 64 well-mixed bits, the initial state of a generator that is not numpy's
    """
    return np.random.SeedSequence(list(key)).generate_state(1, np.uint64)[0]


def torch_generator(rng: np.random.Generator, device: th.device | str) -> th.Generator:
    """
    :param rng: Source of the seed; one number is drawn from it
    :param device: Device on which random numbers are needed
    :return: A generator for PyTorch's sampling functions on this device
    """
    return th.Generator(device).manual_seed(int(rng.integers(2**63 - 1)))


class PartGenerator(th.Generator):
    """
    A generator for some rows of a batch, which get the numbers that they would get if all rows were there.

    So the actions of a batch do not depend on how many processes share it.
    """

    rows: slice
    n_rows: int

    @classmethod
    def of(cls, generator: th.Generator, rows: slice, n_rows: int) -> PartGenerator:
        """
        :param generator: A generator for the whole batch
        :param rows: The rows that are there
        :param n_rows: Number of rows of the whole batch
        :return: A generator in the state of the other, for these rows
        """
        part = cls(generator.device)
        part.set_state(generator.get_state())
        part.rows, part.n_rows = rows, n_rows
        return part


def exponential_noise(like: th.Tensor, generator: th.Generator | None) -> th.Tensor:
    """
    :param like: ``(batch, ...)``
    :param generator: Source of randomness, on the same device
    :return: Exponentially distributed numbers of the same shape
    """
    if not isinstance(generator, PartGenerator):
        return th.empty_like(like).exponential_(generator=generator)
    return like.new_empty((generator.n_rows, *like.shape[1:])).exponential_(generator=generator)[generator.rows]


def draw_seed() -> int:
    """
    :return: A seed below 2**32 that differs from call to call, independent of the state of the global generators
    """
    return int(np.random.SeedSequence().generate_state(1)[0])


def stream_seed(model: Any) -> int:
    """
    The seed of an algorithm's random streams: the algorithm's own seed, or one drawn at the first call if it has none.

    It is kept in ``model.stream_seed``, a plain number that SB3 saves in the zip, so that a resumed run has the same streams.

    :param model: Any SB3 algorithm
    :return: The seed
    """
    if getattr(model, "stream_seed", None) is None:
        model.stream_seed = draw_seed() if model.seed is None else model.seed
    return model.stream_seed

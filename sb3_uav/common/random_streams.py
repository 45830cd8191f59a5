"""Random numbers by name instead of by state, so that a resumed run draws what an unbroken one would have drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

# Which numbers are drawn. The streams are disjoint, from each other and from generators that were seeded with a plain number.
TRAINING_STREAM, HELD_OUT_STREAM, ACTION_STREAM, SUBSET_STREAM, FIXED_SET_STREAM, FIXED_SET_ACTION_STREAM = range(6)
WARM_START_STREAM = 6

# Seeds of what is not a part of training, far from the seeds that users give and from those that follow them.
# Added to the seed of the training environments; the rows of the evaluation environment take the seeds that follow.
EVALUATION_SEED = 1_000_003
# Instances that solvers are tested on.
TEST_SEED = 20_000_003
# Instances of SizeGridCallback.
GRID_SEED = 30_000_001
# Instances of benchmarks/ablation.py.
ABLATION_SEED = 40_000_001
# What all runs of a comparison share: its validation set and the router that it trains.
SHARED_SEED = 0


def random_stream(seed: int, *key: int) -> np.random.Generator:
    """
    :param seed: The seed of a run
    :param key: Stream and counters
    :return: A generator that depends on nothing else
    """
    # Not default_rng([seed, *key]): trailing zeros would not count there, so that [0, 0] and 0 give the same numbers.
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def torch_generator(rng: np.random.Generator, device: th.device | str) -> th.Generator:
    """
    :param rng: Source of the seed; one number is drawn from it
    :param device: Where random numbers are needed
    :return: A generator that PyTorch's sampling functions accept on this device
    """
    return th.Generator(device).manual_seed(int(rng.integers(2**63 - 1)))


def draw_seed() -> int:
    """
    :return: A seed that differs from call to call, whatever the state of the global generators
    """
    return int(np.random.SeedSequence().generate_state(1)[0])


def stream_seed(model: Any) -> int:
    """
    The seed of an algorithm's random streams, drawn at the first call if the algorithm has none.

    It is kept in ``model.stream_seed``, a plain number that SB3 saves in the zip, so that a resumed run has the same streams.

    :param model: Any SB3 algorithm
    :return: The seed
    """
    if getattr(model, "stream_seed", None) is None:
        model.stream_seed = draw_seed() if model.seed is None else model.seed
    return model.stream_seed

"""Random numbers by name instead of by state, so that a resumed run draws what an unbroken one would have drawn."""

from __future__ import annotations

import numpy as np

# Which numbers are drawn. The streams are disjoint, from each other and from generators that were seeded with a plain number.
TRAINING_STREAM, HELD_OUT_STREAM, ACTION_STREAM, SUBSET_STREAM, FIXED_SET_STREAM, FIXED_SET_ACTION_STREAM = range(6)
WARM_START_STREAM = 6


def random_stream(seed: int, *key: int) -> np.random.Generator:
    """
    :param seed: The seed of a run
    :param key: Stream and counters
    :return: A generator that depends on nothing else
    """
    # Not default_rng([seed, *key]): trailing zeros would not count there, so that [0, 0] and 0 give the same numbers.
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))

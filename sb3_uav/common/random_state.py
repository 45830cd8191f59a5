"""Keeping the global random generators as they are."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def undisturbed_random_state() -> Iterator[None]:
    """Undo what happens to the global generators inside, such as the seeding by an algorithm's constructor."""
    states = random.getstate(), np.random.get_state()
    try:
        with th.random.fork_rng():
            yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])

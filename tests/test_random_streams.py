"""Seeds and random streams."""

from typing import Any

import numpy as np
import pytest
import torch as th
from reinforce_models import make_model
from stable_baselines3 import A2C, PPO

from sb3_uav.common.random_streams import (
    TEST_SEED,
    draw_seed,
    keyed_generator,
    mixed_state,
    random_stream,
    stream_seed,
    torch_generator,
)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_unseeded_algorithms_have_different_stream_seeds_that_their_zips_keep(algorithm, tmp_path):
    """Whatever the state of the global generators."""
    models: list[Any] = []
    for _ in range(2):
        np.random.seed(0)
        th.manual_seed(0)
        models.append(algorithm("MlpPolicy", "CartPole-v1", device="cpu"))
    seeds = [stream_seed(model) for model in models]
    assert seeds[0] != seeds[1]
    assert [stream_seed(model) for model in models] == seeds
    models[0].save(tmp_path / "model")
    assert stream_seed(algorithm.load(tmp_path / "model")) == seeds[0]


def test_the_stream_seed_of_a_seeded_algorithm_is_its_seed():
    assert stream_seed(PPO("MlpPolicy", "CartPole-v1", seed=5, device="cpu")) == 5
    assert stream_seed(make_model(seed=7)) == 7
    first, second = make_model(seed=None), make_model(seed=None)
    assert stream_seed(first) == first.stream_seed != stream_seed(second)


def test_drawn_seeds_fit_every_generator():
    seeds = {draw_seed() for _ in range(20)}
    assert len(seeds) == 20 and all(0 <= seed < 2**32 for seed in seeds)


def test_streams_differ_by_every_part_of_their_name():
    """Trailing zeros count too, and no stream is that of a generator with the plain seed."""
    keys = [(0, 0), (0, 0, 0), (0, 1), (0, 1, 0), (1, 0)]
    draws = [random_stream(*key).integers(2**63 - 1) for key in keys]
    plain = [np.random.default_rng(seed).integers(2**63 - 1) for seed in (0, 1)]
    assert len({*draws, *plain}) == len(keys) + 2
    assert random_stream(0, 1).integers(2**63 - 1) == draws[2]


def test_torch_generators_follow_their_source():
    one, two, other = (th.rand(3, generator=torch_generator(random_stream(0, key), "cpu")) for key in (0, 0, 1))
    assert th.equal(one, two) and not th.equal(one, other)


def test_numbers_of_solvers_and_test_sets_stay_what_published_results_were_made_with():
    assert (
        keyed_generator(5, 2).integers(1000, size=4).tolist() == np.random.default_rng([5, 2]).integers(1000, size=4).tolist()
    )
    assert keyed_generator(TEST_SEED).integers(1000, size=4).tolist() == [756, 848, 188, 851]
    assert mixed_state(0) == 15793235383387715774

"""The router's training instances."""

from typing import Any

import numpy as np
import pytest
import torch as th
from its_runs import N_ENVS, N_TASKS, N_UAVS, SMALL, make_allocator

from sb3_uav.envs import (
    BatchedVecEnv,
    Instances,
    MixtureGenerator,
    TaskAllocationEnv,
    UniformGenerator,
    WorldGenerator,
)
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training.subsets import AllocatedSubsets, WholeInstances

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")


def make_subsets(fraction: float, n_batches: int = 3, **kwargs) -> tuple[AllocatedSubsets, Any]:
    model = make_allocator(**kwargs)
    subsets = AllocatedSubsets(
        model.policy,
        model.problem.generator,
        model.draw_batch,
        range(n_batches),
        fraction,
        lambda chunk: np.random.default_rng(chunk),
    )
    return subsets, model


def points(instances: Instances) -> set[tuple[float, float]]:
    return {tuple(point) for point in instances.tasks[instances.task_mask].tolist()}


def test_intensive_data_are_all_subsets_of_the_epochs_instances():
    """One pass gives every task of the epoch's instances to exactly one subset, with its own depot and D."""
    subsets, model = make_subsets(1.0)
    rng = np.random.default_rng(0)
    drawn = Instances.concatenate([subsets(4, rng) for _ in range(3 * N_ENVS * N_UAVS // 4)])
    originals = Instances.concatenate([model.draw_batch(i) for i in range(3)])
    assert len(drawn) == 3 * N_ENVS * N_UAVS and drawn.n_uavs == 1
    assert int(drawn.task_mask.sum()) == 3 * N_ENVS * N_TASKS and points(drawn) == points(originals)
    depots = [tuple(depot) for depot in drawn.depot.tolist()]
    for i in range(len(originals)):
        rows = [j for j, depot in enumerate(depots) if depot == tuple(originals.depot[i].tolist())]
        assert len(rows) == N_UAVS
        assert points(drawn[rows]) == points(originals[i])
    assert (drawn.max_distance == 1.5).all()
    # Shuffled: the subsets of an instance do not follow each other.
    assert depots != sorted(depots, key=depots.index)


def test_alternate_data_are_a_random_part():
    subsets, _ = make_subsets(1 / N_UAVS)
    drawn = subsets(3 * N_ENVS, np.random.default_rng(0))
    assert len(drawn) == 3 * N_ENVS
    # A fixed UAV per instance would give every depot once.
    assert len({tuple(depot) for depot in drawn.depot.tolist()}) < 3 * N_ENVS


def test_subsets_follow_the_current_allocator():
    subsets, model = make_subsets(1.0, policy_kwargs=dict(SMALL, shared_scorer=False))
    model.policy.action_net.bias.data = th.tensor([50.0, -50.0])
    sizes = subsets(8, np.random.default_rng(0)).task_mask.sum(1)
    assert set(sizes.tolist()) <= {0, N_TASKS} and N_TASKS in sizes


def test_held_out_subsets_are_not_training_subsets():
    subsets, _ = make_subsets(1.0)
    held_out = subsets.held_out(7, np.random.default_rng(5))
    assert len(held_out) == 7 and held_out.n_uavs == 1
    assert not points(held_out) & points(subsets(3 * N_ENVS * N_UAVS, np.random.default_rng(0)))


def test_pretraining_instances_are_whole():
    generator = WholeInstances(UniformGenerator(6, 4, 1.5))
    drawn = generator(3, np.random.default_rng(0))
    assert (drawn.n_tasks, drawn.n_uavs, generator.n_uavs) == (6, 1, 1)
    assert th.equal(drawn.tasks, UniformGenerator(6, 4, 1.5)(3, np.random.default_rng(0)).tasks)


MIXTURE = MixtureGenerator(60, 3, min_tasks=24)


def make_mixture(generator: Any = MIXTURE) -> tuple[AllocatedSubsets, Any]:
    env = BatchedVecEnv([lambda: TaskAllocationEnv(60, 3, distribution="mixture")] * 8)
    model: Any = REINFORCE(AllocatorPolicy, env, seed=0, device="cpu", policy_kwargs=SMALL, instances_per_epoch=8)
    env.set_generator(generator)
    stream = np.random.default_rng
    return AllocatedSubsets(model.policy, generator, model.draw_batch, range(5), 1.0, lambda chunk: stream(chunk)), model


@pytest.mark.parametrize("generator", [MIXTURE, WorldGenerator(60, 3, min_tasks=24, whole_share=0.0)])
def test_mixed_subsets_come_from_one_batch_each(generator):
    """So that small ones are not padded to large ones; of small ones there are more."""
    subsets, model = make_mixture(generator)
    batches = [model.draw_batch(i) for i in range(5)]
    assert len({(batch.n_tasks, batch.n_uavs) for batch in batches}) > 1
    rng = np.random.default_rng(0)
    for _ in range(10):
        drawn = subsets.training_batch(6, rng)
        owners = [i for i, batch in enumerate(batches) if points(drawn) <= points(batch)]
        assert len(owners) == 1 and drawn.n_uavs == 1
        assert 2 <= len(drawn) <= 6 * 24 and drawn.task_mask.any(0).all()


def test_updates_of_a_mixture_have_one_size_each():
    """An epoch is over after its number of instances, not of batches."""
    _, model = make_mixture()
    model.learn_instances(20)
    batches = [len(model.draw_batch(i)) for i in range(model.n_batches)]
    assert model.n_instances == sum(batches) >= 20 > sum(batches[:-1]) and len(set(batches)) > 1

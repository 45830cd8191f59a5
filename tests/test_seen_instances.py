"""One encoding of an instance serves all sweeps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from solver_helpers import make_pair, make_policy

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.envs.symmetries import reflect
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.solvers.seen_instances import SeenInstance, View

VIEWS = [View(0, 0), View(0, 3), View(5, 1), View(5, 2)]


def draw(n: int, n_tasks: int = 30) -> Instances:
    return UniformGenerator(n_tasks, 3)(n, np.random.default_rng(0))


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("padding", [0, 4])
def test_logits_are_those_of_an_encoding_in_that_order(preset: str, padding: int) -> None:
    policy = make_policy(AllocatorPolicy, 3, preset=preset)
    instances = draw(5).pad(30 + padding)
    order = th.cat([policy.task_order(instances[row], row + 1) for row in range(5)])
    rng = np.random.default_rng(1)
    if preset == "paper":
        order = th.from_numpy(np.stack([np.append(rng.permutation(30), np.arange(30, 30 + padding)) for _ in range(5)]))
    arranged = instances.reorder(order)
    actions = th.from_numpy(rng.integers(0, 3, (5, 4, 30 + padding)))
    shared = policy.arranged_cache(policy.encode_nodes(instances), order, arranged)
    with th.no_grad():
        found = policy.evaluate_episodes(arranged, actions, shared).log_prob
        expected = policy.evaluate_episodes(arranged, actions).log_prob
        other = policy.evaluate_episodes(instances, actions).log_prob
    th.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    assert (found - other).abs().max() > 1e-3


def test_views_are_what_the_allocator_would_see() -> None:
    policy, instance = make_policy(AllocatorPolicy), draw(1)
    shown = SeenInstance(policy, instance).show(VIEWS)
    assert shown.symmetry.tolist() == [0, 0, 5, 5]
    for i, view in enumerate(VIEWS):
        seen = reflect(instance, view.symmetry)
        order = policy.task_order(seen, view.sweep)
        assert th.equal(shown.order[i : i + 1], order) and th.equal(shown.reflected[i : i + 1][0].tasks, seen.tasks)
        assert th.equal(shown.instances[i].tasks, seen.reorder(order).tasks)
        expected = policy.encode(seen.reorder(order))
        th.testing.assert_close(shown.cache.rows(th.tensor([i])).nodes, expected.nodes, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("decode", "samples", "n_encoded"), [("sampling", 130, 1), ("augment", 60, 8)])
def test_instances_are_encoded_once_for_each_symmetry(decode: str, samples: int, n_encoded: int) -> None:
    pair = make_pair(decode=decode, samples=samples)
    pair.allocator.features_extractor.n_encoded_rows = 0
    pair.solve(draw(3))
    assert pair.allocator.features_extractor.n_encoded_rows == 3 * n_encoded


@pytest.mark.parametrize("decode", ["sampling", "augment"])
def test_schedules_are_those_without_sharing(decode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pair, instances = make_pair(decode=decode, samples=40), draw(4)
    found = pair.solve(instances, seed=1)

    def encode_again(nodes: th.Tensor, order: th.Tensor, arranged: Instances) -> Any:
        return pair.allocator.encode(arranged)

    with th.no_grad():
        monkeypatch.setattr(pair.allocator, "arranged_cache", encode_again)
        plan = pair.router.plan
        # Without the mark, every subset is planned.
        monkeypatch.setattr(pair.router, "plan", lambda *args: plan(*args))
        expected = pair.solve(instances, seed=1)
    assert [result.schedule for result in found] == [result.schedule for result in expected]


def test_encoding_is_in_evaluation_mode() -> None:
    """Statistics of batch normalization are not touched, and do not depend on the batch."""
    policy = make_policy(AllocatorPolicy, 3, preset="paper")
    before = {name: buffer.clone() for name, buffer in policy.named_buffers()}
    policy.set_training_mode(True)
    policy.encode_nodes(draw(2))
    assert before and all(th.equal(before[name], buffer) for name, buffer in policy.named_buffers())

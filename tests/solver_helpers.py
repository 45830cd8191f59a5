"""What the tests of solvers share: tiny networks, and what the checker says of their schedules."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_uav.envs import Instances, check_schedule
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.solvers import DLDRL, KMeansAM, Solver

TINY = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)

# So many samples that augmentation keeps some back.
MANY = 40


def make_policy(policy_class: Any, n_uavs: int | None = None, **kwargs: Any) -> Any:
    th.manual_seed(0)
    policy = policy_class(*policy_class.placeholder_spaces(n_uavs), lambda _: 1e-3, **{**TINY, **kwargs})
    policy.set_training_mode(False)
    return policy


def make_pair(n_uavs: int = 3, **kwargs: Any) -> DLDRL:
    return DLDRL(make_policy(AllocatorPolicy, n_uavs), make_policy(RouterPolicy), **kwargs)


def make_kmeans_am(**kwargs: Any) -> KMeansAM:
    return KMeansAM(make_policy(RouterPolicy), **kwargs)


def objectives(solver: Solver, instances: Instances, seed: int = 0) -> np.ndarray:
    results = solver.solve(instances, seed=seed)
    assert len(results) == len(instances)
    return np.array([check_schedule(instances, row, result.schedule).objective for row, result in enumerate(results)])


def routes(solver: Solver, instances: Instances, seed: int = 0) -> list[tuple[tuple[int, ...], ...]]:
    return [result.schedule.routes for result in solver.solve(instances, seed=seed)]

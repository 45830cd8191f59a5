"""What a policy achieves on a fixed set of instances."""

from __future__ import annotations

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

from sb3_uav.common.random_streams import FIXED_SET_ACTION_STREAM, FIXED_SET_STREAM, random_stream, torch_generator
from sb3_uav.envs.instance_checks import require_finite_instances
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.envs.vec_env import BatchedVecEnv, unwrap_problem_env
from sb3_uav.policies import EpisodicPolicy
from sb3_uav.training.fixed_set_history import FixedSetResult

# Number of instances decoded at once: the smaller of the paper's batch sizes.
_CHUNK_ROWS = 256


def draw_fixed_set(problem: Problem, n_instances: int, seed: int) -> Instances:
    """
    :param problem: The problem that the instances are for
    :param n_instances: Number of instances
    :param seed: Seed for drawing them. No training draws the same instances, whatever its seed
    :return: The instances, on the CPU
    :raises ValueError: If a number in them is NaN or infinite
    """
    instances = problem.generator(n_instances, random_stream(seed, FIXED_SET_STREAM))
    require_finite_instances(instances, problem.generator)
    return instances


def evaluate_fixed_set(
    policy: EpisodicPolicy, problem: Problem, instances: Instances, n_samples: int, seed: int = 0
) -> FixedSetResult:
    """
    Play every instance once greedily and ``n_samples`` times by sampling, with the fused driver.

    Global random states and the policy's mode stay as they are; the samples come from the same numbers every time.

    :param policy: The policy
    :param problem: The problem; its router, if any, plans the tours
    :param instances: The set, on the CPU
    :param n_samples: Samples per instance; 0 for none
    :param seed: Seed for sampling
    :return: Its returns
    """
    was_training = policy.training
    policy.set_training_mode(False)
    try:
        fitting = policy.rows_that_fit(instances.n_tasks + 1, max(n_samples, 1) * instances.n_uavs)
        parts = []
        for rows in th.arange(len(instances), device="cpu").split(min(_CHUNK_ROWS, fitting)):
            first = int(rows[0])
            parts.append(_evaluate_chunk(policy, problem, instances[rows], n_samples, seed, first))
    finally:
        policy.set_training_mode(was_training)
    return FixedSetResult(*(np.concatenate(field) for field in zip(*parts, strict=True)))


@th.no_grad()
def _evaluate_chunk(
    policy: EpisodicPolicy, problem: Problem, instances: Instances, n_samples: int, seed: int, first: int
) -> FixedSetResult:
    """
    :param first: Index of the first of these instances in the set
    """
    part = policy.arrange(instances).to(policy.device)
    cache = policy.encode(part)
    greedy = policy.decode_episodes(part, cache=cache)
    returns, lengths = problem.returns(part, greedy)[:, 0], problem.lengths(part, greedy)[:, 0]
    best = returns[:0]
    if n_samples > 0:
        generator = torch_generator(random_stream(seed, FIXED_SET_ACTION_STREAM, first), policy.device)
        sampled = policy.decode_episodes(part, n_samples, False, generator, cache)
        best = problem.returns(part, sampled).amax(1)
    return FixedSetResult(returns.cpu().numpy(), lengths.cpu().numpy(), best.cpu().numpy())


def evaluated_problem(env: VecEnv) -> Problem | None:
    """
    :param env: The training environment of an algorithm
    :return: The problem behind it; None if it is not one of ours, or if its observations are changed
    """
    while isinstance(env, VecMonitor) or (isinstance(env, VecNormalize) and not env.norm_obs):
        env = env.venv
    if isinstance(env, BatchedVecEnv):
        return env.problem
    if isinstance(env, DummyVecEnv):
        row = unwrap_problem_env(env.envs[0])
        return None if row is None else row.problem
    return None


def fingerprint(instances: Instances, n_samples: int) -> str:
    """
    :param instances: Instances
    :param n_samples: Samples per instance
    :return: A name for the evaluation on these
    """
    return instances.digest(repr((instances.tasks.shape, instances.n_uavs, n_samples)))[:16]

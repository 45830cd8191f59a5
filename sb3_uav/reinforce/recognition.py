"""Finding the problem behind an algorithm's environment, so that whole episodes can be played without stepping it."""

from __future__ import annotations

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from sb3_uav.envs.problem import Problem
from sb3_uav.envs.vec_env import BatchedVecEnv, unwrap_problem_env


def find_problem(env: VecEnv) -> Problem | None:
    """
    :param env: The environment of an algorithm
    :return: The problem behind it; None if it is not one of ours, or wrapped in something that changes what it does
    """
    while isinstance(env, VecMonitor):
        env = env.venv
    if isinstance(env, BatchedVecEnv):
        return env.problem
    if isinstance(env, DummyVecEnv):
        problem_envs = [unwrap_problem_env(row) for row in env.envs]
        problems = [row.problem for row in problem_envs if row is not None]
        # One problem stands for all rows only if all rows have the same instances and rewards.
        kinds = [(problem.generator, getattr(problem, "router", None)) for problem in problems]
        if len(problems) == len(problem_envs) and all(kind == kinds[0] for kind in kinds):
            return problems[0]
    return None

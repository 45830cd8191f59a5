"""Finds the problem behind an algorithm's environment, so that whole episodes can be played without stepping it."""

from __future__ import annotations

from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv, VecMonitor

from sb3_uav.envs.gym_env import ProblemEnv
from sb3_uav.envs.problem import Problem
from sb3_uav.envs.vec_env import BatchedVecEnv, strip_wrappers, unwrap_problem_env

# Wrappers that leave observations, actions and rewards as they are.
_TRANSPARENT_VEC_WRAPPERS = (VecMonitor, VecCheckNan)


def find_problem(env: VecEnv) -> Problem | None:
    """
    :param env: The environment of an algorithm
    :return: The problem behind it; None if it is not an environment of this package, or if a wrapper may change its behavior
    """
    found = _recognize(env)
    return found if isinstance(found, Problem) else None


def why_unrecognized(env: VecEnv) -> str:
    """
    :param env: An environment for which :func:`find_problem` returns None
    :return: The reason, a clause without a period; empty if there is a problem
    """
    found = _recognize(env)
    return found if isinstance(found, str) else ""


def _recognize(env: VecEnv) -> Problem | str:
    """:return: The problem, or the reason why there is none"""
    inner = env
    while isinstance(inner, _TRANSPARENT_VEC_WRAPPERS):
        inner = inner.venv
    if isinstance(inner, BatchedVecEnv):
        return inner.problem
    if not isinstance(inner, DummyVecEnv):
        wrapper = "" if inner is inner.unwrapped else ", which may change observations or rewards"
        return f"the environment is a {type(inner).__name__}{wrapper}"
    problems: list[Problem] = []
    for row in inner.envs:
        problem_env = unwrap_problem_env(row)
        if problem_env is None:
            return _obstacle(row)
        problems.append(problem_env.problem)
    # One problem can represent all rows only if all rows have the same instances and rewards.
    first = problems[0]
    for number, other in enumerate(problems):
        rows = f"rows 0 and {number} of the {type(inner).__name__}"
        if type(other) is not type(first):
            return f"{rows} are {type(first).__name__} and {type(other).__name__}"
        if other.generator != first.generator:
            return (
                f"{rows} draw different instances "
                f"({type(first.generator).__name__} and {type(other.generator).__name__} are not equal)"
            )
        if getattr(other, "router", None) != getattr(first, "router", None):
            return f"{rows} have different routers (env_method('set_router', router) gives all the same)"
        if other.reward != first.reward:
            return f"{rows} have different rewards"
    return first


def _obstacle(row: object) -> str:
    """The reason why an environment is not recognized as one of this package."""
    inner = strip_wrappers(row)  # type: ignore[arg-type]
    name = type(inner).__name__
    if isinstance(inner.unwrapped, ProblemEnv) and inner is not inner.unwrapped:
        return f"the wrapper {name} may change observations or rewards"
    if isinstance(inner, ProblemEnv):
        return f"{name} overrides step or reset"
    return f"{name} is not an environment of sb3_uav"

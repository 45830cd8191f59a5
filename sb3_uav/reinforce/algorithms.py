"""Names of on-policy algorithms."""

from __future__ import annotations

from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_uav.common.imports import import_object
from sb3_uav.reinforce import REINFORCE

ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {
    "reinforce": REINFORCE,
    "ppo": PPO,
    "ppo_mask": MaskablePPO,
    "a2c": A2C,
}


def resolve_algorithm(name: str, what: str = "router: algo") -> type[OnPolicyAlgorithm]:
    """
    :param name: ``reinforce``, ``ppo``, ``ppo_mask``, ``a2c`` or a dotted path
    :param what: Where it was given, as errors name it
    :return: The class of the algorithm
    :raises ValueError: If there is no such on-policy algorithm
    """
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    try:
        algorithm = import_object(name)
    except ValueError as error:
        choices = ", ".join(ALGORITHMS)
        raise ValueError(f"{what} is {name!r:.80}; choose one of {choices} or give a dotted path.") from error
    if not (isinstance(algorithm, type) and issubclass(algorithm, OnPolicyAlgorithm)):
        raise ValueError(f"{what} {name!r} is not an on-policy algorithm of SB3.")
    return algorithm

"""What a policy does with an instance, as a picture."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem, Stage
from sb3_uav.envs.render import MapFigure
from sb3_uav.policies.base import EpisodicPolicy


def greedy_map(policy: EpisodicPolicy, problem: Problem, instance: Instances) -> np.ndarray:
    """
    Draw the greedy schedule of an instance. Global random states and the policy's mode stay as they are.

    :param policy: The policy
    :param problem: The problem; its router, if any, plans the tours
    :param instance: A batch of one, on the CPU
    :return: ``(height, width, 3)`` uint8, with the objective in the title
    :raises ImportError: If matplotlib is not installed
    """
    n_tasks = int(instance.task_mask.sum())
    was_training = policy.training
    policy.set_training_mode(False)
    try:
        with th.no_grad():
            arranged = policy.arrange(instance.trim(max(n_tasks, 1)))
            part = arranged.to(policy.device)
            actions = policy.decode_episodes(part)
            objective = float(problem.returns(part, actions))
            routes = problem.routes(arranged, actions[0, 0].tolist())
    finally:
        policy.set_training_mode(was_training)
    figure = MapFigure()
    total = float(instance.prizes[instance.task_mask].sum())
    figure.draw_routes(arranged, routes, Stage.FINISHED, f"greedy: objective {objective:g} of {total:g}")
    return figure.rgb_array()

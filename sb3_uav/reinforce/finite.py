"""Stops training before an update with numbers that are not finite, under any algorithm of SB3."""

from __future__ import annotations

import math
from typing import Any
from weakref import ref

import torch as th

from sb3_uav.common.divergence import SMALLER_STEPS, diverged, first_bad, largest, report_weights

# An attribute of an optimizer that is watched already.
_WATCHED = "_watched_for_divergence"
# What to train with when the numbers come from the environment.
_FINITE_REWARDS = "finite rewards: look at the reward, the router and the instances of the environment"
# Arrays of SB3's rollout buffers, in the order in which a bad number passes through them.
_BUFFER_FIELDS = {"rewards": "reward", "values": "value estimate", "returns": "return", "advantages": "advantage"}


def require_finite(model: Any, remedy: str = SMALLER_STEPS, **values: th.Tensor) -> None:
    """
    :param model: An algorithm before an update
    :param remedy: What to train with instead
    :param values: Numbers, by the name that the error gives them, with underscores for spaces
    :raises DivergenceError: If a number is infinite or NaN
    """
    for name, value in values.items():
        bad = first_bad(value)
        if bad is not None:
            raise diverged(model, name.replace("_", " "), bad, remedy)


def require_possible_rate(model: Any, optimizer: th.optim.Optimizer) -> None:
    """
    :param model: An algorithm before an update
    :param optimizer: Its optimizer
    :raises DivergenceError: If a learning rate is so large that the step is infinite in float32
    """
    for group in optimizer.param_groups:
        # The first steps of Adam are larger than the rate.
        if not float(group["lr"]) * 1e3 < th.finfo(th.float32).max:
            raise diverged(model, "learning rate", float(group["lr"]))


def require_finite_returns(model: Any, returns: th.Tensor) -> None:
    """
    :param model: An algorithm
    :param returns: Returns of the episodes that it has just played
    :raises DivergenceError: If one is infinite or NaN
    """
    require_finite(model, _FINITE_REWARDS, **{"return": returns})


def watch(model: Any) -> None:
    """
    Check every update of an algorithm of SB3: its gradients before, so that the weights never become NaN, and its weights
    after. ``REINFORCE`` does so by itself. Watching twice changes nothing, and neither does saving or copying the model.

    :param model: Any algorithm, whose later updates raise a
        :class:`~sb3_uav.common.divergence.DivergenceError` if a gradient or a weight is not finite
    """
    if getattr(model, "checks_its_updates", False):
        return
    # No cycle: a model that nobody uses any more is freed at once.
    watched = ref(model)

    def before(optimizer: th.optim.Optimizer, *_: Any) -> None:
        algorithm = watched()
        if algorithm is not None:
            _check_gradients(algorithm, optimizer)

    def after(*_: Any) -> None:
        algorithm = watched()
        if algorithm is not None:
            report_weights(algorithm)

    for optimizer in _optimizers(model.policy):
        if not getattr(optimizer, _WATCHED, False):
            optimizer.register_step_pre_hook(before)
            optimizer.register_step_post_hook(after)
            setattr(optimizer, _WATCHED, True)


def _optimizers(policy: th.nn.Module) -> list[th.optim.Optimizer]:
    """:return: The optimizers of a policy and of its parts, as actor and critic have"""
    owned = [value for module in policy.modules() for value in vars(module).values()]
    return [value for value in owned if isinstance(value, th.optim.Optimizer)]


def _check_gradients(model: Any, optimizer: th.optim.Optimizer) -> None:
    require_possible_rate(model, optimizer)
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    _, size = largest(("", parameter.grad) for parameter in parameters if parameter.grad is not None)
    if math.isfinite(size):
        return
    # What is behind it; only now, because the buffer is large.
    buffer = getattr(model, "rollout_buffer", None)
    for field, name in _BUFFER_FIELDS.items():
        bad = first_bad(th.as_tensor(getattr(buffer, field))) if hasattr(buffer, field) else None
        if bad is not None:
            raise diverged(model, name, bad, _FINITE_REWARDS if field == "rewards" else SMALLER_STEPS)
    raise diverged(model, "gradient norm", size)

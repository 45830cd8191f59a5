"""How many instances of a batch have their gradients computed at once."""

from __future__ import annotations

from typing import Any

import torch as th
from torch.nn.modules.batchnorm import _BatchNorm

from sb3_uav.envs.instances import Instances


class MicroBatches:
    """
    Chooses the micro-batches of each update.

    :param given: The size that the user asked for; None for the whole batch
    :raises ValueError: If it is no whole number of at least 1
    """

    def __init__(self, given: int | None) -> None:
        if given is not None and (not isinstance(given, int) or isinstance(given, bool) or given < 1):
            raise ValueError(f"micro_batch_size is {given!r}; it must be a whole number of at least 1, or None.")
        self.given = given

    def size(self, model: Any, n_instances: int) -> int | None:
        """
        :param model: A REINFORCE algorithm
        :param n_instances: Number of instances of the next batch
        :return: How many of them have their gradients computed at once; None for all
        :raises ValueError: If the network normalizes over the batch, so that its parts are not independent
        """
        if self.given is None or self.given >= n_instances:
            return None
        if normalizes_batches(model.policy):
            raise ValueError(
                f"micro_batch_size is {self.given}, but the network has batch normalization, as that of preset 'paper' has, "
                "whose statistics are those of the whole batch; leave it out and lower n_envs instead, or set "
                "policy_kwargs to another normalization."
            )
        return self.given


def normalizes_batches(policy: th.nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether its network has batch normalization
    """
    return any(isinstance(module, _BatchNorm) for module in policy.modules())


@th.no_grad()
def encode_in_parts(policy: Any, instances: Instances, size: int) -> Any:
    """
    :param policy: An ``EpisodicPolicy``
    :param instances: ``batch`` instances on its device
    :param size: Number of instances to encode at once
    :return: The encodings of all, without gradients
    """
    rows = th.arange(len(instances), device=instances.device).split(size)
    first, *others = (policy.encode(instances[part]) for part in rows)
    return first.followed_by(*others)

"""How many instances of a batch have their gradients computed at once."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch as th
from torch.nn.modules.batchnorm import _BatchNorm

from sb3_uav.envs.instances import Instances
from sb3_uav.policies.memory import available_memory
from sb3_uav.reinforce.memory_estimate import N_TRIED, bytes_per_instance, rows_within, update_bytes

# Part of the available memory that an update may take; the rest is for other processes and for evaluations.
_SHARE = 0.8
# Episode steps of an update below which its memory, at most some 100 MB, is not worth a trial.
_SMALL = 2_000
_GIB = 2**30


class MicroBatches:
    """
    Chooses the micro-batches of each update. Without a given size, the memory of an update is estimated before the first one,
    and micro-batches are used only if it is not there.

    :param given: The size that the user asked for; None for the whole batch, or what fits
    :raises ValueError: If it is no whole number of at least 1
    """

    def __init__(self, given: int | None) -> None:
        if given is not None and (not isinstance(given, int) or isinstance(given, bool) or given < 1):
            raise ValueError(f"micro_batch_size is {given!r}; it must be a whole number of at least 1, or None.")
        self.given = given
        # Bytes of an instance of the largest size so far, that size, and what an update may take.
        self.per_instance = 0
        self._n_tasks = 0
        self._memory: int | None = None

    def size(self, model: Any, instances: Instances) -> int | None:
        """
        :param model: A REINFORCE algorithm
        :param instances: The instances of the next batch
        :return: How many of them have their gradients computed at once; None for all
        :raises ValueError: If a size is given, and the network normalizes over the batch
        """
        n_instances = len(instances)
        if self.given is not None:
            if self.given < n_instances and normalizes_batches(model.policy):
                raise ValueError(
                    f"micro_batch_size is {self.given}, but the network has batch normalization, as that of preset 'paper' "
                    "has, whose statistics are those of the whole batch; leave it out and lower n_envs instead, or set "
                    "policy_kwargs to another normalization."
                )
            return self.given if self.given < n_instances else None
        if n_instances * model.n_samples * instances.n_tasks < _SMALL:
            return None
        if instances.n_tasks > self._n_tasks:
            self._estimate(model, instances)
        if self._memory is None or normalizes_batches(model.policy):
            return None
        fitting = rows_within(self._bytes_at(instances.n_tasks), self._memory)
        return fitting if fitting < n_instances else None

    def _bytes_at(self, n_tasks: int) -> int:
        # Memory grows at least in proportion to the number of tasks.
        return math.ceil(self.per_instance * n_tasks / self._n_tasks)

    def _estimate(self, model: Any, instances: Instances) -> None:
        """Find out what an update takes. Before the first update, say so."""
        # Not new ones, because drawing may change a generator.
        tried = instances[th.arange(min(N_TRIED, len(instances)), device=instances.device)]
        self.per_instance = bytes_per_instance(model.policy, tried, model.n_samples)
        is_first, self._n_tasks = self._n_tasks == 0, instances.n_tasks
        if is_first:
            available = available_memory(model.device)
            self._memory = None if available is None else round(_SHARE * available)
            self._say(model, instances, available)

    def _say(self, model: Any, instances: Instances, available: int | None) -> None:
        needed = update_bytes(self.per_instance, len(instances))
        text = (
            f"{model.policy.level}: an update of {len(instances)} instances of {instances.n_tasks} tasks, {model.n_samples} "
            f"samples each, needs about {needed / _GIB:.2f} GiB of memory; "
        )
        text += "how much is available is not known" if available is None else f"{available / _GIB:.2f} GiB are available"
        if self._memory is not None and needed > self._memory:
            fitting = rows_within(self.per_instance, self._memory)
            if normalizes_batches(model.policy):
                remedy = f"batch normalization forbids micro-batches: lower n_envs to about {fitting}"
            else:
                remedy = (
                    f"its gradient is computed in micro-batches of {fitting}, which is the same but for rounding; "
                    "micro_batch_size sets another number"
                )
            warnings.warn(f"{text}; {remedy}.", stacklevel=2)
        elif model.verbose > 0:
            print(f"{text}.", flush=True)


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

"""How much memory an update of REINFORCE will take, before the first one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_uav.common.random_streams import torch_generator
from sb3_uav.envs.instances import Instances

# Instances on which the gradient pass is tried out: enough for a typical length of the longest tour.
N_TRIED = 4
# The peak over what the gradient pass keeps: gradients of the largest tensors, temporary ones, and, of routers, tours longer
# than those that were tried. Measured by benchmarks/memory.py, see docs/memory.md.
_PEAK = {"allocator": 1.6}
_OTHER_PEAK = 2.5
# What sampling and rewards take, whatever the batch, because they are computed in parts.
_FIXED = 2**28


def bytes_per_instance(policy: Any, instances: Instances, n_samples: int) -> int:
    """
    What the gradient pass keeps for one instance, found by trying it out on a few: it is right for any network. Neither
    parameters nor random states nor running statistics change.

    :param policy: An ``EpisodicPolicy``
    :param instances: A few instances on its device
    :param n_samples: Episodes per instance
    :return: Bytes
    """
    was_training, n_encoded = policy.training, policy.features_extractor.n_encoded_rows
    # Batch normalization keeps as much in this mode.
    policy.set_training_mode(False)
    rng = np.random.default_rng(0)
    actions = policy.decode_episodes(instances, n_samples, False, torch_generator(rng, policy.device))
    kept = {tensor.untyped_storage().data_ptr(): 0 for tensor in policy.state_dict().values()}

    def keep(tensor: th.Tensor) -> th.Tensor:
        storage = tensor.untyped_storage()
        kept.setdefault(storage.data_ptr(), storage.nbytes())
        return tensor

    with th.enable_grad(), th.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        evaluation = policy.evaluate_episodes(instances, actions)
        # While the graph exists, no storage is used for two tensors.
        total = sum(kept.values())
    del evaluation
    policy.features_extractor.n_encoded_rows = n_encoded
    policy.set_training_mode(was_training)
    return round(_PEAK.get(policy.level, _OTHER_PEAK) * total / len(instances))


def update_bytes(per_instance: int, n_instances: int) -> int:
    """
    :param per_instance: Of :func:`bytes_per_instance`
    :param n_instances: Number of instances whose gradients are computed at once
    :return: What an update takes beside the process as it was before
    """
    return _FIXED + per_instance * n_instances


def rows_within(per_instance: int, memory: int) -> int:
    """
    :param per_instance: Of :func:`bytes_per_instance`
    :param memory: Bytes that an update may take
    :return: How many instances can have their gradients computed at once, at least 1
    """
    return max((memory - _FIXED) // max(per_instance, 1), 1)

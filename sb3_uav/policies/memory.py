"""The number of instances that fit into memory at once."""

from __future__ import annotations

import torch as th

# Memory of one pass on a CPU, in bytes. More is not faster there.
_CPU_MEMORY = 2**30
# Bytes per node in encoder and decoder: about 1,000 float32 in a default network, four times.
_NODE_MEMORY = 2**14
# Bytes per pair of nodes for the distances between all tasks: differences of coordinates, and copies in float32.
_PAIR_MEMORY = 24
# Bytes per task, sample and UAV for splitting: coordinates and indices in float64 and int64, and their copies.
_SPLIT_MEMORY = 48


def rows_that_fit(device: th.device, n_nodes: int, n_subsets: int = 0) -> int:
    """
    :param device: Device of the network
    :param n_nodes: Nodes of each instance, the depot included
    :param n_subsets: Number of subsets into which each instance is split at once
    :return: Number of instances that can be processed at once, at least 1
    """
    memory = _CPU_MEMORY
    if device.type == "cuda":
        kept = th.cuda.memory_reserved(device) - th.cuda.memory_allocated(device)
        memory = (th.cuda.mem_get_info(device)[0] + kept) // 4
    # Torch's fused attention does not hold the matrix of scores.
    return max(memory // (n_nodes * (_NODE_MEMORY + _SPLIT_MEMORY * n_subsets + _PAIR_MEMORY * n_nodes)), 1)

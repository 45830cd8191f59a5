"""The number of instances that fit into memory at once, and how much memory there is."""

from __future__ import annotations

import os
from pathlib import Path

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
    memory = _free_on_cuda(device) // 4 if device.type == "cuda" else _CPU_MEMORY
    # Torch's fused attention does not hold the matrix of scores.
    return max(memory // (n_nodes * (_NODE_MEMORY + _SPLIT_MEMORY * n_subsets + _PAIR_MEMORY * n_nodes)), 1)


def _free_on_cuda(device: th.device) -> int:
    kept = th.cuda.memory_reserved(device) - th.cuda.memory_allocated(device)
    return th.cuda.mem_get_info(device)[0] + kept


def available_memory(device: th.device) -> int | None:
    """
    :param device: Device of the network
    :return: Bytes that this process can still get there; None if the system does not tell. Processes that ``torchrun`` started
        on this machine share the main memory
    """
    if device.type == "cuda":
        return _free_on_cuda(device)
    limits = [limit for limit in (_free_of_the_system(), _free_of_the_group()) if limit is not None]
    n_processes = os.environ.get("LOCAL_WORLD_SIZE", "1")
    return min(limits) // (int(n_processes) if n_processes.isdigit() and int(n_processes) > 0 else 1) if limits else None


def _free_of_the_system() -> int | None:
    """:return: What Linux calls available; None elsewhere"""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, LookupError, StopIteration):
        return None


def _free_of_the_group(folder: Path = Path("/sys/fs/cgroup")) -> int | None:
    """
    :param folder: Where the kernel shows the limits of this control group, as that of a container
    :return: What they leave; None without limits
    """
    for names in (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")):
        try:
            limit, used = (int((folder / name).read_text(encoding="utf-8")) for name in names)
        except (OSError, ValueError):
            continue
        return max(limit - used, 0)
    return None

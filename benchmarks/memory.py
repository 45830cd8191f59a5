"""
Memory of training and evaluation: the peak of an update against its estimate, and whether it stays flat.

    python benchmarks/memory.py peak --sizes allocator:80:64 allocator:80:128 router:100:64
    python benchmarks/memory.py estimate --sizes allocator:200:512
    python benchmarks/memory.py flat --updates 1000 --instances 1000

Sizes are level:tasks:batch or level:tasks:batch:micro-batch. Every measurement has a process of its own.
"""

from __future__ import annotations

import argparse
import gc
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.memory import available_memory
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.memory_estimate import N_TRIED, bytes_per_instance, update_bytes
from sb3_uav.solvers.dl_drl import DLDRL

_GIB = 2**30
_N_UAVS = 4


def make_model(level: str, n_tasks: int, batch: int, n_samples: int, micro: int | None = None, **kwargs: Any) -> REINFORCE:
    """
    :param level: ``allocator`` or ``router``
    :param n_tasks: Number of tasks
    :param batch: Instances of an update
    :param n_samples: Samples per instance
    :param micro: Size of micro-batches
    :return: A model on one CPU thread
    """
    th.set_num_threads(1)
    if level == "allocator":
        env = BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks, _N_UAVS)] * batch)
    else:
        env = BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks)] * batch)
    policy = "AllocatorPolicy" if level == "allocator" else "RouterPolicy"
    settings: dict[str, Any] = dict(n_samples=n_samples, baseline="shared", seed=0, device="cpu", micro_batch_size=micro)
    return REINFORCE(policy, env, **settings, **kwargs)


def peak_memory() -> int:
    """:return: The largest resident memory of this process so far, in bytes"""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def resident_memory() -> int:
    """:return: The resident memory of this process, in bytes; its peak where the system does not tell"""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmRSS:"))
    except (OSError, StopIteration):
        return peak_memory()


def estimate(size: str, n_samples: int) -> tuple[int, REINFORCE]:
    """:return: Estimated bytes of an update, and the model"""
    level, n_tasks, batch, *micro = size.split(":")
    model = make_model(level, int(n_tasks), int(batch), n_samples, int(micro[0]) if micro else None)
    few = model.draw_batch(0)[th.arange(min(N_TRIED, int(batch)))]
    per_instance = bytes_per_instance(model.policy, few, n_samples)
    return update_bytes(per_instance, min(int(micro[0]) if micro else int(batch), int(batch))), model


def measure_peak(size: str, n_samples: int) -> None:
    """Print the estimate of an update and the peak of two."""
    before = peak_memory()
    estimated, model = estimate(size, n_samples)
    model.learn_instances(2 * model.n_envs)
    measured = peak_memory() - before
    ratio = estimated / max(measured, 1)
    print(
        f"{size}: estimated {estimated / _GIB:.2f} GiB, measured {measured / _GIB:.2f} GiB, ratio {ratio:.2f}",
        flush=True,
    )


def print_estimate(size: str, n_samples: int) -> None:
    """Print the estimate of an update."""
    estimated, _ = estimate(size, n_samples)
    available = available_memory(th.device("cpu"))
    found = "unknown" if available is None else f"{available / _GIB:.1f} GiB"
    print(f"{size}: estimated {estimated / _GIB:.2f} GiB, available {found}", flush=True)


def measure_flatness(n_updates: int, n_instances: int) -> None:
    """Print the resident memory after every tenth of a training and of an evaluation."""
    network = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=32)
    kwargs: dict[str, Any] = dict(policy_kwargs=network, instances_per_epoch=40)
    model = make_model("allocator", 20, 8, 4, **kwargs)
    router = make_model("router", 20, 8, 4, **kwargs)
    for algorithm in (model, router):
        row = []
        for _ in range(10):
            algorithm.learn_instances(8 * n_updates // 10)
            gc.collect()
            row.append(resident_memory() / 2**20)
        level = getattr(algorithm.policy, "level", "")
        print(f"{level}, MiB after every {n_updates // 10} updates: " + " ".join(f"{value:.0f}" for value in row), flush=True)
    assert isinstance(model.policy, AllocatorPolicy) and isinstance(router.policy, RouterPolicy)
    solver = DLDRL(model.policy, router.policy, "sampling", samples=16)
    row = []
    for part in range(10):
        solver.solve(UniformGenerator(20, _N_UAVS)(n_instances // 10, np.random.default_rng(part)), seed=part)
        gc.collect()
        row.append(resident_memory() / 2**20)
    print(
        f"evaluation, MiB after every {n_instances // 10} instances: " + " ".join(f"{value:.0f}" for value in row), flush=True
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["peak", "estimate", "flat"])
    parser.add_argument("--sizes", nargs="+", default=["allocator:80:64", "router:50:64"])
    parser.add_argument("--n-samples", type=int, default=8)
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--instances", type=int, default=1000)
    arguments = parser.parse_args()
    if arguments.what == "flat":
        measure_flatness(arguments.updates, arguments.instances)
    elif len(arguments.sizes) == 1:
        measure = measure_peak if arguments.what == "peak" else print_estimate
        measure(arguments.sizes[0], arguments.n_samples)
    else:
        # A peak is that of a whole process.
        for size in arguments.sizes:
            command = [sys.executable, __file__, arguments.what, "--sizes", size, "--n-samples", str(arguments.n_samples)]
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main()

"""
The share of local search's tasks that a router's greedy tours collect in the same subsets, and the time of a greedy schedule.

The subsets are those of the shipped allocator, greedily decoded.

    python benchmarks/router_gap.py U4-N200.npz U4-N500.npz --routers router.zip its_checkpoint/router_0.zip
    python benchmarks/router_gap.py --solve-time 100 200 500 1000
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch as th

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.envs.allocation import split_tasks
from sb3_uav.envs.routing import collected_value
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import files
from sb3_uav.solvers import make_solver
from sb3_uav.training.imitation import good_tours

REPEATS = 5


def report_gaps(paths: list[Path], routers: list[Path], n_instances: int) -> None:
    """
    :param paths: ``.npz`` files
    :param routers: Zips
    :param n_instances: Number of leading instances of each file
    """
    allocator = load_policy(files()[0], "cpu", AllocatorPolicy)
    policies = [load_policy(router, "cpu", RouterPolicy) for router in routers or [files()[1]]]
    for path in paths:
        instances = allocator.arrange(Instances.load(path)[:n_instances])
        subsets = split_tasks(instances, allocator.decode_episodes(instances)).instances
        searched = collected_value(subsets, good_tours(subsets)[:, None]).sum()
        parts = [(collected_value(subsets, policy.plan(subsets)[:, None]).sum() / searched).item() for policy in policies]
        print(path.stem, *(f"{part:.4f}" for part in parts), flush=True)


def report_solve_times(sizes: list[int]) -> None:
    """:param sizes: Numbers of tasks of the instances, which have 4 UAVs"""
    solver = make_solver("dl-drl:device=cpu")
    for n_tasks in sizes:
        instance = UniformGenerator(n_tasks, 4)(1, np.random.default_rng(0))
        seconds = []
        for _ in range(REPEATS):
            start = time.process_time()
            solver.solve(instance)
            seconds.append(time.process_time() - start)
        print(f"{n_tasks} tasks: {min(seconds):.3f} s of CPU time", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instances", type=Path, nargs="*", help=".npz files")
    parser.add_argument("--routers", type=Path, nargs="+", default=[], help="zips (default: the shipped one)")
    parser.add_argument(
        "--n-instances", type=int, default=16, help="number of leading instances of each file (default: %(default)s)"
    )
    parser.add_argument("--solve-time", type=int, nargs="+", default=[], metavar="N_TASKS")
    parser.add_argument("--num-threads", type=int, default=1)
    args = parser.parse_args()
    th.set_num_threads(args.num_threads)
    report_gaps(args.instances, args.routers, args.n_instances)
    report_solve_times(args.solve_time)


if __name__ == "__main__":
    main()

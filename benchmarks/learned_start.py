"""
The benefit of a learned start for a search: the same polish in the same time from insertion and from the shipped pair.

The time of the pair includes its networks and the repair; the time of cheapest insertion is not counted.

    python benchmarks/learned_start.py U4-N500.npz U6-N500.npz --seconds 1 --n-instances 4
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch as th

from sb3_uav.envs import Instances, check_schedule
from sb3_uav.solvers import make_solver
from sb3_uav.solvers.postprocess import polish


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instances", type=Path, nargs="+", help=".npz files")
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds per instance (default: %(default)s)")
    parser.add_argument(
        "--n-instances", type=int, default=4, help="number of leading instances of each file (default: %(default)s)"
    )
    parser.add_argument("--num-threads", type=int, default=1)
    args = parser.parse_args()
    th.set_num_threads(args.num_threads)
    insertion = make_solver("greedy-insertion")
    pair = make_solver(f"dl-drl:decode=augment,repair=1,polish={args.seconds},time_limit={args.seconds}")
    for path in args.instances:
        instances = Instances.load(path)[: args.n_instances]
        starts = [result.schedule for result in insertion.solve(instances)]
        polished = [polish(instances[row], start, args.seconds) for row, start in enumerate(starts)]
        learned = [result.schedule for result in pair.solve(instances)]
        means = [
            np.mean([check_schedule(instances, row, schedule).objective for row, schedule in enumerate(found)])
            for found in (polished, learned)
        ]
        print(f"{path.stem}, {args.seconds:g} s: from insertion {means[0]:.2f}, from the pair {means[1]:.2f}", flush=True)


if __name__ == "__main__":
    main()

"""
The effect of each ingredient of the default preset: the same short training without it.

Every variant trains an allocator and a router in turn (the ITS without its first two phases) from scratch, on one scenario and
on equally many sampled solutions, and is evaluated on the same test instances, greedily and with 32 samples. One run each is a
rough measure; more seeds make it better.

    python benchmarks/ablation.py --out ablation.csv
    python benchmarks/ablation.py --out ablation.csv --seeds 1 2 --variants default "no sweep"

Rerun an interrupted call to resume it.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_uav.common.random_streams import ABLATION_SEED
from sb3_uav.envs import BatchedVecEnv, Instances, TaskAllocationEnv, UniformGenerator
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers.dl_drl import DLDRL
from sb3_uav.training import ITSCallback

LEARNING: dict[str, Any] = dict(n_samples=8, baseline="shared", normalize_advantage=True, max_grad_norm=1.0, lr_decay=0.9)
NETWORK: dict[str, Any] = dict(use_values=False, mixed_precision=True)
# Changes to the networks and to the algorithms, on both levels.
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "default": ({}, {}),
    "no sweep": ({"sweep": False}, {}),
    "absolute coordinates": ({"relative": False}, {}),
    "no geometry": ({"geometry": False}, {}),
    "one scorer per UAV": ({"shared_scorer": False}, {}),
    "layer norm": ({"normalization": "layer"}, {}),
    "float32": ({"mixed_precision": False}, {}),
    "rollout baseline, one sample": ({}, {"n_samples": 1, "baseline": "rollout", "baseline_kwargs": {"n_test_instances": 64}}),
    "paper's networks": ({"preset": "paper", "normalization": "instance"}, {}),
}
COLUMNS = ("variant", "seed", "greedy", "sampling_32", "seconds", "n_parameters")
# Settings that only one of the levels has.
OF_THE_ALLOCATOR = {"sweep", "shared_scorer"}


def train(name: str, seed: int, args: argparse.Namespace) -> tuple[DLDRL, float]:
    """
    :param name: Name of the variant
    :param seed: Seed of its training
    :param args: Arguments of the command
    :return: The trained pair, and the duration in seconds
    """
    network, learning = VARIANTS[name]
    # Equally many solutions for any number of samples per instance.
    factor = LEARNING["n_samples"] // learning.get("n_samples", LEARNING["n_samples"])
    env = BatchedVecEnv([lambda: TaskAllocationEnv(args.n_tasks, args.n_uavs)] * (factor * args.n_envs))
    of_the_router = {key: value for key, value in network.items() if key not in OF_THE_ALLOCATOR}
    its = ITSCallback(
        router={
            "algo": "reinforce",
            "policy": "RouterPolicy",
            "policy_kwargs": {"n_layers": 2, **NETWORK, **of_the_router},
            "n_envs": 2 * factor * args.n_envs,
            "learning_rate": 1.5e-3,
            **LEARNING,
            **learning,
        },
        n_epochs=args.n_epochs,
        strategy="ITS/pre-training&intensive",
        router_instances_per_epoch=factor * args.router_instances,
    )
    settings = {
        "learning_rate": 1e-3,
        "ent_coef": 0.01,
        "instances_per_epoch": factor * args.instances,
        **LEARNING,
        **learning,
    }
    policy: Any = "AllocatorPolicy"
    model: Any = REINFORCE(policy, env, policy_kwargs={**NETWORK, **network}, seed=seed, device="cpu", **settings)
    start = time.perf_counter()
    model.learn(10**12, callback=its)
    return DLDRL(model.policy, its.router.policy), time.perf_counter() - start  # type: ignore[arg-type]


def objective(solver: DLDRL, instances: Instances) -> float:
    """:return: Mean number of tasks"""
    return float(np.mean([result.schedule.n_visited for result in solver.solve(instances)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", nargs="+", choices=tuple(VARIANTS), default=list(VARIANTS), metavar="NAME")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--n-tasks", type=int, default=80)
    parser.add_argument("--n-uavs", type=int, default=4)
    parser.add_argument("--n-envs", type=int, default=16, help="allocator instances per update (default: %(default)s)")
    parser.add_argument("--n-epochs", type=int, default=10)
    parser.add_argument("--instances", type=int, default=240, help="allocator instances per epoch (default: %(default)s)")
    parser.add_argument("--router-instances", type=int, default=1600, help="router instances per epoch (default: %(default)s)")
    parser.add_argument("--n-test-instances", type=int, default=64)
    parser.add_argument("--num-threads", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="CSV file")
    args = parser.parse_args()
    th.set_num_threads(args.num_threads)
    test = UniformGenerator(args.n_tasks, args.n_uavs)(args.n_test_instances, np.random.default_rng(ABLATION_SEED))
    done: set[tuple[str, int]] = set()
    if args.out.is_file():
        with args.out.open(newline="", encoding="utf-8") as file:
            done = {(row["variant"], int(row["seed"])) for row in csv.DictReader(file)}
    for seed in args.seeds:
        for name in args.variants:
            if (name, seed) in done:
                continue
            pair, seconds = train(name, seed, args)
            greedy = objective(pair, test)
            sampling = objective(DLDRL(pair.allocator, pair.router, "sampling", 32), test)
            n_parameters = sum(parameter.numel() for parameter in (*pair.allocator.parameters(), *pair.router.parameters()))
            is_new = not args.out.is_file()
            with args.out.open("a", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                if is_new:
                    writer.writerow(COLUMNS)
                writer.writerow((name, seed, round(greedy, 3), round(sampling, 3), round(seconds, 1), n_parameters))
            print(f"{name}, seed {seed}: greedy {greedy:.2f}, best of 32 {sampling:.2f}, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()

"""
Training speed of several processes: instances per second of both levels with 1 and with 2 processes of one thread each.

The settings are those of ``TaskAllocation-U4-N80-v0`` in ``zoo_configs/reinforce.yml``: 32 instances an update, 8 samples.
The processes share the batch, so that an update is the same whatever their number. The allocator gets its reward from a fresh
router with the entry's network; the router learns on whole instances of 20 tasks, as many as a UAV has in its subset. The
numbers of processes take turns, and ratios are those of each round, so that what other programs take on the machine meets
both. Their median and range are printed, and the load average before and after. On a busy machine the CPU seconds of all
processes tell more: twice the instances per CPU second, relative to one process, is the most that two cores can reach. The
last lines tell how long an epoch of the allocator and one of the router take together.

    python benchmarks/distributed.py --processes 1 2 --rounds 5
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.common import distributed
from sb3_uav.envs.allocation import TaskAllocationEnv
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.zoo.configs import read_yaml

_CONFIG = Path(__file__).parents[1] / "zoo_configs" / "reinforce.yml"
_ENTRY = "TaskAllocation-U4-N80-v0"
_N_TASKS, _N_UAVS = 80, 4
_NOT_OF_THE_ALGORITHM = ("n_timesteps", "callback", "env_kwargs", "algo", "policy", "n_envs")
_WARM_UP = 3


class _Clock(BaseCallback):
    """Notes when each update begins."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[tuple[float, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.times.append((time.perf_counter(), time.process_time()))


def _settings(given: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in given.items() if name not in _NOT_OF_THE_ALGORITHM}


def _entry() -> tuple[dict[str, Any], dict[str, Any]]:
    """:return: The entry of the YAML, and the arguments of its ITSCallback"""
    entry = read_yaml(_CONFIG)[_ENTRY]
    return entry, next(value for callback in entry["callback"] for name, value in callback.items() if "ITS" in name)


def _epoch(level: str) -> int:
    """:return: Instances of an epoch of this level"""
    entry, its = _entry()
    return its["router_instances_per_epoch"] if level == "router" else entry["instances_per_epoch"]


def make(level: str) -> REINFORCE:
    """
    :param level: ``"allocator"`` or ``"router"``
    :return: Its algorithm, as the entry sets it
    """
    entry, its = _entry()
    if level == "router":
        env = BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks=_N_TASKS // _N_UAVS)] * its["router"]["n_envs"])
        return REINFORCE(RouterPolicy, env, seed=1, device="cpu", **_settings(its["router"]))
    env = BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks=_N_TASKS, n_uavs=_N_UAVS)] * entry["n_envs"])
    th.manual_seed(0)
    spaces = RouterPolicy.placeholder_spaces(None)
    env.env_method("set_router", RouterPolicy(*spaces, lambda _: 0.0, **its["router"]["policy_kwargs"]).plan)
    return REINFORCE("AllocatorPolicy", env, seed=1, device="cpu", **_settings(entry))


def measure(level: str, n_updates: int) -> tuple[float, float]:
    """:return: Instances per second of the wall clock, and per CPU second of all processes together"""
    model, clock = make(level), _Clock()
    distributed.barrier()
    model.learn_instances((_WARM_UP + n_updates + 1) * model.n_envs, clock, log_interval=10**6)
    wall, cpu = (end - begin for begin, end in zip(clock.times[_WARM_UP], clock.times[_WARM_UP + n_updates], strict=True))
    return n_updates * model.n_envs / wall, n_updates * model.n_envs / distributed.total(cpu)


def launch(n_processes: int, level: str, n_updates: int) -> tuple[float, float]:
    """
    :param n_processes: Number of processes, of one thread each
    :param level: As for :func:`make`
    :param n_updates: Updates to time
    :return: As :func:`measure`
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "rate.json"
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(n_processes)]
        command += [__file__, "--worker", level, "--updates", str(n_updates), "--out", str(out)]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        wall, cpu = json.loads(out.read_text())
        return wall, cpu


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2], help="numbers of processes; the first is compared")
    parser.add_argument("--levels", nargs="+", default=["allocator", "router"], choices=["allocator", "router"])
    parser.add_argument("--rounds", type=int, default=5, help="how often to measure each")
    parser.add_argument("--updates", type=int, default=12, help="updates of a measurement")
    parser.add_argument("--worker", choices=["allocator", "router"], help=argparse.SUPPRESS)
    parser.add_argument("--out", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker is not None:
        th.set_num_threads(1)
        with distributed.process_group():
            rate = measure(args.worker, args.updates)
            if distributed.is_main():
                Path(args.out).write_text(json.dumps(rate))
        return
    before = os.getloadavg()[0]
    seconds = dict.fromkeys(args.processes, 0.0)
    for level in args.levels:
        rates: dict[int, list[tuple[float, float]]] = {n: [] for n in args.processes}
        for _ in range(args.rounds):
            for n, found in rates.items():
                found.append(launch(n, level, args.updates))
        first = rates[args.processes[0]]
        for n, found in rates.items():
            seconds[n] += _epoch(level) / median(rate[0] for rate in found)
            for unit, name in enumerate(("s", "CPU s")):
                numbers, others = [rate[unit] for rate in found], [rate[unit] for rate in first]
                ratios = [number / other for number, other in zip(numbers, others, strict=True)]
                print(
                    f"{level}, {n} processes: {median(numbers):.1f} instances/{name} ({min(numbers):.1f} to "
                    f"{max(numbers):.1f}), ratio {median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})",
                    flush=True,
                )
    for n, spent in seconds.items():
        ratio = seconds[args.processes[0]] / spent
        print(f"an epoch of {' and one of '.join(args.levels)}, {n} processes: {spent:.1f} s, ratio {ratio:.2f}")
    print(f"load average before {before:.1f}, after {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")


if __name__ == "__main__":
    main()

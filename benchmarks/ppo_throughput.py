"""
PPO with instances encoded once per episode: environment steps per second of whole collect and train cycles.

``every step`` is what SB3 does with any extractor: ``DummyVecEnv``, ``DictRolloutBuffer``, an encoding for every step, in
collection and in training. ``once`` is ``BatchedVecEnv``, ``EpisodeRolloutBuffer`` and the policy's cache. The algorithm, the
network and all settings are the same; so are the environment steps. Every measurement runs in a separate process; its
peak memory is counted from before the algorithm was created. An episode of the allocator has N steps; one of the router has
one per visited task, few in an untrained network, which bounds the ratio.

    python benchmarks/ppo_throughput.py --n-tasks 20 80 200
"""

import argparse
import multiprocessing
import resource
import time
from typing import Any, NamedTuple

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.training import EpisodeRolloutBuffer

N_UAVS = 4


class Measurement(NamedTuple):
    """
    :param steps_per_second: Environment steps per second of collecting and training
    :param peak_memory: Peak memory in MiB, above that at the start
    """

    steps_per_second: float
    peak_memory: float


def measure(level: str, n_tasks: int, once: bool, args: argparse.Namespace) -> Measurement:
    """
    :param level: ``"allocator"`` or ``"router"``
    :param n_tasks: Size of the instances
    :param once: Whether to encode every instance once per episode
    :param args: Arguments of the command line
    :return: Speed and memory of the cycles
    """
    th.set_num_threads(args.num_threads)

    def make_env() -> Any:
        return TaskAllocationEnv(n_tasks, N_UAVS) if level == "allocator" else RoutePlanningEnv(n_tasks)

    env = (BatchedVecEnv if once else DummyVecEnv)([make_env] * args.n_envs)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    n_steps = n_tasks if level == "allocator" else 20
    policy: Any = AllocatorPolicy if level == "allocator" else RouterPolicy
    model = PPO(
        policy,
        env,
        n_steps=n_steps,
        batch_size=n_steps * args.n_envs // args.n_minibatches,
        n_epochs=args.n_epochs,
        gamma=1.0,
        rollout_buffer_class=EpisodeRolloutBuffer if once else None,
        device="cpu",
        seed=0,
    )
    extractor: Any = model.policy.features_extractor
    extractor.use_cache = extractor.share_encodings = once
    if once:
        # The slow side needs no warm-up: its cycle is long enough.
        model.learn(n_steps * args.n_envs)
    start = time.perf_counter()
    model.learn(n_steps * args.n_envs * (args.n_cycles if once else 1))
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return Measurement(model.num_timesteps / seconds, peak / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", choices=("allocator", "router"), nargs="+", default=["allocator", "router"])
    parser.add_argument("--n-tasks", type=int, nargs="+", default=[20, 80, 200])
    parser.add_argument("--n-envs", type=int, default=16)
    parser.add_argument("--n-epochs", type=int, default=4)
    parser.add_argument("--n-minibatches", type=int, default=2)
    parser.add_argument("--n-cycles", type=int, default=4, help="cycles of the fast side; the slow side does one")
    parser.add_argument("--num-threads", type=int, default=1)
    args = parser.parse_args()

    print(f"PPO, {args.n_envs} environments, {args.n_epochs} epochs, {args.num_threads} threads")
    print(f"{'':9} {'':>5} {'steps per second':>25} {'':>7} {'peak memory, MiB':>20}")
    print(f"{'level':9} {'N':>5} {'every step':>15} {'once':>9} {'ratio':>7} {'every step':>11} {'once':>8} {'ratio':>7}")
    for level in args.level:
        for n_tasks in args.n_tasks:
            measured = []
            for once in (False, True):
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    measured.append(pool.apply(measure, (level, n_tasks, once, args)))
            slow, fast = measured
            print(
                f"{level:9} {n_tasks:5} {slow.steps_per_second:15.1f} {fast.steps_per_second:9.1f} "
                f"{fast.steps_per_second / slow.steps_per_second:6.1f}x {slow.peak_memory:11.0f} {fast.peak_memory:8.0f} "
                f"{slow.peak_memory / fast.peak_memory:6.1f}x",
                flush=True,
            )


if __name__ == "__main__":
    main()

"""
Time saved by encoding an instance once per episode instead of at every step.

Collection: SB3's step loop (``policy(obs)`` in evaluation mode, ``BatchedVecEnv``) with and without the policy's cache.
Training: one forward and backward pass over all transitions of some episodes, as whole episodes (encoded once each) and as
SB3 does it, transition by transition (``evaluate_actions`` in minibatches). Prints times of this run and their ratios.

    python benchmarks/encode_once.py --n-tasks 80
"""

import argparse
import time

import numpy as np
import torch as th
from stable_baselines3.common.utils import obs_as_tensor

from sb3_uav.envs import BatchedVecEnv, Instances, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy


def collect(policy: AllocatorPolicy, env: BatchedVecEnv, use_cache: bool) -> tuple[float, float]:
    """
    Play one episode in every row.

    :return: Seconds in the network, total seconds
    """
    policy.set_training_mode(True)
    policy.set_training_mode(False)
    policy.features_extractor.use_cache = use_cache
    env.seed(0)
    observation = env.reset()
    n_tasks = env.problem.generator.n_tasks
    network, start = 0.0, time.perf_counter()
    for _ in range(n_tasks):
        assert isinstance(observation, dict)
        tensor = obs_as_tensor(observation, th.device("cpu"))
        before = time.perf_counter()
        with th.no_grad():
            actions, _, _ = policy(tensor)
        network += time.perf_counter() - before
        observation, _, _, _ = env.step(actions.numpy())
    return network, time.perf_counter() - start


def train_by_episode(policy: AllocatorPolicy, instances: Instances, actions: th.Tensor) -> float:
    """:return: Seconds of a forward and backward pass over whole episodes"""
    policy.set_training_mode(True)
    start = time.perf_counter()
    policy.evaluate_episodes(instances, actions).log_prob.mean().backward()
    return time.perf_counter() - start


def train_by_step(policy: AllocatorPolicy, instances: Instances, actions: th.Tensor) -> float:
    """:return: Seconds of the same pass over single transitions, in minibatches of ``n_episodes``"""
    env = BatchedVecEnv([lambda: TaskAllocationEnv(instances.n_tasks, instances.n_uavs)] * len(instances))
    env.set_options([{"instance": instances[row]} for row in range(len(instances))])
    observation = env.reset()
    policy.set_training_mode(True)
    seconds = 0.0
    for step in range(instances.n_tasks):
        assert isinstance(observation, dict)
        tensor = obs_as_tensor(observation, th.device("cpu"))
        before = time.perf_counter()
        _, log_prob, _ = policy.evaluate_actions(tensor, actions[:, 0, step])
        log_prob.mean().backward()
        seconds += time.perf_counter() - before
        observation, _, _, _ = env.step(actions[:, 0, step].numpy())
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-tasks", type=int, default=80)
    parser.add_argument("--n-uavs", type=int, default=4)
    parser.add_argument("--n-envs", type=int, default=64, help="rows of the collection")
    parser.add_argument("--n-episodes", type=int, default=64, help="episodes of the training pass")
    args = parser.parse_args()

    th.manual_seed(0)
    env = BatchedVecEnv([lambda: TaskAllocationEnv(args.n_tasks, args.n_uavs)] * args.n_envs)
    # The paper's network without its batch normalization, which no on-policy algorithm of SB3 can use.
    policy = AllocatorPolicy(env.observation_space, env.action_space, lambda _: 1e-4)
    instances = env.problem.generator(args.n_episodes, np.random.default_rng(0))
    actions = policy.decode_episodes(instances, deterministic=False)

    collect(policy, env, True)
    train_by_episode(policy, instances, actions)
    cached, uncached = collect(policy, env, True), collect(policy, env, False)
    by_episode, by_step = train_by_episode(policy, instances, actions), train_by_step(policy, instances, actions)
    print(f"N = {args.n_tasks}, V = {args.n_uavs}, {args.n_envs} rows, {th.get_num_threads()} threads")
    print(f"{'seconds':34} {'every step':>10} {'once':>8} {'ratio':>7}")
    for name, slow, fast in (
        ("collection, network", uncached[0], cached[0]),
        ("collection, environment included", uncached[1], cached[1]),
        (f"training pass, {args.n_episodes} episodes", by_step, by_episode),
    ):
        print(f"{name:34} {slow:10.3f} {fast:8.3f} {slow / fast:6.1f}x")


if __name__ == "__main__":
    main()

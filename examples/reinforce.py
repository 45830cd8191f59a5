"""
Our REINFORCE: whole episodes on the policy's device, several samples of every instance with their mean as the baseline.

It is an SB3 algorithm: callbacks, TensorBoard, ``save`` and ``load`` as usual. The trained policy also plays whole batches of
instances without an environment.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse
import tempfile
from pathlib import Path

import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.envs import BatchedVecEnv, UniformGenerator, collected_value
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=1_000_000, help="default: %(default)s")
args = parser.parse_args()

env = make_vec_env("RoutePlanning-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
model = REINFORCE(
    "RouterPolicy",
    env,
    n_samples=8,
    baseline="shared",
    normalize_advantage=True,
    learning_rate=1e-3,
    policy_kwargs=dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64),
    seed=0,
)
model.learn(args.timesteps)

path = Path(tempfile.mkdtemp()) / "router.zip"
model.save(path)
policy = REINFORCE.load(path).policy
assert isinstance(policy, RouterPolicy)

# Any number of tasks, though it was trained on 20.
for n_tasks in (20, 50):
    instances = UniformGenerator(n_tasks, n_uavs=1, max_distance=1.5)(256, np.random.default_rng(1))
    greedy = collected_value(instances, policy.decode_episodes(instances)).mean()
    sampled = collected_value(instances, policy.decode_episodes(instances, 16, deterministic=False)).amax(1).mean()
    print(f"{n_tasks} tasks: {greedy:.2f} visited greedily, {sampled:.2f} by the best of 16 samples")

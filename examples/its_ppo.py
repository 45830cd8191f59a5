"""
The interactive training strategy with stock PPO on both levels: an allocator, and a router trained beside it.

Writes ``allocator.zip`` and ``router.zip``, which ``evaluate_and_draw.py`` reads.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse
from pathlib import Path

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.envs import BatchedVecEnv
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.training import EpisodeRolloutBuffer, ITSCallback

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=768_000, help="steps of the allocator, default: %(default)s")
parser.add_argument("--out", type=Path, default=Path("pair"), help="folder of the zips, default: %(default)s")
args = parser.parse_args()

env = make_vec_env("TaskAllocation-U3-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
settings = dict(
    batch_size=640,
    n_epochs=4,
    learning_rate=1e-3,
    gamma=1.0,
    vf_coef=0.1,
    policy_kwargs=dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64),
    rollout_buffer_class=EpisodeRolloutBuffer,
)
# An episode of the allocator has 20 steps; its only reward comes with the last.
allocator = PPO(AllocatorPolicy, env, n_steps=20, gae_lambda=0.95, ent_coef=0.01, seed=0, **settings)
router = dict(algo="ppo", policy="RouterPolicy", n_envs=64, n_steps=20, gae_lambda=0.98, **settings)
n_epochs = 6
its = ITSCallback(
    router,
    n_epochs=n_epochs,
    n_pretraining_epochs=3,
    n_intensive_epochs=4,
    n_continuous_epochs=2,
    # SB3's algorithms count steps; this sets the instances of an epoch.
    instances_per_epoch=max(args.timesteps // 20 // n_epochs, 64),
    save_path=str(args.out),
    verbose=1,
)
allocator.learn(args.timesteps, callback=its)
allocator.save(args.out / "allocator")
print(f"Wrote {args.out / 'allocator.zip'} and {args.out / 'router.zip'}")

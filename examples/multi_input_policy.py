"""
Our attention extractors inside SB3's own ``MultiInputPolicy``, with any ``net_arch`` on top.

The allocator may assign any task to any UAV, so stock PPO needs no masks. The router must be able to return to the depot:
MaskablePPO's ``MultiInputPolicy`` takes its masks from the environment.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse

from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_uav.envs import BatchedVecEnv
from sb3_uav.policies import AllocatorExtractor, RouterExtractor

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=200_000, help="default: %(default)s")
args = parser.parse_args()

network = dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64)
settings = dict(n_epochs=4, learning_rate=1e-3, gamma=1.0, gae_lambda=0.98, vf_coef=0.1, seed=0)

env = make_vec_env("TaskAllocation-U3-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
kwargs = dict(features_extractor_class=AllocatorExtractor, features_extractor_kwargs=network, net_arch=[64])
allocator = PPO("MultiInputPolicy", env, n_steps=20, batch_size=640, policy_kwargs=kwargs, **settings)
allocator.learn(args.timesteps)
mean, _ = evaluate_policy(allocator, env, n_eval_episodes=128)
print(f"Allocator: {mean:.2f} tasks visited by the fleet")

env = make_vec_env("RoutePlanning-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
kwargs = dict(features_extractor_class=RouterExtractor, features_extractor_kwargs=network, net_arch=[64])
router = MaskablePPO("MultiInputPolicy", env, n_steps=40, batch_size=640, policy_kwargs=kwargs, **settings)
router.learn(args.timesteps)
mean, _ = evaluate_masked(router, env, n_eval_episodes=128)
print(f"Router: {mean:.2f} tasks on a tour")

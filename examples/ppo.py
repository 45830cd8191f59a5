"""
Stock PPO on one of our environments: our policy, all rows in one ``BatchedVecEnv``, minibatches of whole episodes.

Nothing here subclasses PPO. Without ``rollout_buffer_class`` it still trains, only slower.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_uav.envs import BatchedVecEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.training import EpisodeRolloutBuffer

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=300_000, help="default: %(default)s")
args = parser.parse_args()

env = make_vec_env("RoutePlanning-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
model = PPO(
    RouterPolicy,
    env,
    n_steps=40,
    batch_size=640,
    n_epochs=4,
    learning_rate=1e-3,
    gamma=1.0,
    gae_lambda=0.98,
    vf_coef=0.1,
    policy_kwargs=dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64),
    rollout_buffer_class=EpisodeRolloutBuffer,
    seed=0,
)

eval_env = make_vec_env("RoutePlanning-N20-v0", n_envs=64, seed=1_000, vec_env_cls=BatchedVecEnv)
before, _ = evaluate_policy(model, eval_env, n_eval_episodes=256)
model.learn(args.timesteps)
eval_env.seed(1_000)  # the same instances again
after, _ = evaluate_policy(model, eval_env, n_eval_episodes=256)
print(f"Tasks on a tour: {before:.2f} untrained, {after:.2f} after {model.num_timesteps} steps")

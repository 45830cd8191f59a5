"""
A frozen, pre-trained attention encoder under a new policy, of which only decoder and critic are trained.

REINFORCE trains a router; PPO reuses its encoder and trains a new decoder and critic.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.envs import BatchedVecEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import EpisodeRolloutBuffer, Freezer

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=300_000, help="steps of each training, default: %(default)s")
args = parser.parse_args()

network = dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64)
env = make_vec_env("RoutePlanning-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
teacher = REINFORCE("RouterPolicy", env, n_samples=8, baseline="shared", learning_rate=1e-3, policy_kwargs=network, seed=0)
teacher.learn(args.timesteps)

model = PPO(
    RouterPolicy,
    env,
    n_steps=40,
    batch_size=640,
    n_epochs=4,
    learning_rate=1e-3,
    gamma=1.0,
    vf_coef=0.1,
    policy_kwargs=network,
    rollout_buffer_class=EpisodeRolloutBuffer,
    seed=1,
)
assert isinstance(teacher.policy, RouterPolicy) and isinstance(model.policy, RouterPolicy)
encoder = model.policy.features_extractor.encoder
encoder.load_state_dict(teacher.policy.features_extractor.encoder.state_dict())
freezer = Freezer(encoder)
freezer.freeze()
before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
model.learn(args.timesteps)

changed = {name for name, parameter in model.policy.named_parameters() if not parameter.equal(before[name])}
n_encoder = sum("encoder" in name for name in before)
print(f"Parameters that changed: {sum('encoder' in name for name in changed)} of {n_encoder} in the encoder,")
print(f"{sum('encoder' not in name for name in changed)} of {len(before) - n_encoder} elsewhere")
freezer.thaw()

"""
Stock MaskablePPO of sb3-contrib, which gets its action masks from the environment during training.

``predict``, evaluation and ``EvalCallback`` need no masks, because the observation contains them too: the tours below have no
illegal actions.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse

from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.envs import BatchedVecEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.training import MaskableEpisodeRolloutBuffer

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=300_000, help="default: %(default)s")
args = parser.parse_args()

env = make_vec_env("RoutePlanning-N20-v0", n_envs=64, seed=0, vec_env_cls=BatchedVecEnv)
model = MaskablePPO(
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
    rollout_buffer_class=MaskableEpisodeRolloutBuffer,
    seed=0,
)
eval_env = make_vec_env("RoutePlanning-N20-v0", n_envs=16, seed=1_000, vec_env_cls=BatchedVecEnv)
callback = EvalCallback(eval_env, n_eval_episodes=64, eval_freq=500, verbose=0)
model.learn(args.timesteps, callback=callback)

observation, done, n_tasks, illegal = eval_env.reset(), [False] * 16, 0.0, 0
while not all(done):
    actions, _ = model.predict(observation, deterministic=True)
    observation, rewards, new_dones, infos = eval_env.step(actions)
    for row in range(16):
        if not done[row]:
            n_tasks, illegal = n_tasks + rewards[row], illegal + infos[row]["illegal_actions"]
    done = [old or new for old, new in zip(done, new_dones, strict=True)]
print(f"Tasks on a tour: {n_tasks / 16:.2f}; illegal actions: {illegal}")

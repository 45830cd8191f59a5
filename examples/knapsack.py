"""Masked attention for an environment of one's own: a knapsack, whose items are encoded once per episode, by REINFORCE."""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.reinforce import REINFORCE

N_ITEMS, CAPACITY = 15, 3.0


class KnapsackEnv(gym.Env[Any, Any]):
    nodes, context = gym.spaces.Box(0, 1, (N_ITEMS, 2), np.float32), gym.spaces.Box(0, 1, (1,), np.float32)
    observation_space = gym.spaces.Dict(nodes=nodes, context=context, action_mask=gym.spaces.MultiBinary(N_ITEMS))
    action_space = gym.spaces.Discrete(N_ITEMS)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.items, self.fits = self.np_random.random((N_ITEMS, 2), dtype=np.float32), np.ones(N_ITEMS, np.int8)
        self.room = CAPACITY
        return self.observe(), {}

    def observe(self):
        room = np.array([self.room / CAPACITY], np.float32)
        return {"nodes": self.items, "context": room, "action_mask": self.fits.copy()}

    def step(self, action):
        legal, (weight, value) = bool(self.fits[action]), self.items[action]
        if legal:
            self.room, self.fits[action] = self.room - weight, 0
            self.fits &= self.items[:, 0] <= self.room
        return self.observe(), float(value * legal), not self.fits.any(), False, {"illegal": not legal}


def play(choose, n_episodes=500):
    env, value, n_illegal = KnapsackEnv(), 0.0, 0
    for seed in range(n_episodes):
        observation, done = env.reset(seed=seed)[0], False
        while not done:
            observation, reward, done, _, info = env.step(choose(observation))
            value, n_illegal = value + reward, n_illegal + info["illegal"]
    return value / n_episodes, n_illegal


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=25_000, help="default: %(default)s")
if __name__ == "__main__":
    settings: dict[str, Any] = dict(n_steps=16, baseline="critic", normalize_advantage=True, learning_rate=3e-3, seed=0)
    network = dict(embed_dim=32, n_layers=1, n_heads=4, ff_dim=64)
    model = REINFORCE("MaskedAttentionPolicy", make_vec_env(KnapsackEnv, 32, 10_000), policy_kwargs=network, **settings)
    model.learn(parser.parse_args().timesteps)
    chance, _ = play(lambda obs: np.random.choice(np.flatnonzero(obs["action_mask"])))
    greedy, _ = play(lambda obs: np.where(obs["action_mask"], obs["nodes"][:, 1] / (obs["nodes"][:, 0] + 1e-9), -1).argmax())
    found, n_illegal = play(lambda obs: model.predict(obs, deterministic=True)[0])
    print(f"Value packed: {chance:.2f} at random, {greedy:.2f} by value per weight, {found:.2f} learned; illegal: {n_illegal}")

"""Masked attention for an environment of one's own: a traveling salesman, whose cities are encoded once, by stock PPO."""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav.policies import MaskedAttentionPolicy

N_CITIES = 10


class TSPEnv(gym.Env[Any, Any]):
    nodes, places = gym.spaces.Box(0, 1, (N_CITIES, 2), np.float32), gym.spaces.Box(0, 1, (4,), np.float32)
    observation_space = gym.spaces.Dict(nodes=nodes, context=places, action_mask=gym.spaces.MultiBinary(N_CITIES))
    action_space = gym.spaces.Discrete(N_CITIES)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cities, self.tour = self.np_random.random((N_CITIES, 2), dtype=np.float32), [0]
        return self.observe(), {}

    def observe(self):
        unvisited = ~np.isin(np.arange(N_CITIES), self.tour)
        return {"nodes": self.cities, "context": self.cities[[self.tour[-1], 0]].ravel(), "action_mask": np.int8(unvisited)}

    def step(self, action):
        illegal, (last, city, home) = action in self.tour, self.cities[[self.tour[-1], action, 0]]
        self.tour += [] if illegal else [int(action)]
        done = len(self.tour) == N_CITIES
        length = np.linalg.norm(city - last) + done * np.linalg.norm(home - city)
        return self.observe(), -float(length), done, False, {"illegal": illegal}


def play(choose, n_episodes=500):
    env, length, n_illegal = TSPEnv(), 0.0, 0
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed)
        for _ in range(N_CITIES - 1):
            observation, reward, _, _, info = env.step(choose(observation))
            length, n_illegal = length - reward, n_illegal + info["illegal"]
    return length / n_episodes, n_illegal


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=50_000, help="default: %(default)s")
if __name__ == "__main__":
    network = dict(embed_dim=32, n_layers=1, n_heads=4, ff_dim=64)
    settings = dict(n_steps=18, batch_size=144, n_epochs=4, learning_rate=2e-3, gamma=1.0, seed=0, policy_kwargs=network)
    model = PPO(MaskedAttentionPolicy, make_vec_env(TSPEnv, 32, 10_000), **settings)
    model.learn(parser.parse_args().timesteps)
    chance, _ = play(lambda obs: np.random.choice(np.flatnonzero(obs["action_mask"])))
    greedy, _ = play(lambda obs: (((obs["nodes"] - obs["context"][:2]) ** 2).sum(1) + 9 * (1 - obs["action_mask"])).argmin())
    found, n_illegal = play(lambda obs: model.predict(obs, deterministic=True)[0])
    print(f"Tour length: {chance:.2f} at random, {greedy:.2f} to the nearest, {found:.2f} learned; illegal: {n_illegal}")

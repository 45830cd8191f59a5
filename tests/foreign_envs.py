"""Small environments that know nothing of this package, with masks, and models for them."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import obs_as_tensor

from sb3_uav.policies import MaskedAttentionPolicy
from sb3_uav.reinforce import REINFORCE

SMALL: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)


class PickEnv(gym.Env[Any, Any]):
    """
    Pick the nodes of the largest values, each once, then stop; illegal actions are counted and end the episode.

    :param n_nodes: Number of nodes, padded ones included
    :param n_real: Number of real nodes; without a padding mask when None
    :param n_others: Number of actions beside the nodes, all of which end the episode
    :param changing: Whether the nodes hold a flag of what has been picked
    :param n_actions: Number of actions where none is for a node: each pays the feature of one; None elsewhere
    :param names: Names of the keys
    :param flat: Whether the node set is flat
    """

    def __init__(self, n_nodes=6, n_real=None, n_others=0, changing=False, n_actions=None, names=None, flat=False):
        self.n_nodes, self.n_real, self.n_others, self.changing, self.flat = n_nodes, n_real, n_others, changing, flat
        self.names = names or {}
        n_features = 2 + changing
        self.n_actions = n_nodes + n_others if n_actions is None else n_actions
        found: dict[str, Any] = {
            "nodes": spaces.Box(0, 1, (n_nodes * n_features,) if flat else (n_nodes, n_features), np.float32),
            "context": spaces.Discrete(n_nodes + 1),
            "action_mask": spaces.MultiBinary(self.n_actions),
        }
        if n_real is not None:
            found["padding_mask"] = spaces.MultiBinary(n_nodes)
        self.observation_space = spaces.Dict({self.names.get(key, key): space for key, space in found.items()})
        self.action_space = spaces.Discrete(self.n_actions)
        self.n_illegal = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        n_real = self.n_nodes if self.n_real is None else int(self.np_random.integers(1, self.n_real + 1))
        self.real = np.arange(self.n_nodes) < n_real
        self.nodes = self.np_random.random((self.n_nodes, 2), dtype=np.float32)
        self.picked, self.n_steps = np.zeros(self.n_nodes, bool), 0
        self.legal_others = self.np_random.random(self.n_actions) < 0.5
        return self.observe(), {}

    def action_masks(self):
        if self.n_actions < self.n_nodes:
            return self.legal_others | (np.arange(self.n_actions) == self.n_steps % self.n_actions)
        return np.concatenate([self.real & ~self.picked, np.ones(self.n_actions - self.n_nodes, bool)])

    def observe(self):
        nodes = np.hstack([self.nodes, self.picked[:, None]]).astype(np.float32) if self.changing else self.nodes
        found = {
            "nodes": nodes.ravel() if self.flat else nodes.copy(),
            "context": int(self.picked.sum()),
            "action_mask": self.action_masks().astype(np.int8),
        }
        if self.n_real is not None:
            found["padding_mask"] = self.real.astype(np.int8)
        return {self.names.get(key, key): value for key, value in found.items()}

    def step(self, action):
        mask = self.action_masks()
        legal = bool(mask[action])
        self.n_illegal += not legal
        self.n_steps += 1
        reward, done = 0.0, not legal
        if legal and self.n_actions < self.n_nodes:
            reward, done = float(self.nodes[action, 0]), self.n_steps == 5
            self.legal_others = self.np_random.random(self.n_actions) < 0.5
        elif legal:
            if action < self.n_nodes:
                reward, self.picked[action] = float(self.nodes[action, 0]) - 0.5, True
            done = action >= self.n_nodes or not (self.real & ~self.picked).any()
        return self.observe(), reward, bool(done), False, {"illegal": self.n_illegal}


KINDS: dict[str, dict[str, Any]] = {
    "nodes": {},
    "others": dict(n_others=2),
    "changing": dict(changing=True),
    "padded": dict(n_real=4, n_others=1),
    "head": dict(n_actions=3),
    "flat": dict(flat=True, n_real=6, n_others=1),
}

CPU = th.device("cpu")
ALGORITHMS: dict[str, Any] = {"ppo": PPO, "a2c": A2C, "ppo_mask": MaskablePPO, "reinforce": REINFORCE}
POLICY: Any = MaskedAttentionPolicy


def make_env(n_envs: int = 4, **kwargs: Any) -> Any:
    return make_vec_env(PickEnv, n_envs, seed=0, env_kwargs=kwargs)


def make_model(algo: str, env: Any, policy: Any = POLICY, **kwargs: Any) -> Any:
    settings: dict[str, Any] = dict(n_steps=8, policy_kwargs=dict(SMALL), seed=0, device="cpu", gamma=1.0)
    if algo in ("ppo", "ppo_mask"):
        settings.update(batch_size=16, n_epochs=2)
    return ALGORITHMS[algo](policy, env, **{**settings, **kwargs})


def make_policy(env: Any, **kwargs: Any) -> Any:
    th.manual_seed(0)
    policy = POLICY(env.observation_space, env.action_space, lambda _: 1e-3, **{**SMALL, **kwargs})
    policy.set_training_mode(False)
    return policy


def tensors(observation: Any) -> Any:
    return obs_as_tensor(observation, CPU)

"""
Rollout buffers for our policies under SB3's on-policy algorithms.

SB3 stores the whole observation at every step (DLR-RM/stable-baselines3#834) and trains on shuffled steps. These buffers store
what an episode keeps once, and their minibatches hold whole episodes, so that the policy encodes every instance once in each.
``PPO.train()``, ``A2C.train()`` and ``MaskablePPO.train()`` stay what they are.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uav.envs.problem import static_keys_of
from sb3_uav.policies.grouping import EPISODE_INDEX
from sb3_uav.policies.masked_policy import MaskedPolicy


class EpisodeRolloutBuffer(DictRolloutBuffer):
    """
    ``DictRolloutBuffer`` for PPO and A2C with the policies of this package.

    An episode that ``n_steps`` cuts in two is stored as two fragments, each with its own copy of the static part; so is one
    whose static part a wrapper changes on the way, as ``VecNormalize`` does. Advantages are SB3's. Samples differ from those
    of SB3 in their observations: static keys have one row per fragment of the minibatch, and ``episode_index`` ``(batch,)``
    int64 says which of them belongs to each step. ``MultiInputPolicy`` has no extractor for that key and raises
    ``KeyError``; use SB3's own buffer with it.

    :param buffer_size: Max number of element in the buffer
    :param observation_space: Observation space of one of our environments
    :param action_space: Action space
    :param device: PyTorch device
    :param gae_lambda: Factor for trade-off of bias vs variance for Generalized Advantage Estimator
    :param gamma: Discount factor
    :param n_envs: Number of parallel environments
    :param static_keys: Keys of the observation that an episode keeps; those that the policy encodes. When None, those of the
        environments of sb3_uav
    :raises ValueError: If the observation space has not these keys and others
    """

    _starts: np.ndarray
    _fragments: np.ndarray
    _latest: dict[str, np.ndarray]
    step_fields: ClassVar[tuple[str, ...]] = ("actions", "values", "log_probs", "advantages", "returns")

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        gae_lambda: float = 1,
        gamma: float = 0.99,
        n_envs: int = 1,
        static_keys: tuple[str, ...] | None = None,
    ):
        if static_keys is None:
            static_keys = static_keys_of(observation_space)
        if not isinstance(observation_space, spaces.Dict) or not set(static_keys) < set(observation_space.spaces):
            raise ValueError(
                f"{type(self).__name__} needs the Dict observation of a sb3_uav environment, or rollout_buffer_kwargs="
                f"dict(static_keys=...) for another one, found {observation_space}; or use SB3's own buffer."
            )
        self.static_keys = static_keys
        super().__init__(buffer_size, observation_space, action_space, device, gae_lambda, gamma, n_envs)

    def reset(self) -> None:
        for key in self.static_keys:
            # The parent class allocates a row per step for every key of obs_shape.
            self.obs_shape.pop(key, None)
        super().reset()
        self._static: dict[str, list[np.ndarray]] = {key: [] for key in self.static_keys}
        self._n_fragments = 0
        self._current = np.zeros(self.n_envs, dtype=np.int64)
        self._fragments = np.zeros((self.buffer_size, self.n_envs), dtype=np.int64)

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        episode_start: np.ndarray,
        value: th.Tensor,
        log_prob: th.Tensor,
        **kwargs: Any,
    ) -> None:
        """
        :param obs: Observation
        :param action: Action
        :param reward: Reward
        :param episode_start: Start of episode signal
        :param value: Estimated value of the current state
        :param log_prob: Log-probability of the action
        :param kwargs: What a parent class takes besides
        """
        if self.pos == 0:
            self._latest = {key: np.array(obs[key], dtype=self.observation_space[key].dtype) for key in self.static_keys}
        changed = [(obs[key] != latest).reshape(self.n_envs, -1).any(axis=1) for key, latest in self._latest.items()]
        started = np.flatnonzero(np.logical_or.reduce([episode_start, *changed]) | (self.pos == 0))
        if len(started) > 0:
            self._current[started] = self._n_fragments + np.arange(len(started))
            self._n_fragments += len(started)
            for key, rows in self._static.items():
                self._latest[key][started] = obs[key][started]
                rows.append(self._latest[key][started])
        self._fragments[self.pos] = self._current
        super().add(obs, action, reward, episode_start, value, log_prob, **kwargs)

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """
        :param batch_size: About how many steps a minibatch has; as it holds whole episodes, it has some more or fewer. When
            None, everything comes at once
        :return: The minibatches, in random order; none has a single step, which MaskablePPO would make NaN of, unless there
            is no other
        """
        assert self.full, "The buffer must be filled before it is read."
        if not self.generator_ready:
            self._flatten()
        fragments = np.random.permutation(self._n_fragments)
        lengths = np.diff(self._starts)[fragments]
        for chosen in _split_evenly(lengths, batch_size or len(self._fragments)):
            yield self._get_samples(np.concatenate([np.arange(*self._starts[i : i + 2]) for i in fragments[chosen]]))

    def _flatten(self) -> None:
        """Put the steps of each environment behind one another: every fragment is a run of them, numbered in this order."""
        for key, rows in self.observations.items():
            self.observations[key] = self.swap_and_flatten(rows)
        for name in self.step_fields:
            setattr(self, name, self.swap_and_flatten(getattr(self, name)))
        by_env = self.swap_and_flatten(self._fragments)[:, 0]
        self._starts = np.concatenate([[0], np.flatnonzero(np.diff(by_env)) + 1, [len(by_env)]])
        began = by_env[self._starts[:-1]]
        self._fragments = np.repeat(np.arange(self._n_fragments), np.diff(self._starts))
        self._static = {key: [np.concatenate(rows)[began]] for key, rows in self._static.items()}
        self.generator_ready = True

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/buffers.py#L831
    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        samples = super()._get_samples(batch_inds, env)
        fragments, index = np.unique(self._fragments[batch_inds], return_inverse=True)
        samples.observations.update({key: self.to_torch(rows[0][fragments]) for key, rows in self._static.items()})
        samples.observations[EPISODE_INDEX] = self.to_torch(index)
        return samples


class MaskableEpisodeRolloutBuffer(EpisodeRolloutBuffer, MaskableDictRolloutBuffer):  # type: ignore[misc]
    """:class:`EpisodeRolloutBuffer` for MaskablePPO; see there for the parameters."""

    step_fields = (*EpisodeRolloutBuffer.step_fields, "action_masks")


def _split_evenly(lengths: np.ndarray, batch_size: int) -> list[np.ndarray]:
    """
    Cut a sequence of fragments into runs of about equally many steps.

    :param lengths: Number of steps of each fragment
    :param batch_size: About how many steps a run has
    :return: Indices of the fragments of each run; no run has a single step unless there is no other
    """
    total = int(lengths.sum())
    ends = lengths.cumsum()
    run = (ends - (lengths + 1) / 2) // (total / np.ceil(total / batch_size))
    runs = np.split(np.arange(len(lengths)), np.flatnonzero(np.diff(run)) + 1)
    whole: list[np.ndarray] = []
    for chosen in runs:
        if whole and (lengths[chosen].sum() == 1 or lengths[whole[-1]].sum() == 1):
            whole[-1] = np.concatenate([whole[-1], chosen])
        else:
            whole.append(chosen)
    return whole


def use_episode_buffer(model: BaseAlgorithm) -> None:
    """
    Replace the rollout buffer of a stock PPO, A2C or MaskablePPO by that for whole episodes; if it is one already, keep it.

    :param model: The algorithm, between two rollouts
    :raises ValueError: If the algorithm, its policy or its buffer is of another kind
    """
    if not isinstance(model, OnPolicyAlgorithm) or not isinstance(model.policy, MaskedPolicy):
        raise ValueError(
            "The episode rollout buffer is for PPO, A2C and MaskablePPO with AllocatorPolicy, RouterPolicy or "
            f"MaskedAttentionPolicy, found {type(model).__name__} with {type(model.policy).__name__}."
        )
    buffer = model.rollout_buffer
    if isinstance(buffer, EpisodeRolloutBuffer):
        return
    replacements: dict[type, type[EpisodeRolloutBuffer]] = {
        DictRolloutBuffer: EpisodeRolloutBuffer,
        MaskableDictRolloutBuffer: MaskableEpisodeRolloutBuffer,
    }
    if type(buffer) not in replacements:
        raise ValueError(f"The episode rollout buffer replaces SB3's own buffers only, found {type(buffer).__name__}.")
    model.rollout_buffer = replacements[type(buffer)](
        buffer.buffer_size,
        buffer.observation_space,
        buffer.action_space,
        buffer.device,
        gae_lambda=buffer.gae_lambda,
        gamma=buffer.gamma,
        n_envs=buffer.n_envs,
        static_keys=model.policy.features_extractor.static_keys,
    )


class EpisodeBufferCallback(BaseCallback):
    """
    Give a stock algorithm the episode rollout buffer when its training starts.

    For YAML files: rl_zoo3 takes callbacks by name, but not ``rollout_buffer_class``. In Python, give that argument instead.
    """

    def _init_callback(self) -> None:
        use_episode_buffer(self.model)

    def _on_step(self) -> bool:
        return True

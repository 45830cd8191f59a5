"""
Policies that encode an instance once and decode it many times.

``encode(instances) -> cache`` and ``decode_step(cache, state) -> logits, values`` are the only places that compute logits.
SB3's step loop reaches them through :meth:`~sb3_uav.policies.masked_policy.MaskedPolicy._decode_observation`; the fused driver
through :meth:`EpisodicPolicy.decode_episodes` and :meth:`EpisodicPolicy.evaluate_episodes`.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from sb3_uav.envs.instances import Instances
from sb3_uav.policies.extractor import Cache, EpisodicExtractor
from sb3_uav.policies.masked_policy import MaskedPolicy
from sb3_uav.policies.memory import rows_that_fit
from sb3_uav.policies.static_observation import StaticObservation


class EpisodeEvaluation(NamedTuple):
    """
    The current policy's view of complete episodes; every tensor is ``(batch, n_samples, n_steps)``.

    :param log_prob: Log-probability of each action; 0 in steps after the end
    :param values: The critic's estimate before each action
    :param entropy: Entropy of the masked distribution of each action
    """

    log_prob: th.Tensor
    values: th.Tensor
    entropy: th.Tensor


class EpisodicPolicy(MaskedPolicy):
    """
    A policy for one level of our environments, which also plays whole episodes without stepping through them.

    The mask comes from ``observation["action_mask"]`` when the algorithm passes no ``action_masks``, so it cannot be
    forgotten. Its networks work for any number of tasks; the observation space binds only SB3's step loop to one.
    See :class:`~sb3_uav.policies.masked_policy.MaskedPolicy` for the arguments.
    """

    # What messages call it.
    level: ClassVar[str]
    extractor_class: ClassVar[type[EpisodicExtractor]]
    features_extractor: EpisodicExtractor

    @classmethod
    @abstractmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        """
        Spaces of a small instance, for a policy that is used only through the fused driver.

        :param n_actions: Number of actions, where the network depends on it
        :return: Observation space, action space
        """

    def rows_that_fit(self, n_nodes: int, n_subsets: int = 0) -> int:
        """
        :param n_nodes: Nodes of each instance, the depot included
        :param n_subsets: Number of subsets into which each instance is split at once
        :return: Number of instances this policy can process at once, at least 1
        """
        return rows_that_fit(self.device, n_nodes, n_subsets)

    # ---------------------------------------------------------------------------------------------------- decoding

    def task_order(self, instances: Instances, variant: int = 0) -> th.Tensor:
        """
        The policy's preferred order of the tasks.

        :param instances: ``batch`` instances
        :param variant: 0 for the order used in greedy decoding; others give alternatives to sample from
        :return: ``(batch, n_tasks)`` int64, index of the first task, the second, ...
        """
        return th.arange(instances.n_tasks, device=instances.device).expand(len(instances), -1)

    def arrange(self, instances: Instances) -> Instances:
        """
        :param instances: Any instances
        :return: The instances, tasks in the policy's preferred order
        """
        return instances.reorder(self.task_order(instances))

    def encode(self, instances: Instances) -> Cache:
        """
        :param instances: ``batch`` instances on the device of the policy
        :return: Their encodings
        """
        self.check_problem(instances)
        return self.features_extractor.encode(StaticObservation.from_instances(instances))

    def check_problem(self, instances: Instances) -> None:
        """
        :param instances: Any instances
        :raises ValueError: If they go beyond what the network sees
        """
        beyond = instances.beyond_the_paper
        if beyond and not self.settings.whole:
            raise ValueError(
                f"This {type(self).__name__} sees only the paper's problem, but the instances have {', '.join(beyond)}; use "
                "one with preset='whole'."
            )

    def decode_step(self, cache: Cache, state: Any) -> tuple[th.Tensor, th.Tensor]:
        """
        :param cache: Encodings of ``batch`` instances
        :param state: The decoder's state with ``n_samples`` episodes (or steps of episodes) per instance
        :return: Unmasked logits ``(batch, n_samples, n_actions)``, values ``(batch, n_samples)``
        """
        return self._heads(self.features_extractor.decode(cache, state))

    @abstractmethod
    def _decode_episodes(
        self, instances: Instances, cache: Any, n_samples: int, deterministic: bool, generator: th.Generator | None
    ) -> th.Tensor:
        """The level's part of :meth:`decode_episodes`."""

    @abstractmethod
    def _episode_states(self, instances: Instances, cache: Any, actions: th.Tensor) -> tuple[Any, th.Tensor]:
        """
        The decoder's states before every action of complete episodes.

        :param instances: ``batch`` instances
        :param cache: Their encodings
        :param actions: ``(batch, n_samples, n_steps)`` int64
        :return: The states, ``(batch, n_samples * n_steps, ...)``, and their action masks
        """

    @th.no_grad()
    def decode_episodes(
        self,
        instances: Instances,
        n_samples: int = 1,
        deterministic: bool = True,
        generator: th.Generator | None = None,
        cache: Cache | None = None,
    ) -> th.Tensor:
        """
        Play complete episodes on the policy's device, without an environment.

        :param instances: ``batch`` instances on the device of the policy
        :param n_samples: Episodes per instance, all from one encoding
        :param deterministic: Whether to take the most probable action instead of sampling
        :param generator: Source of randomness, on the same device
        :param cache: Encodings of the instances; computed here when None
        :return: Actions ``(batch, n_samples, n_steps)`` int64
        """
        if cache is None:
            # As predict does; a caller that trains passes the encodings.
            self.set_training_mode(False)
            cache = self.encode(instances)
        return self._decode_episodes(instances, cache.detach(), n_samples, deterministic, generator)

    def evaluate_episodes(self, instances: Instances, actions: th.Tensor, cache: Cache | None = None) -> EpisodeEvaluation:
        """
        Evaluate all actions of complete episodes in one parallel pass, with gradients.

        :param instances: ``batch`` instances on the device of the policy
        :param actions: ``(batch, n_samples, n_steps)`` int64, legal ones
        :param cache: Encodings of the instances; computed here when None
        :return: Log-probabilities, values and entropies
        """
        cache = self.encode(instances) if cache is None else cache
        state, action_mask = self._episode_states(instances, cache, actions)
        logits, values = self.decode_step(cache, state)
        log_probs = logits.masked_fill(~action_mask, -th.inf).log_softmax(-1)
        log_prob = log_probs.gather(-1, actions.flatten(1)[..., None]).squeeze(-1)
        # 0 * -inf is NaN, also in the gradient, so illegal actions are removed before the product.
        legal_log_probs = log_probs.masked_fill(~action_mask, 0.0)
        entropy = -(legal_log_probs.exp() * legal_log_probs).sum(-1)
        return EpisodeEvaluation(*(field.view(actions.shape) for field in (log_prob, values, entropy)))

    # ---------------------------------------------------------------------------------------------------- parameters

    @classmethod
    def from_parameters(cls, parameters: dict[str, th.Tensor], policy_kwargs: dict[str, Any], device: Any) -> Any:
        """
        Build a policy for the fused driver from a state dict.

        :param parameters: The state dict of a policy of this class
        :param policy_kwargs: The arguments the policy was built with
        :param device: Device of the policy
        :return: The policy, in evaluation mode
        :raises ValueError: If the state dict does not fit the arguments
        """
        weight = parameters.get("action_net.weight")
        observation_space, action_space = cls.placeholder_spaces(None if weight is None else len(weight))
        policy = cls(observation_space, action_space, lambda _: 0.0, **policy_kwargs)
        try:
            policy.load_state_dict(parameters)
        except RuntimeError as error:
            raise ValueError(f"the parameters are not those of a {cls.__name__}({policy_kwargs}): {error}") from error
        policy.set_training_mode(False)
        return policy.to(get_device(device))

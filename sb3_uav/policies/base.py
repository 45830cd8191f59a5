"""
Policies that encode an instance once and decode it many times.

``encode(instances) -> cache`` and ``decode_step(cache, state) -> logits, values`` are the only places that compute logits.
SB3's step loop reaches them through :meth:`EpisodicPolicy._decode_observation`; the fused driver through
:meth:`EpisodicPolicy.decode_episodes` and :meth:`EpisodicPolicy.evaluate_episodes`.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.distributions import MaskableDistribution
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_uav.envs.instances import Instances
from sb3_uav.policies.extractor import Cache, EpisodicExtractor
from sb3_uav.policies.grouping import EPISODE_INDEX
from sb3_uav.policies.memory import rows_that_fit
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.torch_state import float32_on_cpu, is_recorded

SelfPolicy = TypeVar("SelfPolicy", bound="EpisodicPolicy")


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


def sample_actions(logits: th.Tensor, deterministic: bool, generator: th.Generator | None) -> th.Tensor:
    """
    Choose actions; an action of probability 0 is never chosen.

    :param logits: ``(..., n_actions)``, -inf where an action is illegal
    :param deterministic: Whether to take the most probable action instead of sampling
    :param generator: Source of randomness, on the device of the logits
    :return: ``(...)`` int64
    """
    if deterministic:
        return logits.argmax(-1)
    # Gumbel-max: illegal actions stay at -inf, and the exponential draw is never 0.
    noise = th.empty_like(logits).exponential_(generator=generator)
    return (logits - noise.clamp(min=th.finfo(logits.dtype).tiny).log()).argmax(-1)


class EpisodicPolicy(MaskableActorCriticPolicy):
    """
    A masked categorical actor-critic policy with attention, for stock PPO, A2C and MaskablePPO and for our REINFORCE.

    The mask comes from ``observation["action_mask"]`` when the algorithm passes no ``action_masks``, so it cannot be
    forgotten. Its networks work for any number of tasks; the observation space binds only SB3's step loop to one.

    :param observation_space: Observation space of one of our environments
    :param action_space: Action space of the same environment
    :param lr_schedule: Learning rate schedule (could be constant)
    :param preset: ``"default"``, or ``"paper"`` for the network of the paper
    :param net_arch: Hidden layers between features and heads, as in SB3; none by default
    :param activation_fn: Activation function of ``net_arch``
    :param ortho_init: Whether to use SB3's orthogonal initialization
    :param use_sde: Must be False; stock PPO and A2C pass it
    :param optimizer_class: The optimizer to use
    :param optimizer_kwargs: Additional keyword arguments of the optimizer
    :param settings: Fields of :class:`~sb3_uav.policies.settings.NetworkSettings` that override the preset's
    :raises TypeError: If there is no such setting
    :raises ValueError: If an argument is not allowed
    """

    extractor_class: ClassVar[type[EpisodicExtractor]]
    features_extractor: EpisodicExtractor

    @float32_on_cpu()
    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        preset: str = "default",
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        ortho_init: bool = False,
        use_sde: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        if use_sde:
            raise ValueError("use_sde must be False: state-dependent exploration is for continuous actions.")
        self.settings = NetworkSettings.of(settings, preset)
        self._own_parameters: dict[str, Any] = {"preset": preset, **settings}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=[] if net_arch is None else net_arch,
            activation_fn=activation_fn,
            ortho_init=ortho_init,
            features_extractor_class=self.extractor_class,
            features_extractor_kwargs=asdict(self.settings),
            normalize_images=False,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    # https://github.com/Stable-Baselines-Team/stable-baselines3-contrib/blob/v2.9.2/sb3_contrib/common/maskable/policies.py#L169
    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for key in ("features_extractor_class", "features_extractor_kwargs", "normalize_images", "squash_output"):
            data.pop(key, None)
        return {**data, **self._own_parameters}

    @classmethod
    @abstractmethod
    def placeholder_spaces(cls, n_actions: int | None) -> tuple[spaces.Dict, spaces.Discrete]:
        """
        Spaces of a small instance, for a policy that is used only through the fused driver.

        :param n_actions: Number of actions, where the network depends on it
        :return: Observation space, action space
        """

    def untrained_copy(self: SelfPolicy, seed: int) -> SelfPolicy:
        """
        :param seed: Seed for the initial parameters; torch's global random state stays as it is
        :return: A policy of the same architecture with new parameters, on the same device, in evaluation mode
        """
        with th.random.fork_rng(devices=[]):
            th.default_generator.manual_seed(seed)
            fresh = type(self)(**self._get_constructor_parameters())
        fresh.set_training_mode(False)
        return fresh.to(self.device)

    def rows_that_fit(self, n_nodes: int, n_subsets: int = 0) -> int:
        """
        :param n_nodes: Nodes of each instance, the depot included
        :param n_subsets: Number of subsets into which each instance is split at once
        :return: Number of instances this policy can process at once, at least 1
        """
        return rows_that_fit(self.device, n_nodes, n_subsets)

    # ---------------------------------------------------------------------------------------------------- heads

    # https://github.com/Stable-Baselines-Team/stable-baselines3-contrib/blob/v2.9.2/sb3_contrib/common/maskable/policies.py#L186
    def _build_mlp_extractor(self) -> None:
        # Where features begin with logits, whose number varies, only what follows is input of the critic's layers.
        features_dim = self.features_dim
        self.features_dim = self.features_extractor.context_dim or features_dim
        super()._build_mlp_extractor()
        self.features_dim = features_dim

    # https://github.com/Stable-Baselines-Team/stable-baselines3-contrib/blob/v2.9.2/sb3_contrib/common/maskable/policies.py#L201
    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if self.features_extractor.context_dim is not None:
            self.action_net = nn.Identity()
            self.mlp_extractor.policy_net = nn.Sequential()
            self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _heads(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: ``(..., features)``
        :return: Unmasked logits ``(..., n_actions)``, values ``(...)``
        """
        context_dim = self.features_extractor.context_dim
        if context_dim is None:
            logits = self.action_net(self.mlp_extractor.forward_actor(features))
        else:
            logits, features = features[..., :-context_dim], features[..., -context_dim:]
        return logits, self.value_net(self.mlp_extractor.forward_critic(features)).squeeze(-1)

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
        return self.features_extractor.encode(StaticObservation.from_instances(instances))

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

    # ---------------------------------------------------------------------------------------------------- SB3's step loop

    def _decode_observation(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: ``batch`` observations
        :return: Unmasked logits ``(batch, n_actions)``, values ``(batch,)``
        """
        assert isinstance(obs, dict)
        # The index is not part of the observation space, whose keys preprocessing expects.
        observation = {key: value for key, value in obs.items() if key != EPISODE_INDEX}
        preprocessed = preprocess_obs(observation, self.observation_space, normalize_images=False)
        assert isinstance(preprocessed, dict)
        if EPISODE_INDEX in obs:
            preprocessed[EPISODE_INDEX] = obs[EPISODE_INDEX]
        return self._heads(self.features_extractor(preprocessed))

    def _mask(self, obs: PyTorchObs, logits: th.Tensor, action_masks: np.ndarray | th.Tensor | None) -> th.Tensor:
        """
        :param obs: ``batch`` observations
        :param logits: ``(batch, n_actions)``
        :param action_masks: The mask of each; that of the observation when None
        :return: ``(batch, n_actions)`` bool
        :raises ValueError: If a row has no legal action
        """
        assert isinstance(obs, dict)
        given = obs["action_mask"] if action_masks is None else action_masks
        mask = th.as_tensor(given, dtype=th.bool, device=logits.device).reshape(logits.shape)
        if is_recorded():
            return mask
        legal = mask.any(-1)
        if not legal.all():
            rows = (~legal).nonzero()[:, 0].tolist()
            source = 'observation["action_mask"]' if action_masks is None else "action_masks"
            raise ValueError(
                f"{source} allows no action in row {rows[0]} ({len(rows)} of {len(legal)} rows); set at least one entry of "
                "each row to 1, and reset an environment whose episode is over before asking for its next action."
            )
        return mask

    def _distribution(
        self, obs: PyTorchObs, logits: th.Tensor, action_masks: np.ndarray | th.Tensor | None
    ) -> MaskableDistribution:
        """
        :param obs: ``batch`` observations
        :param logits: ``(batch, n_actions)``
        :param action_masks: The mask of each; that of the observation when None
        :return: The masked distribution
        :raises ValueError: If a row has no legal action
        """
        mask = self._mask(obs, logits, action_masks)
        distribution = self.action_dist.proba_distribution(action_logits=logits)
        distribution.apply_masking(mask)
        return distribution

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False, action_masks: np.ndarray | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        logits, values = self._decode_observation(obs)
        if is_recorded():
            # torch's distributions look at the numbers to validate them, which cannot be exported.
            masked = logits.masked_fill(~self._mask(obs, logits, action_masks), -th.inf)
            actions = sample_actions(masked, deterministic, None)
            return actions, values[:, None], masked.log_softmax(-1).gather(-1, actions[:, None])[:, 0]
        distribution = self._distribution(obs, logits, action_masks)
        actions = distribution.get_actions(deterministic=deterministic)
        return actions, values[:, None], distribution.log_prob(actions)

    def evaluate_actions(
        self, obs: PyTorchObs, actions: th.Tensor, action_masks: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        logits, values = self._decode_observation(obs)
        distribution = self._distribution(obs, logits, action_masks)
        return values[:, None], distribution.log_prob(actions), distribution.entropy()

    def get_distribution(self, obs: PyTorchObs, action_masks: np.ndarray | None = None) -> MaskableDistribution:
        return self._distribution(obs, self._decode_observation(obs)[0], action_masks)

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        return self._decode_observation(obs)[1][:, None]

    def masked_logits(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: ``batch`` observations
        :return: ``(batch, n_actions)``, -inf where an action is illegal
        :raises ValueError: If a row has no legal action
        """
        logits = self._decode_observation(obs)[0]
        return logits.masked_fill(~self._mask(obs, logits, None), -th.inf)

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

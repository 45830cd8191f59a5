"""
Masked categorical actor-critic policies with attention: what all policies of this package share.

SB3's step loop (``forward``, ``evaluate_actions``, ``get_distribution``, ``predict_values``, ``_predict``) gets its logits and
values from one method, :meth:`MaskedPolicy._decode_observation`, and its masks from another, :meth:`MaskedPolicy._mask`.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.distributions import MaskableDistribution
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_uav.common.divergence import SMALLER_STEPS, DivergenceError, first_bad, level_of
from sb3_uav.common.imports import import_object
from sb3_uav.common.random_streams import exponential_noise
from sb3_uav.policies.extractor import EncodeOnceExtractor
from sb3_uav.policies.grouping import EPISODE_INDEX
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.torch_state import float32_on_cpu, is_recorded

SelfPolicy = TypeVar("SelfPolicy", bound="MaskedPolicy")


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
    noise = exponential_noise(logits, generator)
    return (logits - noise.clamp(min=th.finfo(logits.dtype).tiny).log()).argmax(-1)


class MaskedPolicy(MaskableActorCriticPolicy):
    """
    A masked categorical actor-critic policy with attention, for stock PPO, A2C and MaskablePPO and for our REINFORCE.

    The mask comes from the observation when the algorithm passes no ``action_masks``, so it cannot be forgotten.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param preset: ``"default"``, or ``"paper"`` for a network of the paper's shape
    :param net_arch: Hidden layers between features and heads, as in SB3; none by default
    :param activation_fn: Activation function of ``net_arch``
    :param ortho_init: Whether to use SB3's orthogonal initialization
    :param features_extractor_class: Subclass of the policy's own extractor, or its dotted name; the extractor itself when None
    :param features_extractor_kwargs: Additional keyword arguments of the extractor
    :param use_sde: Must be False; stock PPO and A2C pass it
    :param optimizer_class: The optimizer to use
    :param optimizer_kwargs: Additional keyword arguments of the optimizer
    :param settings: Fields of :class:`~sb3_uav.policies.settings.NetworkSettings` that override the preset's
    :raises TypeError: If there is no such setting
    :raises ValueError: If an argument is not allowed
    """

    # The extractor when none is given, and the class that any other must subclass, because the policy relies on its methods.
    extractor_class: ClassVar[type[EncodeOnceExtractor]]
    required_extractor_class: ClassVar[type[EncodeOnceExtractor]]
    features_extractor: EncodeOnceExtractor
    # Key of the mask in the observation.
    mask_key = "action_mask"

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
        features_extractor_class: type[EncodeOnceExtractor] | str | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        use_sde: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        if use_sde:
            raise ValueError("use_sde must be False: state-dependent exploration is for continuous actions.")
        extractor_kwargs = dict(features_extractor_kwargs or {})
        self.settings = self._network_settings(_merged_settings(settings, extractor_kwargs), preset)
        self._own_parameters: dict[str, Any] = {
            "preset": preset,
            "features_extractor_class": features_extractor_class,
            "features_extractor_kwargs": features_extractor_kwargs,
            **settings,
        }
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=[] if net_arch is None else net_arch,
            activation_fn=activation_fn,
            ortho_init=ortho_init,
            features_extractor_class=self._find_extractor_class(features_extractor_class),
            features_extractor_kwargs={**self._extractor_settings(), **extractor_kwargs},
            normalize_images=False,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    def _network_settings(self, settings: dict[str, Any], preset: str) -> NetworkSettings:
        """
        :param settings: Fields that override the preset's
        :param preset: Name of the preset
        :return: The shape of the network
        """
        return NetworkSettings.of(settings, preset)

    def _extractor_settings(self) -> dict[str, Any]:
        """:return: The keyword arguments with which the policy makes its extractor"""
        return asdict(self.settings)

    def _find_extractor_class(self, given: Any) -> type[EncodeOnceExtractor]:
        """
        :param given: A class, its dotted name, or None for the policy's own
        :return: The class
        :raises ValueError: If it cannot be imported, or does not fit the policy
        """
        what = f"features_extractor_class of {type(self).__name__}"
        if given is None:
            what, given = f"extractor_class of {type(self).__name__}", self.extractor_class
        if isinstance(given, str):
            try:
                given = import_object(given)
            except ValueError as error:
                raise ValueError(
                    f"{what} is {given!r}, which cannot be imported ({error}); give the class, or its dotted name such as "
                    "'my_package.extractors.MyExtractor'."
                ) from error
        required = self.required_extractor_class
        if not isinstance(given, type) or not issubclass(given, required):
            name = given.__name__ if isinstance(given, type) else repr(given)
            raise ValueError(f"{what} is {name}; it must be a subclass of {required.__module__}.{required.__name__}.")
        return given

    # https://github.com/Stable-Baselines-Team/stable-baselines3-contrib/blob/v2.9.2/sb3_contrib/common/maskable/policies.py#L169
    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for key in ("features_extractor_class", "features_extractor_kwargs", "normalize_images", "squash_output"):
            data.pop(key, None)
        return {**data, **self._own_parameters}

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
        given = obs[self.mask_key] if action_masks is None else action_masks
        mask = th.as_tensor(given, dtype=th.bool, device=logits.device).reshape(logits.shape)
        if is_recorded():
            return mask
        legal = mask.any(-1)
        if not legal.all():
            rows = (~legal).nonzero()[:, 0].tolist()
            source = f'observation["{self.mask_key}"]' if action_masks is None else "action_masks"
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
        :raises DivergenceError: If a score is NaN
        """
        mask = self._mask(obs, logits, action_masks)
        try:
            distribution = self.action_dist.proba_distribution(action_logits=logits)
            distribution.apply_masking(mask)
        except ValueError as error:
            # Torch's own message prints the scores.
            bad = None if is_recorded() else first_bad(logits)
            if bad is None:
                raise
            raise DivergenceError(
                f"{level_of(self)}: The score of an action is {bad}, because weights or observations are not finite, or far "
                f"too large; train with {SMALLER_STEPS}."
            ) from error
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


def _merged_settings(settings: dict[str, Any], extractor_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    Settings of the network may stand in both places, as SB3's users write them in ``features_extractor_kwargs``.

    :param settings: Fields of :class:`~sb3_uav.policies.settings.NetworkSettings`
    :param extractor_kwargs: Keyword arguments of the extractor; such fields are taken out of it
    :return: All settings
    :raises ValueError: If one is given twice, with different values
    """
    merged = dict(settings)
    for field in fields(NetworkSettings):
        if field.name in extractor_kwargs:
            value = extractor_kwargs.pop(field.name)
            if merged.get(field.name) not in (None, value):
                raise ValueError(
                    f"{field.name} is {merged[field.name]!r} in policy_kwargs and {value!r} in features_extractor_kwargs; "
                    "give it once."
                )
            merged[field.name] = value
    return merged

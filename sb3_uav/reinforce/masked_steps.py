"""Action masks in SB3's step loop, for policies of sb3-contrib, which take them as an argument."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer, MaskableRolloutBuffer
from sb3_contrib.common.maskable.policies import (
    MaskableActorCriticCnnPolicy,
    MaskableActorCriticPolicy,
    MaskableMultiInputActorCriticPolicy,
)
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.vec_env import VecEnv

from sb3_uav.policies.masked_policy import MaskedPolicy

_MASK_KEY = "action_mask"
_MASKABLE: dict[type[BasePolicy], type[BasePolicy]] = {
    ActorCriticPolicy: MaskableActorCriticPolicy,
    ActorCriticCnnPolicy: MaskableActorCriticCnnPolicy,
    MultiInputActorCriticPolicy: MaskableMultiInputActorCriticPolicy,
}


class MaskedRolloutBuffer(MaskableRolloutBuffer):
    """sb3-contrib's buffer, which gets the masks of a step before SB3's loop adds the rest of it."""

    step_masks: np.ndarray | None = None

    def add(self, *args: Any, **kwargs: Any) -> None:
        super().add(*args, action_masks=self.step_masks, **kwargs)


class MaskedDictRolloutBuffer(MaskableDictRolloutBuffer):
    """:class:`MaskedRolloutBuffer` for Dict observations."""

    step_masks: np.ndarray | None = None

    def add(self, *args: Any, **kwargs: Any) -> None:
        super().add(*args, action_masks=self.step_masks, **kwargs)


class MaskedStepLoop(OnPolicyAlgorithm):
    """
    SB3's on-policy algorithm with action masks in its step loop.

    The policies of this package find the mask in the observation. Those of sb3-contrib get it from the environment's
    ``action_masks()``, as in MaskablePPO, or else from ``observation["action_mask"]``. ``"MlpPolicy"``, ``"CnnPolicy"`` and
    ``"MultiInputPolicy"`` are sb3-contrib's where the environment has masks, and SB3's elsewhere.
    """

    # Whether the policy was given by its alias, which leaves the choice of the class to the algorithm.
    _given_by_alias = False

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        self._given_by_alias = True
        return super()._get_policy_from_name(policy_name)

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/on_policy_algorithm.py#L115
    def _setup_model(self) -> None:
        if self.env is not None:
            has_masks = is_masking_supported(self.env) or self._observes_masks
            if self._given_by_alias and has_masks:
                self.policy_class = _MASKABLE.get(self.policy_class, self.policy_class)
            self._check_masks(has_masks)
        if not issubclass(self.policy_class, MaskableActorCriticPolicy):
            super()._setup_model()
            return
        if self._takes_masks:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = MaskedDictRolloutBuffer if is_dict else MaskedRolloutBuffer
        policy_class = self.policy_class
        self.policy_class = _without_sde(policy_class)  # type: ignore[assignment]
        try:
            super()._setup_model()
        finally:
            self.policy_class = policy_class

    def _check_masks(self, has_masks: bool) -> None:
        """
        Warn if the policy ignores the environment's masks.

        :param has_masks: Whether the environment has masks
        :raises ValueError: If the policy needs masks, but the environment has none
        """
        name = self.policy_class.__name__
        if self._takes_masks and not has_masks:
            raise ValueError(
                f"{name} needs action masks, but the environment has none; give it a method action_masks(), wrap it in "
                "sb3-contrib's ActionMasker, or use a policy without masks."
            )
        if has_masks and not issubclass(self.policy_class, MaskableActorCriticPolicy):
            warnings.warn(
                f"{name} ignores the action masks of the environment and will play illegal actions; use MaskedAttentionPolicy "
                "or a policy of sb3_contrib.common.maskable.policies, such as MaskableMultiInputActorCriticPolicy.",
                stacklevel=4,
            )

    @property
    def _takes_masks(self) -> bool:
        """Whether the policy takes masks as an argument alone."""
        return issubclass(self.policy_class, MaskableActorCriticPolicy) and not issubclass(self.policy_class, MaskedPolicy)

    @property
    def _observes_masks(self) -> bool:
        """Whether the observation holds an action mask."""
        space = self.observation_space
        found = space.spaces.get(_MASK_KEY) if isinstance(space, spaces.Dict) else None
        return found is not None and isinstance(self.action_space, spaces.Discrete) and found.shape == (self.action_space.n,)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        if not self._takes_masks:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        from_env = is_masking_supported(env)
        # The environment may have been exchanged.
        self._check_masks(from_env or self._observes_masks)

        def masks_of(obs: Any) -> np.ndarray:
            return get_action_masks(env) if from_env else obs[_MASK_KEY].bool().cpu().numpy()

        with _given_masks(self.policy, rollout_buffer, masks_of):
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Get the policy's action from an observation.

        :param observation: The input observation
        :param state: Not used, as the policies have no hidden states
        :param episode_start: Not used
        :param deterministic: Whether or not to return deterministic actions
        :param action_masks: Which actions are legal; as the observation says, if it does, when None
        :return: The action, and ``state``
        :raises ValueError: If masks are given to a policy that takes none
        """
        if not issubclass(self.policy_class, MaskableActorCriticPolicy):
            if action_masks is not None:
                raise ValueError(f"{self.policy_class.__name__} takes no action_masks; call predict without them.")
            return super().predict(observation, state, episode_start, deterministic)
        if action_masks is None and self._takes_masks and self._observes_masks and isinstance(observation, dict):
            action_masks = observation[_MASK_KEY]
        policy: Any = self.policy
        return policy.predict(observation, state, episode_start, deterministic, action_masks=action_masks)

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L303
    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_given_by_alias"]


def _without_sde(policy_class: type[BasePolicy]) -> Callable[..., BasePolicy]:
    """:return: The class as a function that takes the argument ``use_sde``, which sb3-contrib's policies lack"""

    @wraps(policy_class, updated=())
    def make(*args: Any, use_sde: bool = False, **kwargs: Any) -> BasePolicy:
        return policy_class(*args, **kwargs)

    return make


@contextmanager
def _given_masks(policy: th.nn.Module, buffer: Any, masks_of: Callable[[Any], np.ndarray]) -> Iterator[None]:
    """
    Pass the masks to the policy and to the buffer, which SB3's loop calls without them.

    :param policy: Takes ``action_masks``
    :param buffer: A :class:`MaskedRolloutBuffer` or :class:`MaskedDictRolloutBuffer`
    :param masks_of: Takes the observations, gives their masks ``(n_envs, n_actions)``
    """

    def give(_: th.nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        buffer.step_masks = masks_of(args[0])
        return args, {**kwargs, "action_masks": buffer.step_masks}

    handle = policy.register_forward_pre_hook(give, with_kwargs=True)
    try:
        yield
    finally:
        handle.remove()

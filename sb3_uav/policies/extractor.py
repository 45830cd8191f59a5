"""Feature extractors that encode the unchanging part of observations once and decode it many times."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_uav.envs.problem import STATIC_KEYS, static_keys_of
from sb3_uav.policies.encoder import AttentionEncoder
from sb3_uav.policies.grouping import EPISODE_INDEX, Grouping
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.static_observation import StaticObservation
from sb3_uav.policies.static_rows import changed_rows, copy_rows, distinct_rows, have_equal_shapes, select_rows
from sb3_uav.policies.torch_state import ModuleContents, is_recorded

CacheT = TypeVar("CacheT", bound="Cache")

# Transitions are sorted by instance into a table with as many columns as the longest row needs. When that takes more than this
# many slots per transition, every transition gets a copy of its instance's encoding instead.
_MAX_FILLING = 4


@dataclass(frozen=True)
class Cache:
    """
    The encodings of ``batch`` instances. Every tensor leads with the batch dimension; each network adds what its decoder
    computes in advance: tensors, named tuples of tensors, or None.

    :param nodes: Node embeddings ``(batch, n_nodes, embed_dim)``; of our environments the depot first, then the tasks
    """

    nodes: th.Tensor

    def detach(self: CacheT) -> CacheT:
        """:return: The encodings without gradients"""
        return self._map(th.Tensor.detach)

    def rows(self: CacheT, rows: th.Tensor) -> CacheT:
        """
        :param rows: ``(n,)`` int64
        :return: The encodings of these instances, in this order
        """
        return self._map(lambda field: field[rows])

    def followed_by(self: CacheT, *others: CacheT) -> CacheT:
        """
        :param others: Encodings of further instances by the same network
        :return: The encodings of all, one after the other
        """
        return self._map(lambda *parts: th.cat(parts), *others)

    def update_rows(self: CacheT, rows: th.Tensor, fresh: CacheT) -> CacheT:
        """
        :param rows: ``(n,)`` int64
        :param fresh: A cache of ``n`` instances to put into these rows
        :return: The encodings with these rows replaced
        """
        return self._map(lambda old, new: old.index_copy(0, rows, new), fresh)

    def _map(self: CacheT, function: Callable[..., th.Tensor], *others: CacheT) -> CacheT:
        """
        :param function: Function of one tensor of this cache and the same one of each of the others
        :param others: Caches of the same network
        :return: A cache of the results
        """
        caches = (self, *others)
        return type(self)(*(_map_tensors(function, *(getattr(cache, f.name) for cache in caches)) for f in fields(self)))


def _map_tensors(function: Callable[..., th.Tensor], first: Any, *others: Any) -> Any:
    """
    :param function: Function of tensors
    :param first: A tensor, a named tuple of tensors, or None
    :param others: The same kind of thing
    :return: The same kind of thing, with the results
    """
    if first is None or isinstance(first, th.Tensor):
        return None if first is None else function(first, *others)
    return type(first)(*(_map_tensors(function, *parts) for parts in zip(first, *others, strict=True)))


class _Kept(NamedTuple):
    """
    Encodings, and everything that they depend on.

    :param contents: Parameters and buffers of the extractor
    :param static: Copy of the static part, because an environment may write its next observation into the same memory
    :param cache: Their encodings, the network's :class:`Cache`
    """

    contents: ModuleContents
    static: Any
    cache: Any


class EncodeOnceExtractor(BaseFeaturesExtractor):
    """
    An attention encoder and the part of the decoder before the action distribution, as an SB3 features extractor.

    In evaluation mode and without gradients it keeps the encodings of the last batch and encodes only rows whose static part
    has changed: once per episode instead of once per step. Encodings are used only while all parameters and buffers are what
    they were, see :class:`~sb3_uav.policies.torch_state.ModuleContents`, and never while torch traces or exports the network.
    After a change of the computation itself (a hook, another activation function) call :meth:`clear_cache`.

    With gradients it encodes every instance of a minibatch once, however many transitions it has there. An episode rollout
    buffer says which transitions belong together (key ``episode_index``, int64, beside static parts that stand once per
    episode); with SB3's own buffers it looks for equal rows itself. ``use_cache`` and ``share_encodings`` turn the two off.

    What the static part is, a subclass says: a named tuple of tensors, made from the observation's ``static_keys``.

    :param observation_space: Observation space
    :param features_dim: Size of the features
    :param encoder: Takes the static part of ``batch`` observations, gives node embeddings ``(batch, n_nodes, embed_dim)``
    """

    # Keys of the observation that make up the static part.
    static_keys: tuple[str, ...]
    # Size of what follows the logits in the features, if the features begin with the logits of the actions.
    context_dim: int | None = None

    def __init__(self, observation_space: spaces.Space, features_dim: int, encoder: nn.Module) -> None:
        super().__init__(observation_space, features_dim)
        self.encoder = encoder
        self.use_cache = True
        self.share_encodings = True
        self.n_encoded_rows = 0
        self._kept: _Kept | None = None

    @abstractmethod
    def static_part(self, observation: TensorDict) -> Any:
        """
        :param observation: A batch of preprocessed observations
        :return: The part that is encoded, a named tuple of tensors that lead with the batch dimension
        """

    @abstractmethod
    def precompute(self, nodes: th.Tensor, static: Any) -> Any:
        """
        :param nodes: Node embeddings ``(batch, n_nodes, embed_dim)``
        :param static: The static part they were made from
        :return: Everything that decoding needs, the network's :class:`Cache`
        """

    @abstractmethod
    def observed_state(self, cache: Any, observation: TensorDict) -> Any:
        """
        :param cache: Encodings of ``batch`` instances
        :param observation: The changing part of preprocessed observations, every key ``(batch, n_samples, ...)``
        :return: The decoder's state
        """

    @abstractmethod
    def decode(self, cache: Any, state: Any) -> th.Tensor:
        """
        :param cache: Encodings of ``batch`` instances
        :param state: The decoder's state, ``(batch, n_samples, ...)``
        :return: Features ``(batch, n_samples, features)``
        """

    def encode(self, static: Any) -> Any:
        """
        :param static: The static part of ``batch`` observations
        :return: Their encodings, the network's :class:`Cache`
        """
        return self.precompute(self.encode_nodes(static), static)

    def encode_nodes(self, static: Any) -> th.Tensor:
        """
        :param static: The static part of ``batch`` observations
        :return: Their node embeddings alone, ``(batch, n_nodes, embed_dim)``
        """
        if not is_recorded():
            self.n_encoded_rows += len(static[0])
        return self.encoder(static)

    def forward(self, observations: TensorDict) -> th.Tensor:
        """
        :param observations: ``batch`` preprocessed observations; static keys have a row per episode where there is an
            ``episode_index``
        :return: ``(batch, features_dim)``
        """
        static = self.static_part(observations)
        dynamic = {key: value for key, value in observations.items() if key not in self.static_keys}
        index = dynamic.pop(EPISODE_INDEX, None)
        if index is None and th.is_grad_enabled() and self.share_encodings and not is_recorded():
            static, index = distinct_rows(static)
        if index is None:
            return self._decode_each(self._encode_cached(static), dynamic)
        grouping = Grouping.by_instance(index, len(static[0]))
        cache = self.encode(static)
        if grouping.source.numel() > _MAX_FILLING * len(index):
            return self._decode_each(cache.rows(index), dynamic)
        state = self.observed_state(cache, {key: grouping.gather(value) for key, value in dynamic.items()})
        return grouping.scatter(self.decode(cache, state))

    def _decode_each(self, cache: Cache, dynamic: TensorDict) -> th.Tensor:
        """:return: Features of one transition of every instance, ``(batch, features_dim)``"""
        state = self.observed_state(cache, {key: value[:, None] for key, value in dynamic.items()})
        return self.decode(cache, state)[:, 0]

    def _encode_cached(self, static: Any) -> Cache:
        if self.training or th.is_grad_enabled() or not self.use_cache or is_recorded():
            return self.encode(static)
        contents, kept = ModuleContents(self), self._kept
        if kept is None or kept.contents != contents or not have_equal_shapes(kept.static, static):
            cache = self.encode(static)
        else:
            rows, cache = changed_rows(kept.static, static), kept.cache
            if len(rows) == 0:
                return cache
            if len(rows) == len(static[0]):
                cache = self.encode(static)
            else:
                cache = cache.update_rows(rows, self.encode(select_rows(static, rows)))
        self._kept = _Kept(contents, copy_rows(static), cache)
        return cache

    def clear_cache(self) -> None:
        """Forget the kept encodings."""
        self._kept = None

    def train(self, mode: bool = True) -> EncodeOnceExtractor:
        if mode:
            self.clear_cache()
        return super().train(mode)

    def _apply(self, *args: Any, **kwargs: Any) -> EncodeOnceExtractor:
        self.clear_cache()
        return super()._apply(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": None}


class EpisodicExtractor(EncodeOnceExtractor):
    """
    The extractor of one level of our environments.

    :param observation_space: Observation space of one of our environments
    :param features_dim: Size of the features
    :param settings: What shapes the network
    """

    # Which environment it is for, and an observation key that only this one has.
    environment: ClassVar[str]
    own_key: ClassVar[str]
    static_keys: tuple[str, ...] = STATIC_KEYS

    def __init__(self, observation_space: spaces.Space, features_dim: int, settings: NetworkSettings) -> None:
        super().__init__(observation_space, features_dim, AttentionEncoder(settings))
        self.whole = settings.whole
        self.static_keys = static_keys_of(observation_space)
        if self.static_keys != STATIC_KEYS and not settings.whole:
            raise ValueError(
                f"The instances of this environment have starts, ends, distances or service costs of their own, which "
                f"{type(self).__name__} would not see; use preset='whole'."
            )

    @classmethod
    def n_actions(cls, observation_space: spaces.Space) -> int:
        """
        :param observation_space: Observation space that the extractor is to be made for
        :return: Number of actions
        :raises ValueError: If it is not that of this level's environment
        """
        remedy = (
            f"make it for a {cls.environment} environment of sb3_uav; for one of your own use MaskedAttentionPolicy, "
            "whose policy_kwargs name the keys, such as dict(node_key='nodes', mask_key='action_mask')"
        )
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError(
                f"{cls.__name__} needs the Dict observation of a sb3_uav environment, found {observation_space}; {remedy}."
            )
        missing = sorted({*cls.static_keys, cls.own_key, "action_mask"} - set(observation_space.spaces))
        if missing:
            raise ValueError(
                f"{cls.__name__} needs the observation of a {cls.environment} environment, but its keys "
                f"{sorted(observation_space.spaces)} lack {missing}; {remedy}."
            )
        return int(observation_space["action_mask"].shape[0])  # type: ignore[index]

    def static_part(self, observation: TensorDict) -> StaticObservation:
        return StaticObservation.from_observation(observation)

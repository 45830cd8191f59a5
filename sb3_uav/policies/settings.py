"""The settings that shape the networks of both levels, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from numbers import Integral
from typing import Any

_NORMALIZATIONS = ("instance", "batch", "layer", "none")


@dataclass(frozen=True)
class NetworkSettings:
    """
    What shapes a network. Both levels take all of it; each level leaves out what it has no use for.

    The defaults are those of the feature extractors in SB3's own policies: a network of the paper's size without running
    statistics, which PPO needs. The policies start from a preset instead.

    :param embed_dim: Size of the embeddings
    :param n_layers: Number of attention layers
    :param n_heads: Number of attention heads
    :param ff_dim: Hidden size of the feed-forward sublayers
    :param normalization: ``"instance"``, ``"batch"``, ``"layer"`` or ``"none"``
    :param use_values: Whether task values are features of the encoder
    :param relative: Whether the encoder sees coordinates relative to the depot in units of the maximum flight distance, with
        distances, directions and densities beside them, instead of plain ones
    :param geometry: Whether distances, slack and loads are inputs of the decoders (of the allocator's only with
        ``shared_scorer``)
    :param bias_dim: Hidden size of the layer that scores the geometry of a move (router)
    :param shared_scorer: Whether one scorer rates all UAVs, so that the network serves fleets of any size (allocator)
    :param sweep: Whether tasks are allocated in the order of :func:`~sb3_uav.envs.sweep.sweep_order` (allocator)
    :param whole: Whether the network sees the whole problem: each UAV's start, end and maximum distance, service costs, and
        values relative to those of the instance. It needs ``relative``, ``geometry`` and ``shared_scorer``
    :param mixed_precision: Whether encoders and the router's move bias compute in bfloat16 where that is safe
    """

    embed_dim: int = 128
    n_layers: int = 3
    n_heads: int = 8
    ff_dim: int = 512
    normalization: str = "instance"
    use_values: bool = True
    relative: bool = False
    geometry: bool = False
    bias_dim: int = 32
    shared_scorer: bool = False
    sweep: bool = False
    whole: bool = False
    mixed_precision: bool = False

    def __post_init__(self) -> None:
        if self.normalization not in _NORMALIZATIONS:
            raise ValueError(f"normalization is {self.normalization!r}; choose one of {_NORMALIZATIONS}.")
        for name, least in (("embed_dim", 1), ("n_layers", 0), ("n_heads", 1), ("ff_dim", 1), ("bias_dim", 1)):
            value = getattr(self, name)
            if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
                raise ValueError(f"{name} is {value!r}; give a whole number, at least {least}.")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, bool) and not isinstance(value, bool):
                raise ValueError(f"{field.name} is {value!r}; give True or False.")
        if self.embed_dim % self.n_heads != 0:
            raise ValueError(f"embed_dim {self.embed_dim} must be a multiple of n_heads {self.n_heads}.")
        lacking = [name for name in ("relative", "geometry", "shared_scorer") if self.whole and not getattr(self, name)]
        if lacking:
            raise ValueError(f"whole=True needs {' and '.join(f'{name}=True' for name in lacking)}.")

    @classmethod
    def of(cls, settings: dict[str, Any], preset: str | None = None) -> NetworkSettings:
        """
        :param settings: Some of the fields; None leaves a field to the preset
        :param preset: Name of one of :data:`_PRESETS`; the defaults of this class when None
        :return: The settings
        :raises TypeError: If there is no such setting
        :raises ValueError: If there is no such preset, or a value is not allowed
        """
        if preset is not None and preset not in _PRESETS:
            raise ValueError(f"preset is {preset!r}; choose one of {sorted(_PRESETS)}.")
        names = [field.name for field in fields(cls)]
        unknown = sorted(settings.keys() - set(names))
        if unknown:
            raise TypeError(f"unexpected keyword arguments {unknown}; the settings of a network are {names}.")
        given = {name: value for name, value in settings.items() if value is not None}
        return replace(cls() if preset is None else _PRESETS[preset], **given)


# One network for every number of tasks and UAVs and every maximum flight distance.
_DEFAULT = NetworkSettings(embed_dim=64, n_heads=4, ff_dim=256, relative=True, geometry=True, shared_scorer=True, sweep=True)
_PRESETS: dict[str, NetworkSettings] = {
    "default": _DEFAULT,
    # The same for the whole problem. Values enter relative to those of the instance.
    "whole": replace(_DEFAULT, whole=True, use_values=False),
    # Section IV-A2 of the paper.
    "paper": NetworkSettings(normalization="batch", use_values=False),
}

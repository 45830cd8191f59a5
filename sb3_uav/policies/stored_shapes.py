"""Whether the tensors of a zip have the shapes that its settings imply, found out before a network is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch as th

from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.policies.torch_state import shapes_only

if TYPE_CHECKING:
    from sb3_uav.policies.base import EpisodicPolicy

# The largest values of settings that are looked into. Memory is bounded by the tensors; these bound what is built to compare.
_MOST = {"embed_dim": 2**14, "n_layers": 2**9, "n_heads": 2**14, "ff_dim": 2**16, "bias_dim": 2**14}
_MAX_WIDTH, _MAX_DEPTH = 2**16, 16
_MAX_ACTIONS = 2**12
_MAX_DISCARDED = 2**20
_FLAGS = {field.name for field in fields(NetworkSettings) if field.type == "bool"} | {"ortho_init", "use_sde"}


def check_settings(policy_kwargs: Mapping[str, Any], n_parameters: int) -> None:
    """
    :param policy_kwargs: Arguments of a policy, of the types that JSON has
    :param n_parameters: How many parameters the zip holds
    :raises ValueError: If one is of another type, or beyond any network; the message names it
    """
    extractor_kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
    if not isinstance(extractor_kwargs, dict):
        raise ValueError(f"features_extractor_kwargs is of type {type(extractor_kwargs).__name__}, not a mapping")
    for settings in (policy_kwargs, extractor_kwargs):
        for name, most in _MOST.items():
            if settings.get(name) is not None and not _is_whole(settings[name], most):
                raise ValueError(f"{name} is {settings[name]!r:.40}, not a whole number from 0 to {most}")
        for name in _FLAGS & settings.keys():
            if not isinstance(settings[name], bool | None):
                raise ValueError(f"{name} is {settings[name]!r:.40}, not true or false")
        # A layer has several parameters, so that no more layers are built to compare than there can be.
        if (settings.get("n_layers") or 0) > n_parameters:
            raise ValueError(f"n_layers is {settings['n_layers']}, but there are only {n_parameters} parameters")
    if policy_kwargs.get("activation_fn") is not None:
        raise ValueError(f"activation_fn is {policy_kwargs['activation_fn']!r:.60}, which is not looked up here")
    net_arch = policy_kwargs.get("net_arch")
    if isinstance(net_arch, dict) and not net_arch.keys() <= {"pi", "vf"}:
        raise ValueError("net_arch has other keys than 'pi' and 'vf'")
    for widths in net_arch.values() if isinstance(net_arch, dict) else [net_arch or []]:
        if not isinstance(widths, list) or len(widths) > _MAX_DEPTH:
            raise ValueError(f"net_arch is not a list of at most {_MAX_DEPTH} layers")
        for width in widths:
            if not _is_whole(width, _MAX_WIDTH) or width == 0:
                raise ValueError(f"net_arch has a layer of {width!r:.40}, not a whole number from 1 to {_MAX_WIDTH}")


def check_shapes(
    policy_class: type[EpisodicPolicy], policy_kwargs: Mapping[str, Any], parameters: Mapping[str, th.Tensor]
) -> None:
    """
    Compare names, shapes and types with those of a policy on torch's ``meta`` device, which has no memory.

    :param policy_class: Class of the policy
    :param policy_kwargs: Its arguments, which :func:`check_settings` has found harmless
    :param parameters: The state dict
    :raises ValueError: If they do not fit; the message names the parameter
    :raises TypeError: If there is no such argument
    """
    weight = parameters.get("action_net.weight")
    if weight is not None and (weight.ndim != 2 or not 1 <= len(weight) <= _MAX_ACTIONS):
        raise ValueError(f"action_net.weight has the shape {tuple(weight.shape)}, not (1 to {_MAX_ACTIONS} actions, features)")
    spaces = policy_class.placeholder_spaces(None if weight is None else len(weight))
    with shapes_only():
        policy = policy_class(*spaces, lambda _: 0.0, **policy_kwargs)
    implied = policy.state_dict()
    if implied.keys() != parameters.keys():
        name = min(implied.keys() ^ parameters.keys())
        raise ValueError(f"parameter {name!r:.100} is {'missing' if name in implied else 'one too many'}")
    _check_discarded(policy, sum(parameter.numel() for parameter in parameters.values()))
    for name, expected in implied.items():
        found = parameters[name]
        if found.shape != expected.shape or found.dtype != expected.dtype:
            raise ValueError(
                f"parameter {name!r} is {found.dtype} of shape {tuple(found.shape)}, expected {expected.dtype} of shape "
                f"{tuple(expected.shape)}"
            )


def _check_discarded(policy: EpisodicPolicy, n_stored: int) -> None:
    """
    Where the logits are features, SB3 builds layers of ``net_arch`` that are thrown away: no parameter tells their size.

    :param policy: The policy without memory
    :param n_stored: How many numbers the zip holds
    :raises ValueError: If they are much larger than the network
    """
    net_arch: Any = policy.net_arch
    widths = [policy.features_dim, *(net_arch.get("pi", []) if isinstance(net_arch, dict) else net_arch)]
    n_built = sum(before * after for before, after in pairwise(widths))
    if n_built > _MAX_DISCARDED + n_stored:
        raise ValueError(f"net_arch would build {n_built} numbers, but the zip holds {n_stored}")


def _is_whole(value: Any, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most

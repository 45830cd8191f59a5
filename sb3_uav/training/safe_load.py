"""
SB3's ``load`` for zips of strangers: settings, counters, weights and optimizers of our policies, without unpickling.

What SB3 stores as pickles are mostly things that the zip describes in plain text beside them (spaces, schedules, classes of
buffers) or that a new training makes anew (last observations). The others need trust.
"""

from __future__ import annotations

import ast
import base64
import math
import os
import pathlib
import re
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_uav.common.imports import import_object
from sb3_uav.common.plain_pickle import Name, NotPlainError, PlainPickle
from sb3_uav.common.sb3_compat import replaced_zip_reader
from sb3_uav.common.tensor_file import MAX_TENSOR_BYTES
from sb3_uav.policies.loading import NotOurPolicyError, StoredPolicy, read_members, read_policy, read_state
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.masked_steps import MaskedDictRolloutBuffer
from sb3_uav.training.episode_buffer import EpisodeRolloutBuffer, MaskableEpisodeRolloutBuffer

_PICKLE = ":serialized:"
_STATES = ("policy.optimizer", "baseline_policy", "pytorch_variables")
_SCHEDULES = {"learning_rate", "clip_range", "clip_range_vf"}
# A new training makes them anew; ``lr_schedule`` comes from ``learning_rate``.
_MADE_ANEW = {"_last_obs", "_last_original_obs", "_last_episode_starts", "lr_schedule"}
# Objects, which a zip with plain data in their place would break.
_OBJECTS = {"env", "policy", "rollout_buffer", "logger", "device"}
_METHODS = {name for cls in (REINFORCE, PPO, MaskablePPO, A2C) for name in dir(cls) if callable(getattr(cls, name))}
_BUFFERS = (
    *(DictRolloutBuffer, MaskableDictRolloutBuffer, MaskedDictRolloutBuffer),
    *(EpisodeRolloutBuffer, MaskableEpisodeRolloutBuffer),
)
_OPTIMIZERS: dict[str, type[th.optim.Optimizer]] = {
    f"{cls.__module__}.{cls.__qualname__}": cls for cls in (th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, th.optim.SGD)
}
_OPTIMIZERS[f"{RMSpropTFLike.__module__}.{RMSpropTFLike.__qualname__}"] = RMSpropTFLike
_SPACE = re.compile(r"'(\w+)'[:,] (?:MultiBinary\(([\d, ()]+)\)|Box\((\S+), (\S+), \(([\d, ]*)\), (\w+)\)|Discrete\((\d+)\))")
_SCHEDULE = re.compile(r"(Constant|Linear|SimpleLinear)Schedule\(([\w=.+\-, ]*)\)")
_WHOLE, _NUMBER, _TEXT, _MAP = ((int,), 0), ((int, float), -(2**62)), ((str, None), 0), ((dict, None), 0)
# What attributes of SB3's algorithms and of ours may be, and the least value of whole numbers.
_TYPES: dict[str, tuple[tuple[Any, ...], int]] = {
    **dict.fromkeys(
        ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_n_updates", "_stats_window_size"), _WHOLE
    ),
    **dict.fromkeys(("n_steps", "n_envs", "n_epochs", "n_samples", "instances_per_epoch"), ((int,), 1)),
    **dict.fromkeys(("n_batches", "n_instances", "epoch", "stream_seed", "verbose"), _WHOLE),
    **dict.fromkeys(("gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", "lr_decay"), _NUMBER),
    **dict.fromkeys(("seed", "batch_size", "max_instances"), ((int, None), 0)),
    **dict.fromkeys(("_episode_num", "sde_sample_freq"), ((int,), -1)),
    "_current_progress_remaining": _NUMBER,
    "steps_ahead": ((int,), -(2**62)),
    "start_time": _NUMBER,
    "tensorboard_log": _TEXT,
    **dict.fromkeys(("baseline_kwargs", "baseline_state", "rollout_buffer_kwargs", "its_checkpoint"), _MAP),
    **dict.fromkeys(("use_sde", "normalize_advantage"), ((bool,), 0)),
    "baseline": ((str,), 0),
}
# Of what one observation holds, and of the rollout buffer that SB3 makes before it is told that it is not needed.
_MAX_OBSERVATION, _MAX_BUFFER = 2**22, 2**34


@contextmanager
def safe_zips(refusal: str | None = None) -> Iterator[None]:
    """
    Let ``load`` and ``set_parameters`` of every SB3 algorithm read zips without unpickling them.

    :param refusal: What to add to the error for a zip that cannot be read so; when None, SB3 reads it, unpickling
    """
    with replaced_zip_reader(lambda before: _reader(before, refusal)):
        yield


def _reader(before: Any, refusal: str | None) -> Any:
    def read(load_path: Any, load_data: bool = True, custom_objects: dict[str, Any] | None = None, **kwargs: Any) -> Any:
        if not isinstance(load_path, str | pathlib.Path):
            return before(load_path, load_data=load_data, custom_objects=custom_objects, **kwargs)
        try:
            data, states = read_model(load_path, custom_objects)
        except NotOurPolicyError as error:
            if refusal is None:
                return before(load_path, load_data=load_data, custom_objects=custom_objects, **kwargs)
            raise ValueError(f"{error} {refusal}") from error
        return data if load_data else None, states, {}

    return read


def read_model(
    path: str | os.PathLike[str], custom_objects: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    :param path: The zip of an algorithm with one of our policies; ``.zip`` is appended if there is no such file
    :param custom_objects: Attributes that replace those of the zip
    :return: Attributes of the algorithm, and the state dicts of the policy, its optimizer, and the baseline if there is one
    :raises FileNotFoundError: If there is no such file
    :raises NotOurPolicyError: If it holds another policy, or something that only its pickles tell
    :raises ValueError: If it is damaged, or was edited
    """
    stored = read_policy(path)
    given = dict(custom_objects or {})
    data: dict[str, Any] = {}
    for name, value in stored.attributes.items():
        if name in given:
            data[name] = given[name]
        elif name in _OBJECTS or name in _METHODS or name.startswith("__"):
            raise ValueError(f"{stored.file}: 'data' in it replaces {name!r:.60} of the algorithm; the zip was edited.")
        elif isinstance(value, dict) and _PICKLE in value:
            if name not in _MADE_ANEW:
                data[name] = _described(stored, name, value)
        else:
            data[name] = value
    data |= {"policy_class": stored.policy_class, "policy_kwargs": _policy_kwargs(stored)}
    _check_sizes(stored, data)
    return data, _states(stored)


def _described(stored: StoredPolicy, name: str, value: dict[str, Any]) -> Any:
    """
    :param stored: The policy of the zip
    :param name: An attribute that is stored as a pickle
    :param value: The pickle, and what SB3 writes beside it
    :return: The attribute, made from that text
    :raises NotOurPolicyError: If the text does not tell
    """
    found: Any = None
    if name in ("policy_class", "policy_kwargs"):
        return None
    if name == "observation_space":
        found = observation_space_of(str(value.get("spaces")))
    elif name == "action_space":
        number = re.fullmatch(r"\d{1,6}", str(value.get("n")))
        found = spaces.Discrete(int(number[0])) if number and str(value.get("start")) == "0" else None
    elif name == "rollout_buffer_class":
        methods = set(re.findall(r"<function (\w+)\.", " ".join(str(text) for text in value.values())))
        named = [cls for cls in _BUFFERS if cls.__module__ == value.get("__module__") and cls.__name__ in methods]
        found = named[0] if len(named) == 1 else None
    elif name in ("learning_rate", "clip_range", "clip_range_vf"):
        found = _schedule(value)
    elif name in ("ep_info_buffer", "ep_success_buffer"):
        return _statistics(value[_PICKLE])
    if found is None:
        raise NotOurPolicyError(
            f"{stored.file}: its {name!r:.60} is a Python object, stored as a pickle, which is not executed here."
        )
    return found


def observation_space_of(text: str) -> spaces.Dict | None:
    """
    :param text: How a ``Dict`` space prints its spaces
    :return: The space; None if it has others than ``MultiBinary``, ``Discrete`` and ``Box`` with equal bounds
    """
    found: dict[str, spaces.Space] = {}
    size = 0
    for match in _SPACE.finditer(text):
        name, binary, low, high, box, dtype, n = match.groups()
        shape = tuple(int(part) for part in re.findall(r"\d{1,9}", binary or box or ""))
        size += math.prod(shape)
        if size > _MAX_OBSERVATION or 0 in shape or (n is not None and not 1 <= int(n[:10]) < 10**9):
            return None
        if binary is not None:
            found[name] = spaces.MultiBinary(shape[0] if len(shape) == 1 else shape)
        elif n is not None:
            found[name] = spaces.Discrete(int(n))
        elif dtype in ("float32", "float64", "int8", "uint8", "int32", "int64"):
            try:
                number = float if dtype.startswith("float") else int
                found[name] = spaces.Box(number(low), number(high), shape, getattr(np, dtype))
            except (ValueError, OverflowError):
                return None
    return spaces.Dict(found) if found and len(found) == text.count("'") // 2 else None


def _schedule(value: dict[str, Any]) -> Any:
    """:return: A number or a schedule, from how SB3 or rl_zoo3 print it; None if it is another one"""
    kind = re.fullmatch(r"<class '[\w.]+\.(\w+)'>", str(value.get(":type:")))
    inner = {key: number for key, number in value.items() if not key.startswith(":")}
    text = f"{kind[1]}({', '.join(f'{key}={number}' for key, number in inner.items())})" if kind else ""
    match = _SCHEDULE.fullmatch(str(value["value_schedule"]) if "value_schedule" in value else text)
    if match is None:
        return None
    try:
        numbers = {key: float(number) for key, _, number in (part.partition("=") for part in match[2].split(", "))}
        made = {"Constant": {"val"}, "SimpleLinear": {"initial_value"}, "Linear": {"start", "end", "end_fraction"}}[match[1]]
        if numbers.keys() != made or not all(map(math.isfinite, numbers.values())):
            return None
        if match[1] == "Constant":
            return numbers["val"]
        module = "rl_zoo3.utils" if match[1] == "SimpleLinear" else "stable_baselines3.common.utils"
        return import_object(f"{module}.{match[1]}Schedule")(**numbers)
    except ValueError:
        return None


def _statistics(pickled: Any) -> deque[Any] | None:
    """:return: The last returns or successes, for the log; None if they are not plain numbers"""
    try:
        calls = {Name("collections", "deque"): lambda items=(), most=100: deque(items, min(int(most), 10**6))}
        found = PlainPickle(calls).load(base64.b64decode(str(pickled), validate=True))
    except (NotPlainError, ValueError, TypeError):
        return None
    plain = isinstance(found, deque) and all(
        isinstance(row, bool | int | float) or (isinstance(row, dict) and row.keys() <= {"r", "l", "t"}) for row in found
    )
    return found if plain else None


def _policy_kwargs(stored: StoredPolicy) -> dict[str, Any]:
    """:return: The arguments of the policy, with those for its optimizer, which is known by its name"""
    whole = stored.attributes.get("policy_kwargs", {})
    found = stored.policy_kwargs
    unknown = NotOurPolicyError(
        f"{stored.file}: the optimizer in policy_kwargs is stored as a pickle, which is not executed here."
    )
    if whole.get("optimizer_class") is not None:
        name = re.fullmatch(r"<class '([\w.]+)'>", str(whole["optimizer_class"]))
        if name is None or name[1] not in _OPTIMIZERS:
            raise unknown
        found["optimizer_class"] = _OPTIMIZERS[name[1]]
    settings = whole.get("optimizer_kwargs")
    if settings is not None:
        try:
            settings = ast.literal_eval(settings) if isinstance(settings, str) and len(settings) < 1000 else settings
        except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
            raise unknown from error
        if not isinstance(settings, dict):
            raise unknown
        found["optimizer_kwargs"] = settings
    return found


def _check_sizes(stored: StoredPolicy, data: dict[str, Any]) -> None:
    """:raises ValueError: If an attribute is of another type, or a number that decides what is allocated is immense"""
    for name, (types, least) in _TYPES.items():
        value = data.get(name)
        if name not in data or (value is None and None in types):
            continue
        if type(value) not in types or (isinstance(value, int) and not least <= value < 2**63) or value != value:
            raise ValueError(f"{stored.file}: {name} is {value!r:.40}; the zip was edited.")
        # A gradient may be of any length.
        if isinstance(value, float) and math.isinf(value) and name != "max_grad_norm":
            raise ValueError(f"{stored.file}: {name} is {value}; the zip was edited.")
    if (data.get("seed") or 0) >= 2**32:
        raise ValueError(f"{stored.file}: seed is {data['seed']}, not below 2**32; the zip was edited.")
    for name in _SCHEDULES & data.keys():
        rate = data[name]
        if not (callable(rate) or _is_rate(rate) or (rate is None and name == "clip_range_vf")):
            raise ValueError(f"{stored.file}: {name} is {rate!r:.40}, not a number; the zip was edited.")
    if data.get("rollout_buffer_kwargs"):
        raise ValueError(
            f"{stored.file}: rollout_buffer_kwargs is {data['rollout_buffer_kwargs']!r:.80}, but our buffers have no "
            "settings; the zip was edited."
        )
    for name in ("observation_space", "action_space"):
        if not isinstance(data.get(name), spaces.Space):
            raise NotOurPolicyError(f"{stored.file}: its {name} is not described in plain text; it is stored as a pickle.")
    space = data["observation_space"]
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    # REINFORCE keeps no rollouts, so that its buffer is made for one step.
    n_steps = 1 if "stream_seed" in data else data.get("n_steps") or 1
    n_bytes = 4 * sum(math.prod(part.shape or ()) for part in parts) * n_steps * (data.get("n_envs") or 1)
    if n_bytes > _MAX_BUFFER:
        raise ValueError(
            f"{stored.file}: n_steps {data.get('n_steps')} and n_envs {data.get('n_envs')} would take a rollout buffer of "
            f"{n_bytes} bytes; the zip was edited."
        )


def _states(stored: StoredPolicy) -> dict[str, Any]:
    """
    :param stored: The policy of the zip
    :return: The state dicts of the zip by name
    :raises ValueError: If those beside the policy's do not fit it
    """
    names = {f"{name}.pth": MAX_TENSOR_BYTES for name in _STATES}
    contents = read_members(stored.file, names, frozenset(names))
    found = {name.removesuffix(".pth"): read_state(stored.file, name, content) for name, content in contents.items()}
    variables = found.pop("pytorch_variables", None)
    if variables is not None and not (isinstance(variables, dict) and not variables):
        raise ValueError(f"{stored.file}: 'pytorch_variables.pth' in it is not empty, as it is for our policies.")
    baseline = found.get("baseline_policy")
    if baseline is not None and not _alike(baseline, stored.parameters):
        raise ValueError(f"{stored.file}: 'baseline_policy.pth' in it does not fit 'policy.pth'; the zip was edited.")
    if "policy.optimizer" in found and not _is_optimizer(found["policy.optimizer"], stored.parameters):
        raise ValueError(f"{stored.file}: 'policy.optimizer.pth' in it does not fit 'policy.pth'; the zip was edited.")
    return {"policy": stored.parameters, **found}


def _alike(state: Any, parameters: dict[str, th.Tensor]) -> bool:
    """Whether a state dict has the names, shapes and types of another, and finite numbers."""
    if not isinstance(state, dict) or state.keys() != parameters.keys():
        return False
    pairs = [(state[name], parameters[name]) for name in parameters]
    return all(
        isinstance(found, th.Tensor)
        and (found.shape, found.dtype) == (expected.shape, expected.dtype)
        and bool(th.isfinite(found).all())
        for found, expected in pairs
    )


def _is_optimizer(state: Any, parameters: dict[str, th.Tensor]) -> bool:
    """Whether this is the state of an optimizer of these parameters: plain settings, and tensors of the parameters' shapes."""
    if not isinstance(state, dict) or state.keys() != {"state", "param_groups"}:
        return False
    states, groups = state["state"], state["param_groups"]
    # SB3's have one group.
    if not isinstance(states, dict) or not isinstance(groups, list) or len(groups) != 1 or not _is_group(groups[0]):
        return False
    numbered = groups[0]["params"]
    if len(numbered) > len(parameters) or not all(type(key) is int and 0 <= key < len(numbered) for key in states):
        return False
    shapes = {parameter.shape for parameter in parameters.values()} | {th.Size()}
    tensors = [tensor for moments in states.values() if isinstance(moments, dict) for tensor in moments.values()]
    return (
        all(isinstance(moments, dict) for moments in states.values())
        and all(_is_moment(tensor, shapes) for tensor in tensors)
        and _are_in_order(states, parameters)
    )


def _is_group(group: Any) -> bool:
    """Whether these are the settings of an optimizer, for parameters that are numbered as torch does."""
    if not isinstance(group, dict) or not isinstance(group.get("params"), list) or "lr" not in group:
        return False
    if group["params"] != list(range(len(group["params"]))) or not all(_is_setting(number) for number in group.values()):
        return False
    lr, betas = group["lr"], group.get("betas", (0.9, 0.999))
    # The last two are for graphs of CUDA and for derivatives of steps; torch fails with them elsewhere.
    return (
        _is_rate(lr)
        and isinstance(betas, list | tuple)
        and len(betas) == 2
        and all(0 <= beta < 1 for beta in betas)
        and not group.get("capturable")
        and not group.get("differentiable")
    )


def _are_in_order(states: dict[int, dict[str, Any]], parameters: dict[str, th.Tensor]) -> bool:
    """Whether the moments of each parameter have one shape, and follow each other as the parameters do."""
    left = iter(parameters.values())
    for number in sorted(states):
        shapes = {value.shape for value in states[number].values() if isinstance(value, th.Tensor) and value.ndim}
        if len(shapes) > 1 or (shapes and not any(parameter.shape in shapes for parameter in left)):
            return False
    return True


def _is_moment(value: Any, shapes: set[Any]) -> bool:
    """Whether this is a part of an optimizer's state."""
    if isinstance(value, th.Tensor):
        return value.dtype == th.float32 and value.shape in shapes and bool(th.isfinite(value).all())
    return value is None or (isinstance(value, int) and value >= 0)


def _is_setting(value: Any) -> bool:
    """Whether this is a setting of an optimizer: a finite number, a flag, or a few of them."""
    if isinstance(value, list | tuple):
        return all(_is_number(part) for part in value)
    return value is None or _is_number(value)


def _is_rate(value: Any) -> bool:
    """Whether this can be a rate of learning or a range of clipping."""
    return _is_number(value) and not isinstance(value, bool) and value >= 0


def _is_number(value: Any) -> bool:
    """Whether this is a finite number or a flag, and no whole number that exceeds all others."""
    return (isinstance(value, int) and abs(value) < 2**63) or (isinstance(value, float) and math.isfinite(value))

"""Writes ``docs/yaml_keys.md`` from signatures and docstrings: ``python scripts/make_yaml_keys.py``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from sb3_uav.envs import (
    ClusteredGenerator,
    MixtureGenerator,
    RoutePlanningEnv,
    TaskAllocationEnv,
    UniformGenerator,
    WorldGenerator,
)
from sb3_uav.policies import EpisodicPolicy, MaskedAttentionPolicy
from sb3_uav.policies.settings import NetworkSettings
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import (
    EpisodeBufferCallback,
    FixedSetEvalCallback,
    ITSCallback,
    PretrainedRouterCallback,
    SizeGridCallback,
)
from sb3_uav.training.imitation import imitate

PAGE = Path(__file__).resolve().parents[1] / "docs" / "yaml_keys.md"
# Keys of an entry that rl-zoo3 reads; all others are arguments of the algorithm.
ZOO_KEYS = {
    "n_timesteps": "Environment steps of the training, in all environments together",
    "n_envs": "Environments that run at once",
    "policy": "Name of a policy of the algorithm, or its dotted path",
    "env_kwargs": "Arguments of the environment, see below",
    "callback": "A dotted path, one with arguments, or a list of these, see below",
    "normalize": "Not with masked policies, except `{norm_obs: false, norm_reward: true}` in SB3's loop",
    "env_wrapper": "Dotted path of a Gymnasium wrapper, or a list; not under `ITSCallback`",
    "vec_env_wrapper": "Dotted path of a `VecEnv` wrapper, or a list; not under `ITSCallback`",
    "monitor_kwargs": "Arguments of SB3's `Monitor`",
    "frame_stack": "rl-zoo3's, for images",
    "noise_type": "rl-zoo3's, for off-policy algorithms",
    "noise_std": "rl-zoo3's, for off-policy algorithms",
}
# What YAML cannot give, or what the caller passes.
LEFT_OUT = {
    "self", "env", "_init_setup_model", "observation_space", "action_space", "lr_schedule", "settings", "others", "module",
    "rng", "report", "folder", "record", "share", "tensorboard_log",
}  # fmt: skip
CALLBACKS = (ITSCallback, FixedSetEvalCallback, PretrainedRouterCallback, SizeGridCallback, EpisodeBufferCallback)
GENERATORS = (UniformGenerator, ClusteredGenerator, MixtureGenerator, WorldGenerator)


def main(page: Path = PAGE) -> None:
    """
    :param page: The file to write
    """
    page.write_text(text(), encoding="utf-8")


def keys_of(thing: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """
    :param thing: A class or a function
    :return: Its parameters that a YAML file can give
    """
    left_out = LEFT_OUT | ({"router", "allocator", "generator"} if thing is imitate else set())
    return {name: key for name, key in inspect.signature(thing).parameters.items() if name not in left_out}


def text() -> str:
    """:return: The page"""
    parts = [
        "# Every YAML key",
        "<!-- Written by `python scripts/make_yaml_keys.py`. -->",
        "An entry of a YAML file has the name of an environment, and holds keys of rl-zoo3 and arguments of the algorithm.\n"
        "Any other key is an error before anything starts. `train --conf-file` names the file; `zoo_configs/` has one for "
        "each algorithm.\nWhere the default is `-`, the key is needed. Examples: [the zoo](zoo.md), [training](training.md).",
        "## Keys of rl-zoo3",
        _table((name, None, about) for name, about in ZOO_KEYS.items()),
        "## reinforce",
        _of(REINFORCE),
        "`ppo`, `ppo_mask` and `a2c` take the arguments of SB3's and sb3-contrib's classes.",
        "Learning rates may be numbers or `lin_0.001`, which falls to 0.",
        "## Networks",
        "`policy_kwargs` of `AllocatorPolicy` and `RouterPolicy`. Without a value, a setting is that of the preset;\n"
        "the column has the default without one. [Presets](policies.md)",
        _of(NetworkSettings),
        "And these, of both policies:",
        _of(EpisodicPolicy, {"preset": "`default`, `whole` or `paper`"}),
        "## Masked attention",
        "`policy_kwargs` of [`MaskedAttentionPolicy`](foreign_environments.md), besides those of SB3's policies and\n"
        "`preset`, `embed_dim`, `n_layers`, `n_heads`, `ff_dim`, `normalization` and `mixed_precision`:",
        _of(MaskedAttentionPolicy),
        "## Environments",
        "`env_kwargs` of `TaskAllocation-...`:",
        _of(TaskAllocationEnv),
        "`env_kwargs` of `RoutePlanning-...`:",
        _of(RoutePlanningEnv),
        "Arguments of the generators, as in `generator: {sb3_uav.envs.ClusteredGenerator: {n_clusters: 3}}`:",
    ]
    for generator in GENERATORS:
        parts += [f"`sb3_uav.envs.{generator.__name__}`", _of(generator)]
    parts += ["## Callbacks", "Under `callback:`, by dotted path."]
    for callback in CALLBACKS:
        parts += [f"### {callback.__name__}", f"`sb3_uav.training.{callback.__name__}`", _of(callback)]
    parts += ["### warm_start", "Arguments of the imitation, `warm_start: {...}` of `ITSCallback`:", _of(imitate)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _of(thing: Callable[..., Any], more: dict[str, str] | None = None) -> str:
    """
    :param thing: A class or a function
    :param more: Descriptions that its docstrings lack
    :return: The table of its keys
    """
    about = {**(more or {})}
    for owner in reversed(inspect.getmro(thing) if isinstance(thing, type) else (thing,)):
        about.update(_descriptions(inspect.getdoc(owner) if owner is not object else ""))
        if "__init__" in vars(owner):
            about.update(_descriptions(vars(owner)["__init__"].__doc__))
    missing = sorted(name for name in keys_of(thing) if name not in about)
    if missing:
        raise ValueError(f"{thing.__name__}: the docstring describes no {missing}; add `:param ...:`.")
    return _table((name, key.default, about[name]) for name, key in keys_of(thing).items())


def _descriptions(docstring: str | None) -> dict[str, str]:
    """:return: What a docstring says about each parameter, as Markdown in one line"""
    found = re.findall(r":param (\w+):\s*(.*?)(?=\n\s*:\w+|\Z)", docstring or "", flags=re.DOTALL)
    return {name: _markdown(" ".join(about.split())) for name, about in found}


def _markdown(line: str) -> str:
    line = re.sub(r":\w+:`~?(?:[^`<]*\.)?([^`.<]+)`", r"`\1`", line)
    return line.replace("``", "`").replace("|", "\\|")


def _table(rows: Iterable[tuple[str, Any, str]]) -> str:
    """
    :param rows: Key, default and description; ``None`` in place of a default is YAML's null
    :return: A table; "" without rows
    """
    lines = [f"| `{name}` | {_default(default)} | {about} |" for name, default, about in rows]
    return "\n".join(["| key | default | meaning |", "| --- | --- | --- |", *lines]) if lines else ""


def _default(value: Any) -> str:
    if value is inspect.Parameter.empty:
        return "-"
    if value is None:
        return ""
    if isinstance(value, type):
        return f"`{value.__module__}.{value.__name__}`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{[list(part) if isinstance(part, tuple) else part for part in value]}`"
    return f"`{value}`"


if __name__ == "__main__":
    main()

"""The variants of a comparison: entries of our YAMLs with changes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

from sb3_uav.zoo.configs import default_config, plain_numbers, read_yaml
from sb3_uav.zoo.entries import find_entry, scaled_values

# Samples per instance of the variant with the shared baseline, if the YAML uses another one.
_SHARED_SAMPLES = 8
# The paper tests on 10,000 instances after each epoch, which would take longer than small epochs themselves.
_ROLLOUT_TEST_INSTANCES = 1_000


class Variant(NamedTuple):
    """
    One of the compared trainings.

    :param name: Name in tables and figures
    :param algo: rl_zoo3's name of the algorithm
    :param entry: The complete YAML entry of the environment, callbacks included
    """

    name: str
    algo: str
    entry: dict[str, Any]

    @property
    def folder(self) -> str:
        """The name as part of a path."""
        return re.sub(r"[^A-Za-z0-9]+", "-", self.name).strip("-").lower()


def _read_entry(algo: str, env_id: str, conf_file: str | None = None) -> dict[str, Any]:
    """
    :param algo: rl_zoo3's name of an algorithm
    :param env_id: Id of an environment
    :param conf_file: The YAML to read; ours for the algorithm when None
    :return: The entry of the environment
    :raises ValueError: If there is none
    """
    path = default_config(algo) if conf_file is None else Path(conf_file)
    if path is None or not path.is_file():
        raise ValueError(f"algo {algo!r}: there is no YAML {path or f'zoo_configs/{algo}.yml'}; name one as conf_file.")
    entries = read_yaml(path)
    name = find_entry(entries, env_id)
    if name is None or not isinstance(entries.get(name), dict):
        raise ValueError(f"{path}: has no entry for {env_id}; add one, or compare on another environment.")
    entry: dict[str, Any] = plain_numbers(entries[name])
    return {**entry, **scaled_values(entry, name, env_id)}


def _default_variants(env_id: str) -> dict[str, dict[str, Any]]:
    """
    :param env_id: Id of an environment
    :return: PPO, MaskablePPO, and REINFORCE with two baselines, the latter with equally many episodes per update and per epoch
    """
    entry = _read_entry("reinforce", env_id)
    n_samples = entry.get("n_samples", 1)
    episodes = entry["n_envs"] * n_samples
    if entry.get("baseline") != "shared":
        n_samples = _SHARED_SAMPLES
    shared = dict(algo="reinforce", baseline="shared", n_samples=n_samples, n_envs=max(episodes // n_samples, 1))
    rollout = dict(algo="reinforce", baseline="rollout", n_samples=1, n_envs=episodes)
    if "instances_per_epoch" in entry:
        epoch = entry["instances_per_epoch"] * entry.get("n_samples", 1)
        shared["instances_per_epoch"], rollout["instances_per_epoch"] = max(epoch // n_samples, 1), epoch
    baseline = entry["baseline_kwargs"] if entry.get("baseline") == "rollout" and "baseline_kwargs" in entry else {}
    rollout["baseline_kwargs"] = {"n_test_instances": _ROLLOUT_TEST_INSTANCES, **baseline}
    shared["baseline_kwargs"] = None
    return {
        "PPO": dict(algo="ppo"),
        "MaskablePPO": dict(algo="ppo_mask"),
        "REINFORCE, shared baseline": shared,
        "REINFORCE, rollout baseline": rollout,
    }


def read_variants(path: Path | None, env_id: str) -> list[Variant]:
    """
    :param path: A YAML of variants; the default ones when None
    :param env_id: Id of the environment
    :return: The variants with their complete YAML entries
    :raises ValueError: If something is missing or not allowed; the message names it
    """
    given = _default_variants(env_id) if path is None else read_yaml(path)
    if not given or not all(isinstance(changes, dict) and isinstance(changes.get("algo"), str) for changes in given.values()):
        raise ValueError(f"--variants {path}: must be a mapping from names to mappings with at least the key 'algo'.")
    variants = []
    for name, changes in given.items():
        changes = plain_numbers(changes)
        algo = changes.pop("algo")
        entry = {**_read_entry(algo, env_id, changes.pop("conf_file", None)), **changes}
        variants.append(Variant(str(name), algo, {key: value for key, value in entry.items() if value is not None}))
    folders = [variant.folder for variant in variants]
    if len(set(folders)) < len(folders) or "" in folders:
        raise ValueError(f"--variants {path}: names must differ in their letters and digits, found {list(given)}.")
    return variants


def callback_name(callback: Any) -> str:
    """
    :param callback: An item of the ``callback`` key of a YAML entry
    :return: The class that it names, without its module
    """
    return str(next(iter(callback)) if isinstance(callback, dict) else callback).rpartition(".")[2]


def callbacks_of(entry: dict[str, Any]) -> list[Any]:
    """
    :param entry: A YAML entry
    :return: Its callbacks; the key may hold one or several
    """
    given = entry.get("callback") or []
    return given if isinstance(given, list) else [given]


def router_settings(env_id: str) -> dict[str, Any]:
    """
    :param env_id: Id of an allocation environment
    :return: Settings of the router in our REINFORCE entry; empty if the entry trains no router
    """
    for callback in callbacks_of(_read_entry("reinforce", env_id)):
        if callback_name(callback) == "ITSCallback" and isinstance(callback, dict):
            return dict(next(iter(callback.values()))["router"])
    return {}

"""The YAML files that rl_zoo3 leaves in a run folder, read without creating any object that they name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from sb3_uav.zoo.yaml_text import load_yaml


class _PlainLoader(yaml.SafeLoader):
    """Also reads ordered dictionaries and tuples, which rl_zoo3 writes with tags of Python."""


def _ordered_dict(loader: _PlainLoader, node: yaml.Node) -> dict[Any, Any]:
    # collections.OrderedDict applied to a list of one list of pairs.
    assert isinstance(node, yaml.SequenceNode)
    (pairs,) = loader.construct_sequence(node, deep=True) or [[]]
    return dict(pairs)


def _list(loader: _PlainLoader, node: yaml.Node) -> list[Any]:
    assert isinstance(node, yaml.SequenceNode)
    return loader.construct_sequence(node, deep=True)


_PlainLoader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered_dict)
_PlainLoader.add_constructor("tag:yaml.org,2002:python/tuple", _list)


def read_saved(path: Path) -> dict[str, Any]:
    """
    :param path: ``config.yml`` or ``args.yml`` of a run
    :return: Its content
    :raises ValueError: If it cannot be read, or names an object of Python; the message names the file
    """
    found = load_yaml(path, _PlainLoader)
    if not isinstance(found, dict):
        raise ValueError(f"{path}: holds no mapping; it was not written by rl_zoo3.")
    return found


def saved_env_kwargs(run_folder: Path, env_name: str) -> dict[str, Any]:
    """
    :param run_folder: Folder of a run
    :param env_name: rl_zoo3's name of its environment
    :return: The arguments that its training environment was made with, besides those of its id
    :raises ValueError: If a file cannot be read
    """
    config, arguments = run_folder / env_name / "config.yml", run_folder / env_name / "args.yml"
    of_yaml = read_saved(config).get("env_kwargs") if config.is_file() else None
    of_command = read_saved(arguments).get("env_kwargs") if arguments.is_file() else None
    # Those of the command line replace the others, as in the training.
    return of_command or of_yaml or {}


def saved_callbacks(run_folder: Path, env_name: str) -> Any:
    """
    :param run_folder: Folder of a run
    :param env_name: rl_zoo3's name of its environment
    :return: The ``callback`` of its YAML entry
    :raises ValueError: If the file cannot be read
    """
    config = run_folder / env_name / "config.yml"
    return read_saved(config).get("callback") if config.is_file() else None

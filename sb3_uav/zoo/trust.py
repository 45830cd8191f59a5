"""What is replayed or continued is read without unpickling, unless the user trusts whoever wrote it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from sb3_uav.common.files import write_atomically
from sb3_uav.common.json_text import read_json_file

_NOTE = "downloaded_from_hub.json"
TRUST_FLAG = ("--trust", "unpickle the agent, which runs any code in it, where it cannot be read otherwise")
# The variable of huggingface_sb3: https://github.com/huggingface/huggingface_sb3/blob/v3.0/huggingface_sb3/load_from_hub.py
_VARIABLE = "TRUST_REMOTE_CODE"
_REMEDY = (
    "Add --trust if you trust whoever made it: that unpickles the files, as SB3 and rl_zoo3 do, and runs any code in them."
)
_PICKLES = ("vecnormalize.pkl", "obs_rms.pkl")
# Names of functions and classes in the settings of environments. Files are no code.
_DOTTED = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+")
_FILES = (".npz", ".csv", ".json", ".yml", ".yaml")
_OWN_ROOM = "sb3_uav.distributions."
_WRAPPERS = ("env_wrapper", "vec_env_wrapper")


def note_download(run_folder: Path, repo_id: str) -> None:
    """
    :param run_folder: Folder of an agent that somebody else may have trained
    :param repo_id: Where it comes from
    :raises OSError: If the note cannot be written
    """
    write_atomically(run_folder / _NOTE, json.dumps({"repo_id": repo_id}))


def is_trusted(trust: bool) -> bool:
    """
    :param trust: Whether the user said ``--trust``
    :return: Whether the files may be unpickled
    """
    return trust or os.environ.get(_VARIABLE, "").lower() in {"1", "true", "yes", "on"}


def reading(trust: bool, run_folder: Path) -> AbstractContextManager[None]:
    """
    :param trust: Whether the user said ``--trust``
    :param run_folder: Folder of the zips
    :return: How SB3's ``load`` reads zips in a ``with`` block: with trust as ever, without trust never unpickling
    """
    from sb3_uav.training.safe_load import safe_zips

    return nullcontext() if is_trusted(trust) else safe_zips(_remedy(run_folder))


def require_plain_run(run_folder: Path, env_name: str, trust: bool, packages: Collection[str] = ()) -> None:
    """
    Look at what rl_zoo3 reads in the folder of a run beside the zips, with loaders that run any code they are told to.

    :param run_folder: Folder of an agent
    :param env_name: rl_zoo3's name of its environment
    :param trust: Whether the user said ``--trust``
    :param packages: Packages that the user has named, whose functions the settings may name
    :raises ValueError: If there is more than plain data, and the user has not said that he trusts whoever made it
    """
    if is_trusted(trust):
        return
    from sb3_uav.zoo.saved import read_saved

    settings = run_folder / env_name
    _require_no_pickles(settings, _PICKLES, run_folder)
    for path in (settings / "config.yml", settings / "args.yml"):
        if not path.is_file():
            continue
        try:
            found = read_saved(path)
        except ValueError as error:
            raise ValueError(f"{error} {_remedy(run_folder)}") from error
        for name in _WRAPPERS:
            if path.name == "config.yml" and found.get(name):
                raise ValueError(f"{path}: {name} names code, {found[name]!r:.100}. {_remedy(run_folder)}")
        # rl_zoo3 executes the text.
        if path.name == "config.yml" and isinstance(found.get("normalize"), str):
            raise ValueError(f"{path}: normalize is code, {found['normalize']!r:.100}. {_remedy(run_folder)}")
        for text in _texts(found.get("env_kwargs")):
            if _names_code(text, packages):
                name = text.strip().partition(".")[0]
                raise ValueError(
                    f"{path}: env_kwargs names code, {text!r:.100}. {_remedy(run_folder)} For code of your own, "
                    f"--gym-packages {name:.60} is enough."
                )


def require_plain_neighbors(zip_file: Path, env_name: str, trust: bool) -> None:
    """
    :param zip_file: The zip of an agent that a training continues
    :param env_name: rl_zoo3's name of the environment
    :param trust: Whether the user said ``--trust``
    :raises ValueError: If there are pickles beside it that rl_zoo3 would read, and the user has not said that he trusts them
    """
    if not is_trusted(trust):
        _require_no_pickles(zip_file.parent / env_name, _PICKLES, zip_file.parent)
        _require_no_pickles(zip_file.parent, ("replay_buffer.pkl",), zip_file.parent)


def _require_no_pickles(folder: Path, names: Collection[str], run_folder: Path) -> None:
    for name in names:
        if (folder / name).exists():
            raise ValueError(f"{folder / name} is a pickle. {_remedy(run_folder)}")


def _remedy(run_folder: Path) -> str:
    """What to do, and where the run comes from if that is known."""
    try:
        origin = read_json_file(run_folder / _NOTE)["repo_id"]
    except (OSError, ValueError, LookupError, TypeError):
        return _REMEDY
    return f"{run_folder} comes from {origin!s:.100} on the Hugging Face Hub. {_REMEDY}"


def _texts(value: Any) -> Iterator[str]:
    """All texts in the settings of an environment, keys included."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for part in (*value.keys(), *value.values()):
            yield from _texts(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _texts(part)


def _names_code(text: str, packages: Collection[str]) -> bool:
    """Whether an environment would import something by this text that the user has not named."""
    if _DOTTED.fullmatch(text.strip()) is None or text.endswith(_FILES) or text.startswith(_OWN_ROOM):
        return False
    return text.partition(".")[0] not in {package.partition(".")[0] for package in packages}

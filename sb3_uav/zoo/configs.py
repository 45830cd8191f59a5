"""The zoo's YAML files: finding, reading and checking them."""

from __future__ import annotations

import difflib
import inspect
import re
import reprlib
from pathlib import Path
from typing import Any

from stable_baselines3.common.type_aliases import Schedule

import sb3_uav
from sb3_uav.common.sb3_compat import linear_schedule
from sb3_uav.zoo.entries import find_entry
from sb3_uav.zoo.rl_zoo3_compat import stock_config
from sb3_uav.zoo.yaml_text import load_yaml

# Keys that rl_zoo3 removes from a YAML entry before passing the rest to the algorithm (rl_zoo3/exp_manager.py).
_ZOO_KEYS = {
    "n_envs",
    "n_timesteps",
    "normalize",
    "env_wrapper",
    "vec_env_wrapper",
    "callback",
    "env_kwargs",
    "monitor_kwargs",
    "frame_stack",
    "noise_type",
    "noise_std",
}


def read_yaml(path: Path) -> dict[Any, Any]:
    """
    :param path: A YAML file
    :return: The mapping in it
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If it cannot be read, or holds no mapping; the message names the file
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    found = load_yaml(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path}: holds {_kind(found)} instead of a mapping; write `name: settings`.")
    return found


def _kind(value: Any) -> str:
    # Not by repr alone, which raises an error for whole numbers of thousands of digits.
    return "nothing" if value is None else f"{reprlib.repr(value):.40} ({type(value).__name__})"


def default_config(algo: str, env_id: str | None = None) -> Path | None:
    """
    :param algo: Name of an algorithm
    :param env_id: Id of an environment
    :return: Our YAML for it, from the installed package or from the source checkout; None if we ship none, or if rl_zoo3 has
        one and ours has no entry for this environment
    """
    package = Path(sb3_uav.__file__).parent
    candidates = (folder / "zoo_configs" / f"{algo}.yml" for folder in (package, package.parent))
    ours = next((path for path in candidates if path.is_file()), None)
    if (
        ours is not None
        and env_id is not None
        and stock_config(algo).is_file()
        and find_entry(read_yaml(ours), env_id) is None
    ):
        return None
    return ours


def plain_numbers(value: Any) -> Any:
    """
    :param value: A value of a YAML file
    :return: The value with numbers in place of strings such as ``1e-3``, which YAML 1.1 reads as strings
    """
    if isinstance(value, dict):
        return {key: plain_numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain_numbers(item) for item in value]
    if isinstance(value, str) and re.fullmatch(r"[+-]?\d+(\.\d*)?[eE][+-]?\d+", value):
        number = float(value)
        return int(number) if number.is_integer() else number
    return value


def check_keys(found: set[str], algorithm: type, where: str) -> None:
    """
    :param found: Keys of a YAML entry
    :param algorithm: The class that receives the keys that rl_zoo3 does not use
    :param where: File and entry, named in the error
    :raises ValueError: If neither uses a key
    """
    known = _ZOO_KEYS | set(inspect.signature(algorithm).parameters) - {"_init_setup_model", "env"}
    for key in sorted(found - known, key=str):
        nearest = difflib.get_close_matches(str(key), known, n=1)
        advice = f"did you mean {nearest[0]!r}?" if nearest else f"known keys: {', '.join(sorted(known))}."
        raise ValueError(f"{where}: unknown key {key!r}; {advice}")


def check_values(entry: dict[str, Any], where: str) -> None:
    """
    Check values that would make rl_zoo3 fail without naming the key.

    :param entry: A YAML entry
    :param where: File and entry, named in the error
    :raises ValueError: If a value is of the wrong kind
    """
    for key in ("n_envs", "n_timesteps"):
        value = entry.get(key, 1)
        whole = isinstance(value, int | float) and not isinstance(value, bool) and float(value).is_integer()
        if not whole or value < 1:
            raise ValueError(f"{where}: {key} is {_kind(value)}; write a whole number, at least 1.")
    if not isinstance(entry.get("policy"), str):
        raise ValueError(f"{where}: policy is {_kind(entry.get('policy'))}; write the name of a policy.")
    for key in ("policy_kwargs", "env_kwargs", "monitor_kwargs"):
        value = entry.get(key)
        # rl_zoo3 evaluates strings such as "dict(net_arch=[64])".
        if not (value is None or isinstance(value, dict) or (isinstance(value, str) and re.match(r"\s*(dict\(|\{)", value))):
            raise ValueError(f"{where}: {key} is {_kind(value)}; write a mapping.")
    callbacks = entry.get("callback") or []
    for callback in callbacks if isinstance(callbacks, list) else [callbacks]:
        if not isinstance(callback, str) and not (isinstance(callback, dict) and len(callback) == 1):
            raise ValueError(f"{where}: callback holds {_kind(callback)}; write a dotted name, or one with its arguments.")
        for arguments in callback.values() if isinstance(callback, dict) else ():
            if not isinstance(arguments, dict):
                raise ValueError(f"{where}: the arguments of a callback are {_kind(arguments)}; write a mapping.")


def parse_schedule(key: str, text: str) -> float | Schedule:
    """
    :param key: Name of the hyperparameter
    :param text: ``lin_X``, ``const_X`` or a number
    :return: A linear decay from X to 0, or a number
    :raises ValueError: If it is neither, or a schedule where SB3 takes none
    """
    kind, _, number = text.rpartition("_")
    try:
        value = float(number)
    except ValueError:
        raise ValueError(f"{key} is {text!r}; write a number, lin_X or const_X.") from None
    if kind in ("", "const"):
        return value
    if kind != "lin" or key == "ent_coef":
        raise ValueError(f"{key} is {text!r}; write a number{'' if key == 'ent_coef' else ', lin_X or const_X'}.")
    return linear_schedule(value)

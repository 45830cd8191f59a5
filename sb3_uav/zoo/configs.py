"""The zoo's YAML files: where they are, and what may stand in an entry."""

from __future__ import annotations

import difflib
import inspect
import re
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.utils import LinearSchedule

import sb3_uav
from sb3_uav.zoo.rl_zoo3_compat import stock_config

# What rl_zoo3 takes out of a YAML entry before the rest goes to the algorithm (rl_zoo3/exp_manager.py).
ZOO_KEYS = {
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


def default_config(algo: str, env_id: str | None = None) -> Path | None:
    """
    :param algo: Name of an algorithm
    :param env_id: What to train on
    :return: Our YAML for it, from the installed package or from the source checkout; None if we ship none, or if rl_zoo3 has
        one and ours does not know this environment
    """
    package = Path(sb3_uav.__file__).parent
    candidates = (folder / "zoo_configs" / f"{algo}.yml" for folder in (package, package.parent))
    ours = next((path for path in candidates if path.is_file()), None)
    if (
        ours is not None
        and env_id is not None
        and stock_config(algo).is_file()
        and env_id not in yaml.safe_load(ours.read_text())
    ):
        return None
    return ours


def plain_numbers(value: Any) -> Any:
    """
    :param value: From a YAML file
    :return: The same with numbers for texts such as ``1e-3``, which YAML 1.1 does not take for numbers
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
    :param algorithm: The class that gets what rl_zoo3 does not take
    :param where: File and entry, named in the error
    :raises ValueError: On a key that neither knows
    """
    known = ZOO_KEYS | set(inspect.signature(algorithm).parameters) - {"_init_setup_model", "env"}
    for key in sorted(found - known):
        nearest = difflib.get_close_matches(key, known, n=1)
        advice = f"did you mean {nearest[0]!r}?" if nearest else f"known keys: {', '.join(sorted(known))}."
        raise ValueError(f"{where}: unknown key {key!r}; {advice}")


def parse_schedule(key: str, text: str) -> float | LinearSchedule:
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
    return LinearSchedule(start=value, end=0.0, end_fraction=1.0)

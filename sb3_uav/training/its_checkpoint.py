"""The checkpoint of both levels: two zips, and a state file that names them and is replaced last."""

from __future__ import annotations

import errno
import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_uav.common.divergence import note_saved, require_finite_model
from sb3_uav.common.epoch_log import EpochRecord
from sb3_uav.common.files import file_hash, remove_leftovers, write_atomically
from sb3_uav.common.json_text import read_plain_json
from sb3_uav.common.saving import save_atomically
from sb3_uav.common.sb3_compat import n_updates
from sb3_uav.envs.generators import InstanceGenerator
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training.kept_checkpoints import STATE_FILE, earlier_states, keep_previous, remove_old

CHECKPOINT_FOLDER = "its_checkpoint"
# A record of an epoch takes 250 bytes and 16 values.
MAX_STATE_BYTES, MAX_STATE_VALUES = 32 * 2**20, 2_000_000
WARM_START_FOLDER = "warm_start"
# An attribute of the allocator, so that every zip of it names its last checkpoint: stock rl_zoo3 does not tell callbacks
# which zip a run continues.
CHECKPOINT = "its_checkpoint"


def write_checkpoint(
    folder: Path,
    allocator: BaseAlgorithm,
    router: BaseAlgorithm,
    epoch: int,
    records: Sequence[EpochRecord],
    warm_started: bool,
    share: float,
    origin: str | None,
    keep: int = 1,
) -> None:
    """
    Write both zips and the state of the strategy.

    The state names the zips it belongs to and is replaced last, so the folder is consistent at any moment.

    :param folder: Where to write them
    :param allocator: The allocator's algorithm
    :param router: The router's
    :param epoch: Finished epochs of the allocator
    :param records: The epochs of both levels so far
    :param warm_started: Whether the router's warm start, if there is one, is over
    :param share: The part of the planned steps to which warm start and pre-training were cut
    :param origin: What the run started from, see :func:`origin_of`
    :param keep: Number of checkpoints to keep, this one included
    :raises DivergenceError: If a number in either model is not finite; the earlier checkpoint is then untouched
    :raises OSError: If a file cannot be written, or the folder has vanished since the last checkpoint
    """
    _require_folder(folder, allocator)
    remove_leftovers(folder)
    for model in (allocator, router):
        require_finite_model(model, folder)
    # The allocator may have finished more epochs than the strategy has, because one batch can hold several.
    n_instances = getattr(allocator, "n_instances", None)
    noted = {"folder": str(folder.resolve()), "epoch": epoch, "n_instances": n_instances, "origin": origin}
    setattr(allocator, CHECKPOINT, noted)
    # Another name before the warm start, because a zip that the state file names must not change.
    number = str(n_router_epochs(records)) if warm_started else "start"
    names = {"allocator": f"allocator_{epoch}.zip", "router": f"router_{number}.zip"}
    save_atomically(allocator, folder / names["allocator"])
    save_atomically(router, folder / names["router"])
    state = {"epoch": epoch, **names, "warm_started": warm_started, "share": share}
    state["records"] = [asdict(record) for record in records]
    keep_previous(folder, names)
    write_atomically(folder / STATE_FILE, json.dumps(state, indent=1))
    for model in (allocator, router):
        note_saved(model, folder / names["allocator"], is_checkpoint=True)
    remove_old(folder, keep)


def _require_folder(folder: Path, allocator: BaseAlgorithm) -> None:
    """:raises FileNotFoundError: If the allocator has a checkpoint in this folder, which has vanished"""
    noted = getattr(allocator, CHECKPOINT, None)
    if isinstance(noted, dict) and noted.get("folder") == str(folder.resolve()) and not folder.is_dir():
        message = "the folder of the checkpoints has vanished during the training, which stops; start it again"
        raise FileNotFoundError(errno.ENOENT, message, str(folder))


def n_router_epochs(records: Sequence[EpochRecord]) -> int:
    """
    :param records: Epochs of both levels
    :return: How many of them are the router's
    """
    return sum(record.level == "router" for record in records)


def origin_of(router: Path | None, generator: InstanceGenerator) -> str | None:
    """
    :param router: Zip of the router that a run is given to start from
    :param generator: Draws the instances of the fleet
    :return: What tells the run from one with another router or of another size; None without such a router
    """
    return None if router is None else f"{file_hash(router)} {generator.n_uavs} {generator.n_tasks}"


def noted_checkpoint(allocator: BaseAlgorithm, origin: str | None) -> Path | None:
    """
    :param allocator: An allocator that was loaded from a zip
    :param origin: What the run is given to start from; None if it has no router yet
    :return: The checkpoint that it belongs to, if it is still where it was written, and of a run with the same origin if there
        is one: with the router of another run, a new one starts
    """
    noted = getattr(allocator, CHECKPOINT, None)
    if not isinstance(noted, dict) or not (Path(str(noted.get("folder"))) / STATE_FILE).is_file():
        return None
    if origin is not None and noted.get("origin") != origin:
        return None
    return Path(noted["folder"])


def begin_anew(allocator: BaseAlgorithm, router: Path | None) -> None:
    """
    Let an allocator forget how far an earlier run has come. Weights, optimizer and random streams go on.

    :param allocator: The allocator's algorithm
    :param router: Zip of the router that the new run starts from
    :raises ValueError: If the allocator was trained before, and there is no such router
    """
    if n_updates(allocator) > 0:
        if router is None:
            raise ValueError(
                "The allocator has been trained before, but ITSCallback cannot find its router: set resume_from to the "
                f"{CHECKPOINT_FOLDER} folder of the earlier run, or router to the zip of a router, to start a new run with "
                "both."
            )
        warnings.warn(
            f"The allocator has been trained before: a new run starts at epoch 0 with it and the router {router}. To go on "
            f"with an earlier run of ITSCallback, set resume_from to its {CHECKPOINT_FOLDER} folder.",
            stacklevel=4,
        )
    vars(allocator).pop(CHECKPOINT, None)
    if isinstance(allocator, REINFORCE):
        if allocator.max_instances is not None:
            allocator.max_instances -= allocator.n_instances
        allocator.n_instances = allocator.epoch = 0


def read_state(folder: Path, file: str | None = None) -> dict[str, Any]:
    """
    :param folder: A checkpoint of :class:`~sb3_uav.training.ITSCallback`
    :param file: Name of the state file of an earlier checkpoint there; the last one when None
    :return: The contents of its state file: ``epoch``, ``allocator`` and ``router`` (names of the zips), ``records``, and,
        unless an older version wrote it, ``warm_started`` and ``share``
    :raises FileNotFoundError: If there is none
    :raises ValueError: If it is damaged
    """
    path = Path(folder) / (STATE_FILE if file is None else file)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the {CHECKPOINT_FOLDER} folder of an earlier run.")
    try:
        size = path.stat().st_size
        if size > MAX_STATE_BYTES:
            raise ValueError(f"it has {size} bytes, more than the {MAX_STATE_BYTES} that are read")
        state = read_plain_json(path.read_bytes(), MAX_STATE_VALUES)
    except ValueError as error:
        raise _damaged(path, str(error)) from error
    if not isinstance(state, dict):
        raise _damaged(path, f"it holds {state!r:.40} in place of a mapping")
    missing = {"epoch", "allocator", "router", "records"} - state.keys()
    if missing:
        raise ValueError(f"{path}: fields {sorted(missing)} are missing; resume from another checkpoint.")
    if not _is_count(state["epoch"]):
        raise _damaged(path, f"epoch is {state['epoch']!r:.40}")
    for level in ("allocator", "router"):
        if not (isinstance(state[level], str) and re.fullmatch(r"[\w.-]+\.zip", state[level])):
            raise _damaged(path, f"{level} is {state[level]!r:.40}, not the name of a zip")
        if (path.parent / state[level]).resolve().parent != path.parent.resolve():
            raise _damaged(path, f"{level} is {state[level]!r:.40}, a link that leads out of the folder")
    if not isinstance(state.get("warm_started", True), bool):
        raise _damaged(path, f"warm_started is {state['warm_started']!r:.40}")
    share = state.get("share", 1.0)
    if not isinstance(share, int | float) or isinstance(share, bool) or not 0 < share <= 1:
        raise _damaged(path, f"share is {share!r:.40}")
    if not isinstance(state["records"], list):
        raise _damaged(path, f"records is {state['records']!r:.40}")
    for number, record in enumerate(state["records"]):
        if not _is_record(record):
            raise _damaged(path, f"record {number} is {record!r:.200}")
    return state


def _damaged(path: Path, what: str) -> ValueError:
    return ValueError(f"{path}: not an intact state file ({what}); resume from another checkpoint.")


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_record(record: Any) -> bool:
    """Whether this is what :class:`EpochRecord` was written as."""
    if not isinstance(record, dict):
        return False
    try:
        made = EpochRecord(**record)
    except TypeError:
        return False
    texts, counts = (made.level, made.phase), (made.epoch, made.n_instances)
    numbers = (made.objective, made.seconds, made.generation_seconds, made.cpu_seconds)
    return (
        all(isinstance(text, str) for text in texts)
        and all(_is_count(count) for count in counts)
        and all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers)
    )


def check_allocator(folder: Path, state: dict[str, Any], allocator: BaseAlgorithm) -> None:
    """
    :param folder: A checkpoint
    :param state: Its state
    :param allocator: What is going to learn
    :raises ValueError: If it is not the allocator of this checkpoint
    """
    epoch = _epoch_of(allocator, state["epoch"])
    if epoch != state["epoch"]:
        raise ValueError(
            f"{folder}: the checkpoint is of epoch {state['epoch']}, the allocator of epoch {epoch}; "
            f"train the allocator of {folder / state['allocator']}."
        )


def _epoch_of(allocator: BaseAlgorithm, otherwise: int) -> Any:
    """:return: The epoch of the checkpoint that the allocator belongs to"""
    noted = getattr(allocator, CHECKPOINT, None)
    noted = noted if isinstance(noted, dict) else {}
    if isinstance(allocator, REINFORCE) and noted.get("n_instances") != allocator.n_instances:
        # Not the zip of the checkpoint itself: it must not have completed another epoch since.
        return allocator.epoch
    return noted.get("epoch", otherwise)


def find_state(folder: Path, allocator: BaseAlgorithm) -> dict[str, Any]:
    """
    :param folder: A checkpoint
    :param allocator: What is going to learn
    :return: The state of the last checkpoint there, or that of the kept one that the allocator belongs to
    :raises FileNotFoundError: If there is none
    :raises ValueError: If a state file is damaged, or the allocator belongs to none of them
    """
    remove_leftovers(folder)
    state = read_state(folder)
    epoch = _epoch_of(allocator, state["epoch"])
    # A new allocator is at epoch 0, but belongs to no checkpoint.
    if epoch != state["epoch"] and isinstance(getattr(allocator, CHECKPOINT, None), dict):
        earlier = (read_state(folder, file.name) for file in earlier_states(folder))
        state = next((other for other in earlier if other["epoch"] == epoch), state)
    check_allocator(folder, state, allocator)
    note_saved(allocator, folder / state["allocator"], is_checkpoint=True)
    return state


def router_of(folder: Path, allocator: str) -> str:
    """
    :param folder: A checkpoint
    :param allocator: Name of an allocator's zip there
    :return: Name of the router's zip of the same checkpoint, the last one for other allocators
    :raises FileNotFoundError: If there is no checkpoint
    :raises ValueError: If a state file is damaged
    """
    states = [read_state(folder), *(read_state(folder, file.name) for file in earlier_states(folder))]
    return next((state["router"] for state in states if state["allocator"] == allocator), states[0]["router"])

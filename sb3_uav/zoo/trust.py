"""Agents from the Hugging Face Hub, which are not unpickled unless the user trusts them."""

from __future__ import annotations

import json
import os
from pathlib import Path

from sb3_uav.common.files import write_atomically

_NOTE = "downloaded_from_hub.json"
# The variable of huggingface_sb3: https://github.com/huggingface/huggingface_sb3/blob/v3.0/huggingface_sb3/load_from_hub.py
TRUST_FLAG = ("--trust", "unpickle an agent that load-from-hub downloaded")
_VARIABLE = "TRUST_REMOTE_CODE"


def note_download(run_folder: Path, repo_id: str) -> None:
    """
    :param run_folder: Folder of an agent that somebody else may have trained
    :param repo_id: Where it comes from
    :raises OSError: If the note cannot be written
    """
    write_atomically(run_folder / _NOTE, json.dumps({"repo_id": repo_id}))


def require_trust(run_folder: Path, trust: bool) -> None:
    """
    :param run_folder: Folder of an agent that is about to be unpickled
    :param trust: Whether the user said ``--trust``
    :raises ValueError: If the agent was downloaded, and the user has not said that he trusts its owner
    """
    note = run_folder / _NOTE
    if not note.is_file() or trust or os.environ.get(_VARIABLE, "").lower() in {"1", "true", "yes", "on"}:
        return
    origin = json.loads(note.read_text(encoding="utf-8"))["repo_id"]
    raise ValueError(
        f"{run_folder} comes from {origin} on the Hugging Face Hub; replaying it unpickles it, which runs any code that its "
        "owner put there. Add --trust if you trust the owner; `sb3-uav evaluate` reads the zips without unpickling."
    )

"""The folder of a run: made by one run only, and there as long as it lasts."""

from __future__ import annotations

import errno
import re
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

_NUMBERED = re.compile(r"(.+_)(\d+)(.*)")


def make_run_folder(folder: Path) -> Path:
    """
    Make a folder of which rl_zoo3 has chosen the number; if another run has made it since, that of the next free number.

    :param folder: The folder
    :return: The folder that was made
    :raises OSError: If it cannot be made
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            match = _NUMBERED.fullmatch(folder.name)
            if match is None:
                raise
            folder = folder.with_name(f"{match[1]}{int(match[2]) + 1}{match[3]}")


def require_folder(folder: Path) -> None:
    """
    :param folder: Folder of a run that has begun
    :raises FileNotFoundError: If it has vanished
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            errno.ENOENT, "the folder of this run has vanished during the training, which stops; start it again", str(folder)
        )


class RunFolderGuard(BaseCallback):
    """
    Stops the training when the folder of the run has vanished, which writers of files would make again.

    :param folder: A folder that nothing makes after the start of the run
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_rollout_start(self) -> None:
        require_folder(self.folder)

    def _on_step(self) -> bool:
        return True

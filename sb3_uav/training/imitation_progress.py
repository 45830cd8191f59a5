"""The files from which an interrupted imitation resumes."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_uav.common import distributed
from sb3_uav.common.files import write_atomically
from sb3_uav.common.json_text import parse_json
from sb3_uav.common.saved_tensors import load_tensors
from sb3_uav.envs.instances import Instances
from sb3_uav.policies import RouterPolicy


class Lesson(NamedTuple):
    """
    Subsets and good tours through them.

    :param instances: ``batch`` single-UAV instances
    :param tours: ``(batch, n_steps)`` int64 nodes, padded with the depot
    """

    instances: Instances
    tours: th.Tensor


class ImitationProgress:
    """
    Lessons and updates so far, stored as plain tensors: nothing in the files is executed when they are read.

    :param folder: Folder of the files
    :param settings: Settings of the imitation; the files must have been written with the same settings, generator and seed
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        self.settings = dict(settings)
        self._n_chunks = 0

    def save_lessons(self, lessons: list[Lesson], rng: np.random.Generator) -> None:
        """
        :param lessons: New lessons
        :param rng: The generator they were drawn from
        :raises OSError: If the file cannot be written
        """
        # Copies, because torch saves the whole storage of a view.
        content = [
            {name: field.clone() for name, field in _fields(lesson.instances).items()} | {"tours": lesson.tours.clone()}
            for lesson in lessons
        ]
        self._write(self._chunk_file(), rng, {"lessons": content})
        self._n_chunks += 1

    def restore_lessons(self, rng: np.random.Generator) -> list[Lesson]:
        """
        :param rng: Set to its state when the last lessons were saved
        :return: All saved lessons
        :raises ValueError: If a file is damaged or belongs to other settings
        """
        lessons: list[Lesson] = []
        while (content := self._read(self._chunk_file(), rng)) is not None:
            try:
                lessons += [_lesson(fields) for fields in content["lessons"]]
            except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
                raise self._damaged(self._chunk_file(), error) from error
            self._n_chunks += 1
        # The next file is not written before all processes have found that there is none.
        distributed.barrier()
        return lessons

    def save_updates(
        self, n_updates: int, n_moves: int, router: RouterPolicy, optimizer: th.optim.Optimizer, rng: np.random.Generator
    ) -> None:
        """
        :param n_updates: Number of updates so far
        :param n_moves: Number of moves learned from so far
        :param router: The policy in training
        :param optimizer: Its optimizer
        :param rng: The generator that selects lessons
        :raises OSError: If the file cannot be written
        """
        counts = {"n_updates": n_updates, "n_moves": n_moves}
        states = {"router": router.state_dict(), "optimizer": optimizer.state_dict()}
        self._write(self.folder / "updates.pt", rng, {**counts, **states})

    def restore_updates(
        self, router: RouterPolicy, optimizer: th.optim.Optimizer, rng: np.random.Generator
    ) -> tuple[int, int]:
        """
        :param router: Receives the saved parameters
        :param optimizer: Receives the saved state
        :param rng: Set to its saved state
        :return: Numbers of saved updates and moves; 0 moves if an older version saved them
        :raises ValueError: If the file is damaged or belongs to other settings or another network
        """
        path = self.folder / "updates.pt"
        content = self._read(path, rng)
        if content is None:
            return 0, 0
        n_updates, n_moves = content.get("n_updates"), content.get("n_moves", 0)
        if not isinstance(n_updates, int) or not isinstance(n_moves, int) or not {"router", "optimizer"} <= content.keys():
            raise self._damaged(path, f"n_updates is {n_updates!r}, the fields are {sorted(map(str, content))}")
        try:
            router.load_state_dict(content["router"])
            optimizer.load_state_dict(content["optimizer"])
        except (RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: of another network ({error}); remove {self.folder} to start again.") from error
        return n_updates, n_moves

    def _chunk_file(self) -> Path:
        return self.folder / f"lessons_{self._n_chunks}.pt"

    def _write(self, path: Path, rng: np.random.Generator, content: dict[str, Any]) -> None:
        if not distributed.is_main():
            return
        stream = io.BytesIO()
        th.save({"settings": self.settings, "rng": json.dumps(rng.bit_generator.state), **content}, stream)
        write_atomically(path, stream.getvalue())

    def _read(self, path: Path, rng: np.random.Generator) -> dict[str, Any] | None:
        if not path.is_file():
            return None
        try:
            content = load_tensors(path.read_bytes())
            state, settings = parse_json(content["rng"]), content["settings"]
        except (LookupError, TypeError, ValueError) as error:
            raise self._damaged(path, error) from error
        if settings != self.settings:
            raise ValueError(
                f"{path}: belongs to an imitation with {settings}, not {self.settings}; remove {self.folder} to start again."
            )
        try:
            rng.bit_generator.state = state
        except (LookupError, TypeError, ValueError) as error:
            raise self._damaged(path, f"state of the random numbers: {error!r}") from error
        return content

    def _damaged(self, path: Path, what: object) -> ValueError:
        return ValueError(f"{path}: not an intact file ({what}); remove {self.folder} to start again.")


def _fields(instances: Instances) -> dict[str, th.Tensor]:
    """:return: The tensors of the instances by name, without those that are None"""
    return {name: getattr(instances, name) for name in instances.present_fields()}


def _lesson(fields: dict[str, Any]) -> Lesson:
    """
    :param fields: As :meth:`ImitationProgress.save_lessons` stores them
    :return: The lesson
    :raises ValueError: If tours and instances do not fit together; others if the fields are of other kinds
    """
    tours = fields["tours"]
    if not all(isinstance(field, th.Tensor) for field in fields.values()):
        raise TypeError(f"fields are {[type(field).__name__ for field in fields.values()]}")
    instances = Instances(n_uavs=1, **{name: field for name, field in fields.items() if name != "tours"})
    if tours.dtype != th.int64 or tours.ndim != 2 or len(tours) != len(instances) or len(tours) == 0:
        raise ValueError(f"tours are {tours.dtype} of shape {tuple(tours.shape)} for {len(instances)} instances")
    if int(tours.min()) < 0 or int(tours.max()) > instances.n_tasks:
        raise ValueError(f"tours name nodes {int(tours.min())} to {int(tours.max())} of {instances.n_tasks} tasks")
    return Lesson(instances, tours)

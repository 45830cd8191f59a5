"""Problem instances: batches of tensors, and their ``.npz`` files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_uav.common.files import temporary_name
from sb3_uav.common.npz import read_npz
from sb3_uav.envs.array_input import advice_on, as_numbers, per_instance, row_index
from sb3_uav.envs.distances import distance_limit, euclidean

# A depot is far from the origin beyond this many maximum flight distances, of which float32 still resolves 4e-6 there.
_FAR_FROM_ORIGIN = 64.0

# Larger fleets would not fit the integers of files and solvers.
MAX_UAVS = 2**31 - 1

# The tensors of Instances. The order matters for digests, which result files store.
_TENSOR_FIELDS = ("depot", "tasks", "values", "max_distance", "task_mask")


@dataclass(frozen=True, eq=False)
class Instances:
    """
    A batch of problem instances: one depot, ``n_tasks`` tasks and ``n_uavs`` identical UAVs each.

    All numbers are float64, so that feasibility is decided at that precision. Coordinates converted from float32 keep their
    rounding errors: pass float64 coordinates, especially far from the origin. Networks use float32 copies of
    :meth:`near_origin`.
    Rows with fewer tasks are padded at the end, and ``task_mask`` marks the real tasks. The constructor checks only shapes,
    because the hot loops build subsets by the thousand; :meth:`validate` checks the contents, and :meth:`from_arrays` and
    :meth:`load` call it.

    :param depot: ``(batch, 2)``
    :param tasks: ``(batch, n_tasks, 2)``
    :param values: ``(batch, n_tasks)``, the value of each task
    :param max_distance: ``(batch,)``, the longest tour a UAV can fly (the paper's D), in the unit of the coordinates
    :param n_uavs: Number of UAVs (the paper's V), the same for all rows
    :param task_mask: ``(batch, n_tasks)`` bool, False where a row is padded
    """

    depot: th.Tensor
    tasks: th.Tensor
    values: th.Tensor
    max_distance: th.Tensor
    n_uavs: int
    task_mask: th.Tensor

    def __post_init__(self) -> None:
        batch_size, n_tasks = self.tasks.shape[:2]
        for name, shape in (
            ("depot", (batch_size, 2)),
            ("tasks", (batch_size, n_tasks, 2)),
            ("values", (batch_size, n_tasks)),
            ("max_distance", (batch_size,)),
            ("task_mask", (batch_size, n_tasks)),
        ):
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"Instances.{name} has shape {found}, expected {shape} to match tasks; check the array.")

    @classmethod
    def from_arrays(
        cls,
        depot: Any,
        tasks: Any,
        values: Any = None,
        max_distance: Any = 2.0,
        n_uavs: Any = 4,
        task_mask: Any = None,
        source: str = "Instances",
    ) -> Instances:
        """
        Build and validate instances from anything numpy understands.

        :param depot: ``(batch, 2)``, or ``(2,)`` for one instance
        :param tasks: ``(batch, n_tasks, 2)``, or ``(n_tasks, 2)`` for one instance
        :param values: ``(batch, n_tasks)``; all 1 when None
        :param max_distance: ``(batch,)`` or a number
        :param n_uavs: ``(batch,)``, all the same, or a number
        :param task_mask: ``(batch, n_tasks)`` bool; all True when None
        :param source: Where the arrays come from, named in errors
        :return: The instances, float64 on the CPU
        :raises ValueError: If a shape or a value is not allowed; the message names the field and what was found
        """
        tasks, depot = as_numbers("tasks", tasks, source), as_numbers("depot", depot, source)
        values = None if values is None else as_numbers("values", values, source)
        task_mask = None if task_mask is None else as_numbers("task_mask", task_mask, source)
        if tasks.ndim == 2 and depot.ndim == 1:
            tasks, depot = tasks[None], depot[None]
            values = None if values is None else values[None]
            task_mask = None if task_mask is None else task_mask[None]
        if tasks.ndim != 3 or tasks.shape[-1] != 2:
            raise ValueError(f"{source}: field 'tasks' has shape {tasks.shape}, expected (batch, n_tasks, 2).")
        batch_size, n_tasks = tasks.shape[:2]
        if batch_size < 1 or n_tasks < 1:
            raise ValueError(f"{source}: field 'tasks' has shape {tasks.shape}; give at least one instance with one task.")
        if task_mask is not None and not np.isin(task_mask, (0, 1)).all():
            raise ValueError(f"{source}: field 'task_mask' holds values other than True and False.")
        uavs = np.unique(per_instance("n_uavs", n_uavs, batch_size, source))
        if len(uavs) != 1:
            found = ", ".join(f"{n:g}" for n in uavs)
            raise ValueError(f"{source}: field 'n_uavs' mixes {found}; store each fleet size in a separate file.")
        if not float(uavs[0]).is_integer() or not 1 <= uavs[0] <= MAX_UAVS:
            raise ValueError(
                f"{source}: field 'n_uavs' is {uavs[0]:g}, but a fleet has a whole number of UAVs, at least 1, "
                f"and {MAX_UAVS} at most."
            )
        distance = per_instance("max_distance", max_distance, batch_size, source)
        try:
            instances = cls(
                depot=th.from_numpy(depot),
                tasks=th.from_numpy(tasks),
                values=th.from_numpy(np.ones((batch_size, n_tasks)) if values is None else values),
                max_distance=th.from_numpy(distance),
                n_uavs=int(uavs[0]),
                task_mask=th.from_numpy(
                    np.ones((batch_size, n_tasks), dtype=bool) if task_mask is None else task_mask.astype(bool)
                ),
            )
            instances.validate()
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error
        return instances

    def validate(self) -> None:
        """
        Check the contents.

        :raises ValueError: If a number is NaN or infinite, a value is negative, the sum of the values is infinite,
            ``max_distance <= 0``, there is no UAV, padding is not at the end of its row, or a dtype is not float64; the
            message names the field, the row and the value found
        """
        if self.task_mask.dtype != th.bool:
            raise ValueError(f"field 'task_mask' has dtype {self.task_mask.dtype}; it must be bool.")
        for name in ("depot", "tasks", "values", "max_distance"):
            field = getattr(self, name)
            if field.dtype != th.float64:
                raise ValueError(f"field '{name}' has dtype {field.dtype}; feasibility is decided in float64.")
            # In float32, because observations are: 1e39 would reach a network as inf.
            bad = ~th.isfinite(field.float())
            if bad.any():
                where = tuple(int(i) for i in bad.nonzero()[0])
                found = field[where].item()
                raise ValueError(f"field '{name}' holds {found} at index {where}; every number must be finite in float32.")
        if not 1 <= self.n_uavs <= MAX_UAVS:
            raise ValueError(f"field 'n_uavs' is {self.n_uavs}, but a fleet needs at least 1 UAV, and {MAX_UAVS} at most.")
        too_short = self.max_distance.float() <= 0
        if too_short.any():
            row = int(too_short.nonzero()[0, 0])
            found = self.max_distance[row].item()
            raise ValueError(f"field 'max_distance' is {found} in instance {row}; the maximum flight distance must be > 0.")
        if (self.values < 0).any():
            where = tuple(int(i) for i in (self.values < 0).nonzero()[0])
            raise ValueError(f"field 'values' holds {self.values[where].item()} at index {where}; task values must be >= 0.")
        total = (self.values * self.task_mask).sum(1)
        too_great = ~th.isfinite(total.float())
        if too_great.any():
            row = int(too_great.nonzero()[0, 0])
            found = total[row].item()
            raise ValueError(
                f"field 'values' adds up to {found:g} in instance {row}; the sum must be finite in float32; divide them all."
            )
        if (self.task_mask[:, 1:] & ~self.task_mask[:, :-1]).any():
            raise ValueError("field 'task_mask' marks a real task after a padded one; put the padding at the end of each row.")

    @property
    def batch_size(self) -> int:
        return self.tasks.shape[0]

    @property
    def n_tasks(self) -> int:
        """Number of task slots of a row, padding included."""
        return self.tasks.shape[1]

    @property
    def device(self) -> th.device:
        return self.tasks.device

    @property
    def useful_fleet(self) -> int:
        """Number of UAVs that can be of use, at most one per task; allocate memory for these only."""
        return min(self.n_uavs, max(self.n_tasks, 1))

    def __len__(self) -> int:
        return self.batch_size

    def __getitem__(self, rows: int | np.integer | slice | th.Tensor | np.ndarray | Sequence[int]) -> Instances:
        """
        Select rows.

        :param rows: An integer (or 0-d array or tensor) for a batch of one; a slice; a sequence, array or tensor of row
            numbers, possibly empty; or one bool per row
        :return: The selected rows, a view where ``rows`` is an integer or a slice with a positive step
        :raises IndexError: If there is no such row, or ``rows`` is none of these
        """
        index = row_index(rows, len(self), self.device)
        return self._map(lambda field: field[index])

    def to(self, device: th.device | str) -> Instances:
        """Copy to ``device``; returns ``self`` if it is already there."""
        if self.device == th.device(device):
            return self
        return self._map(lambda field: field.to(device))

    def _map(self, function: Callable[[th.Tensor], th.Tensor]) -> Instances:
        """Apply a function to every tensor."""
        fields: dict[str, Any] = {name: function(getattr(self, name)) for name in _TENSOR_FIELDS}
        return replace(self, **fields)

    def replace_rows(self, rows: th.Tensor, others: Instances) -> Instances:
        """
        Replace some rows by other instances of the same size.

        :param rows: ``(n,)`` int64, the rows to replace
        :param others: ``n`` instances
        :return: A copy with the other instances in these rows
        """
        fields: dict[str, Any] = {
            name: getattr(self, name).index_copy(0, rows, getattr(others, name)) for name in _TENSOR_FIELDS
        }
        return replace(self, **fields)

    def trim(self, n_tasks: int) -> Instances:
        """Keep the first ``n_tasks`` task slots of every row."""
        return replace(
            self,
            tasks=self.tasks[:, :n_tasks],
            values=self.values[:, :n_tasks],
            task_mask=self.task_mask[:, :n_tasks],
        )

    def reorder(self, order: th.Tensor) -> Instances:
        """
        Reorder the tasks.

        :param order: ``(batch, n_tasks)`` int64, the index of the task in each place; padded tasks stay at the end
        :return: The instances, tasks in the new order
        """
        return replace(
            self,
            tasks=self.tasks.gather(1, order[..., None].expand(-1, -1, 2)),
            values=self.values.gather(1, order),
        )

    def pad(self, n_tasks: int) -> Instances:
        """Append padded task slots (at the depot, value 0) up to ``n_tasks``."""
        missing = n_tasks - self.n_tasks
        if missing <= 0:
            return self
        return replace(
            self,
            tasks=th.cat([self.tasks, self.depot[:, None].expand(-1, missing, -1)], dim=1),
            values=th.cat([self.values, self.values.new_zeros(self.batch_size, missing)], dim=1),
            task_mask=th.cat([self.task_mask, self.task_mask.new_zeros(self.batch_size, missing)], dim=1),
        )

    @staticmethod
    def concatenate(parts: Sequence[Instances]) -> Instances:
        """
        Join batches along the batch dimension, padding to the largest.

        :param parts: At least one batch; batches may be empty
        :raises ValueError: If there are no parts, or if they have different numbers of UAVs
        """
        if len(parts) == 0:
            raise ValueError("There are no instances to join; give at least one batch.")
        fleets = {part.n_uavs for part in parts}
        if len(fleets) != 1:
            raise ValueError(f"Cannot join instances with different n_uavs: {sorted(fleets)}.")
        n_tasks = max(part.n_tasks for part in parts)
        padded = [part.pad(n_tasks) for part in parts]
        fields: dict[str, Any] = {name: th.cat([getattr(part, name) for part in padded]) for name in _TENSOR_FIELDS}
        return replace(padded[0], **fields)

    def digest(self, header: str | None = None) -> str:
        """
        SHA-256 of the contents. Equal instances have equal digests.

        :param header: Text hashed before the tensors; number of UAVs, batch size and number of tasks when None
        :return: 64 hexadecimal digits
        """
        header = f"{self.n_uavs} {tuple(self.task_mask.shape)}\n" if header is None else header
        digest = hashlib.sha256(header.encode())
        for name in _TENSOR_FIELDS:
            digest.update(getattr(self, name).detach().cpu().numpy().tobytes())
        return digest.hexdigest()

    def near_origin(self) -> Instances:
        """
        Translate each row whose depot is far from the origin, relative to the maximum flight distance, so that its depot is at
        the origin.

        float32 resolves coordinates around 1e7 only to whole units. Call this before converting to float32, so that a
        network's input does not depend on where the instance lies. Rows near the origin, such as the paper's, stay bit-equal.

        :return: The translated instances
        """
        is_far = self.depot.abs().amax(1) > _FAR_FROM_ORIGIN * self.max_distance
        shift = self.depot.where(is_far[:, None], 0.0)
        return replace(self, depot=self.depot - shift, tasks=self.tasks - shift[:, None])

    def home_distance(self) -> th.Tensor:
        """Distance of every task to its depot, ``(batch, n_tasks)`` float64."""
        return euclidean(self.tasks, self.depot[:, None])

    def reachable(self) -> th.Tensor:
        """Whether a UAV could fly to the task and back, ``(batch, n_tasks)`` bool; padded tasks are not."""
        return self.task_mask & (2 * self.home_distance() <= distance_limit(self.max_distance)[:, None])

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write an ``.npz`` file (float64, no pickles) under a temporary name and rename it.

        :param path: The file to write; ``.npz`` is appended when missing, and missing folders are created
        :raises ValueError: If the batch is empty
        """
        if len(self) == 0:
            raise ValueError(f"{path}: there are no instances to save; a file holds at least one.")
        path = Path(path)
        path = path if path.suffix == ".npz" else path.with_name(path.name + ".npz")
        numbers = {name: getattr(self, name).detach().cpu() for name in _TENSOR_FIELDS if name != "task_mask"}
        arrays = {name: field.double().numpy() for name, field in numbers.items()}
        arrays["n_uavs"] = np.full(self.batch_size, self.n_uavs)
        if not self.task_mask.all():
            arrays["task_mask"] = self.task_mask.cpu().numpy()
        with temporary_name(path) as temporary:
            np.savez_compressed(temporary, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Instances:
        """
        Read an ``.npz`` file with arrays ``depot``, ``tasks``, ``max_distance``, ``n_uavs``, and optionally ``values`` and
        ``task_mask``.

        :param path: The file
        :return: The validated instances
        :raises FileNotFoundError: If there is no such file
        :raises ValueError: If the file is not an intact ``.npz``, lacks an array, holds an unknown array, or holds bad numbers
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such instance file; give the path of an .npz written by Instances.save.")
        arrays = read_npz(path, "write it again")
        known = (*_TENSOR_FIELDS, "n_uavs")
        unknown = [name for name in arrays if name not in known]
        if unknown:
            raise ValueError(f"{path}: unknown array '{unknown[0]}'; {advice_on(unknown[0], known)}.")
        missing = {"depot", "tasks", "max_distance", "n_uavs"} - set(arrays)
        if missing:
            raise ValueError(f"{path}: arrays {sorted(missing)} are missing; found {sorted(arrays)}.")
        return cls.from_arrays(**arrays, source=str(path))

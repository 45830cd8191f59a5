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
from sb3_uav.envs.distances import distance_limit, euclidean

# The tensors of Instances. Digests are taken in this order, and files of results store digests.
TENSOR_FIELDS = ("depot", "tasks", "values", "max_distance", "task_mask")


@dataclass(frozen=True, eq=False)
class Instances:
    """
    A batch of problem instances: one depot, ``n_tasks`` tasks and ``n_uavs`` identical UAVs each.

    Coordinates are float64, so that feasibility is decided at that precision; networks work on ``float()`` copies.
    Rows with fewer tasks are padded at the end, and ``task_mask`` says which tasks are real. The constructor checks shapes
    only, because the hot loops build subsets by the thousand; :meth:`validate` checks the contents, and
    :meth:`from_arrays` and :meth:`load` call it.

    :param depot: ``(batch, 2)``
    :param tasks: ``(batch, n_tasks, 2)``
    :param values: ``(batch, n_tasks)``, the prize of each task
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
        :param source: What the arrays were read from, named in errors
        :return: The instances, float64 on the CPU
        :raises ValueError: If a shape or a value is not allowed; the message names the field and what was found
        """
        tasks, depot = _as_numbers("tasks", tasks, source), _as_numbers("depot", depot, source)
        values = None if values is None else _as_numbers("values", values, source)
        task_mask = None if task_mask is None else _as_numbers("task_mask", task_mask, source)
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
            raise ValueError(f"{source}: field 'task_mask' holds other things than True and False.")
        uavs = np.unique(_per_instance("n_uavs", n_uavs, batch_size, source))
        if len(uavs) != 1:
            found = ", ".join(f"{n:g}" for n in uavs)
            raise ValueError(f"{source}: field 'n_uavs' mixes {found}; store each fleet size in a file of its own.")
        if not float(uavs[0]).is_integer() or uavs[0] < 1:
            raise ValueError(f"{source}: field 'n_uavs' is {uavs[0]:g}, but a fleet has a whole number of UAVs, at least 1.")
        distance = _per_instance("max_distance", max_distance, batch_size, source)
        try:
            instances = cls(
                depot=th.from_numpy(depot),
                tasks=th.from_numpy(tasks),
                values=th.ones(batch_size, n_tasks, dtype=th.float64) if values is None else th.from_numpy(values),
                max_distance=th.from_numpy(distance),
                n_uavs=int(uavs[0]),
                task_mask=th.ones(batch_size, n_tasks, dtype=th.bool)
                if task_mask is None
                else th.from_numpy(task_mask.astype(bool)),
            )
            instances.validate()
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error
        return instances

    def validate(self) -> None:
        """
        Check the contents.

        :raises ValueError: On NaN or infinite numbers, a negative value, values whose sum is infinite, ``max_distance <= 0``,
            fewer than one UAV, padding that is not at the end of its row, or another dtype than float64; the message names
            the field, the row and the value found
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
        if self.n_uavs < 1:
            raise ValueError(f"field 'n_uavs' is {self.n_uavs}, but a fleet needs at least 1 UAV.")
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

    def __len__(self) -> int:
        return self.batch_size

    def __getitem__(self, rows: int | np.integer | slice | th.Tensor | np.ndarray | Sequence[int]) -> Instances:
        """Select rows; an ``int`` gives a batch of one, and one that is out of range an ``IndexError``."""
        if isinstance(rows, int | np.integer):
            if not -len(self) <= rows < len(self):
                # This also ends iteration, which Python builds from __getitem__.
                raise IndexError(f"instance {rows} of a batch of {len(self)}")
            row = int(rows) % len(self)
            rows = slice(row, row + 1)
        index: Any = th.as_tensor(rows, device=self.device) if not isinstance(rows, slice | th.Tensor) else rows
        return self._map(lambda field: field[index])

    def to(self, device: th.device | str) -> Instances:
        """Copy to ``device``; returns ``self`` when it is there already."""
        if self.device == th.device(device):
            return self
        return self._map(lambda field: field.to(device))

    def _map(self, function: Callable[[th.Tensor], th.Tensor]) -> Instances:
        """Apply a function to every tensor."""
        fields: dict[str, Any] = {name: function(getattr(self, name)) for name in TENSOR_FIELDS}
        return replace(self, **fields)

    def replace_rows(self, rows: th.Tensor, others: Instances) -> Instances:
        """
        Put other instances of the same size in the place of some rows.

        :param rows: ``(n,)`` int64, the rows to replace
        :param others: ``n`` instances
        :return: A copy with the other instances in these rows
        """
        fields: dict[str, Any] = {
            name: getattr(self, name).index_copy(0, rows, getattr(others, name)) for name in TENSOR_FIELDS
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
        Put the tasks into another order.

        :param order: ``(batch, n_tasks)`` int64, which task comes first, second, ...; padded tasks stay at the end
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

        :raises ValueError: If the parts have different numbers of UAVs
        """
        fleets = {part.n_uavs for part in parts}
        if len(fleets) != 1:
            raise ValueError(f"Cannot join instances with different n_uavs: {sorted(fleets)}.")
        n_tasks = max(part.n_tasks for part in parts)
        padded = [part.pad(n_tasks) for part in parts]
        fields: dict[str, Any] = {name: th.cat([getattr(part, name) for part in padded]) for name in TENSOR_FIELDS}
        return replace(padded[0], **fields)

    def digest(self, header: str | None = None) -> str:
        """
        SHA-256 of the contents, by which equal instances are recognized.

        :param header: What is hashed before the tensors; number of UAVs, batch size and number of tasks when None
        :return: 64 hexadecimal digits
        """
        header = f"{self.n_uavs} {tuple(self.task_mask.shape)}\n" if header is None else header
        digest = hashlib.sha256(header.encode())
        for name in TENSOR_FIELDS:
            digest.update(getattr(self, name).cpu().numpy().tobytes())
        return digest.hexdigest()

    def home_distance(self) -> th.Tensor:
        """Distance of every task to its depot, ``(batch, n_tasks)`` float64."""
        return euclidean(self.tasks, self.depot[:, None])

    def reachable(self) -> th.Tensor:
        """Whether a UAV could fly to the task and back, ``(batch, n_tasks)`` bool; padded tasks are not."""
        return self.task_mask & (2 * self.home_distance() <= distance_limit(self.max_distance)[:, None])

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write an ``.npz`` file (float64, no pickles) under a temporary name and rename it.

        :param path: The file to write; ``.npz`` is appended when missing
        """
        path = Path(path)
        path = path if path.suffix == ".npz" else path.with_name(path.name + ".npz")
        arrays = {name: getattr(self, name).double().cpu().numpy() for name in ("depot", "tasks", "values", "max_distance")}
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
        :raises ValueError: If the file is not an intact ``.npz``, misses an array, or holds bad numbers
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such instance file; give the path of an .npz written by Instances.save.")
        arrays = read_npz(path, "write it again")
        missing = {"depot", "tasks", "max_distance", "n_uavs"} - set(arrays)
        if missing:
            raise ValueError(f"{path}: arrays {sorted(missing)} are missing; found {sorted(arrays)}.")
        known = {"depot", "tasks", "values", "max_distance", "n_uavs", "task_mask"}
        return cls.from_arrays(**{name: arrays[name] for name in known if name in arrays}, source=str(path))


def _as_numbers(name: str, array: Any, source: str) -> np.ndarray:
    """A float64 copy of anything that holds real numbers; the error names the field."""
    try:
        found = np.asarray(array)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{source}: field '{name}' must be an array of real numbers: {error}") from error
    if found.dtype.kind not in "biuf":
        raise ValueError(f"{source}: field '{name}' must be an array of real numbers, found {array!r:.80}.")
    return found.astype(np.float64)


def _per_instance(name: str, array: Any, batch_size: int, source: str) -> np.ndarray:
    """``(batch_size,)`` float64, from as many numbers or from one for all."""
    numbers = _as_numbers(name, array, source)
    if numbers.shape not in ((), (1,), (batch_size,)):
        raise ValueError(f"{source}: field '{name}' has shape {numbers.shape}, expected ({batch_size},).")
    return np.broadcast_to(numbers, (batch_size,)).copy()

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

from sb3_uav.envs.array_input import as_numbers, per_instance, row_index
from sb3_uav.envs.distances import distance_limit, euclidean
from sb3_uav.envs.fleet_input import fleet_arrays, task_arrays
from sb3_uav.envs.instance_checks import MAX_UAVS, check_contents, check_shapes
from sb3_uav.envs.instance_files import read_arrays, write_arrays

# A depot is far from the origin beyond this many maximum flight distances, of which float32 still resolves 4e-6 there.
_FAR_FROM_ORIGIN = 64.0

# The tensors of Instances. The order matters for digests, which result files store.
_TENSOR_FIELDS = ("depot", "tasks", "values", "max_distance", "task_mask")
# Those that are None in the paper's problem.
_OPTIONAL_FIELDS = ("start", "end", "service", "must_serve")


@dataclass(frozen=True, eq=False)
class Instances:
    """
    A batch of problem instances: one depot, ``n_tasks`` tasks and ``n_uavs`` UAVs each.

    Every UAV flies from its start over some tasks to its end, the depot where nothing else is given, no farther than its
    maximum flight distance. A UAV that could not even fly from its start straight to its end stays where it is.

    All numbers are float64, so that feasibility is decided at that precision. Coordinates converted from float32 keep their
    rounding errors: pass float64 coordinates, especially far from the origin. Networks use float32 copies of
    :meth:`near_origin`.
    Rows with fewer tasks are padded at the end, and ``task_mask`` marks the real tasks. The constructor checks only shapes,
    because the hot loops build subsets by the thousand; :meth:`validate` checks the contents, and :meth:`from_arrays` and
    :meth:`load` call it.

    :param depot: ``(batch, 2)``
    :param tasks: ``(batch, n_tasks, 2)``
    :param values: ``(batch, n_tasks)``, the value of each task
    :param max_distance: ``(batch,)``, the longest tour a UAV can fly (the paper's D), in the unit of the coordinates; or
        ``(batch, n_uavs)``, that of each UAV
    :param n_uavs: Number of UAVs (the paper's V), the same for all rows
    :param task_mask: ``(batch, n_tasks)`` bool, False where a row is padded
    :param start: ``(batch, n_uavs, 2)``, where each UAV is; the depot when None
    :param end: ``(batch, n_uavs, 2)``, where each UAV has to arrive; the depot when None
    :param service: ``(batch, n_tasks)``, flight distance that serving each task costs (hover time times cruise speed), in the
        unit of the coordinates; 0 when None
    :param must_serve: ``(batch, n_tasks)`` bool, the tasks that come first: of two schedules the one that serves more of them
        is better, whatever the values; none when None
    """

    depot: th.Tensor
    tasks: th.Tensor
    values: th.Tensor
    max_distance: th.Tensor
    n_uavs: int
    task_mask: th.Tensor
    start: th.Tensor | None = None
    end: th.Tensor | None = None
    service: th.Tensor | None = None
    must_serve: th.Tensor | None = None

    def __post_init__(self) -> None:
        check_shapes(self)

    @classmethod
    def from_arrays(
        cls,
        depot: Any,
        tasks: Any,
        values: Any = None,
        max_distance: Any = 2.0,
        n_uavs: Any = 4,
        task_mask: Any = None,
        start: Any = None,
        end: Any = None,
        service: Any = None,
        must_serve: Any = None,
        source: str = "Instances",
    ) -> Instances:
        """
        Build and validate instances from anything numpy understands.

        Fields that only repeat the default (a start in the depot, a service cost of 0, equal distances) are left out, so that
        equal instances have equal digests. For one instance all arrays go without the first dimension.

        :param depot: ``(batch, 2)``, or ``(2,)`` for one instance
        :param tasks: ``(batch, n_tasks, 2)``, or ``(n_tasks, 2)`` for one instance
        :param values: ``(batch, n_tasks)``; all 1 when None
        :param max_distance: ``(batch,)`` or a number; or ``(batch, n_uavs)``
        :param n_uavs: ``(batch,)``, all the same, or a number
        :param task_mask: ``(batch, n_tasks)`` bool; all True when None
        :param start: ``(batch, n_uavs, 2)``; the depot when None
        :param end: ``(batch, n_uavs, 2)``; the depot when None
        :param service: ``(batch, n_tasks)``; 0 when None
        :param must_serve: ``(batch, n_tasks)`` bool; False when None
        :param source: Where the arrays come from, named in errors
        :return: The instances, float64 on the CPU
        :raises ValueError: If a shape or a value is not allowed; the message names the field and what was found
        """
        tasks, depot = as_numbers("tasks", tasks, source), as_numbers("depot", depot, source)
        is_single = tasks.ndim == 2 and depot.ndim == 1
        if is_single:
            tasks, depot = tasks[None], depot[None]
        if tasks.ndim != 3 or tasks.shape[-1] != 2:
            raise ValueError(f"{source}: field 'tasks' has shape {tasks.shape}, expected (batch, n_tasks, 2).")
        batch_size, n_tasks = tasks.shape[:2]
        if batch_size < 1 or n_tasks < 1:
            raise ValueError(f"{source}: field 'tasks' has shape {tasks.shape}; give at least one instance with one task.")
        uavs = np.unique(per_instance("n_uavs", n_uavs, batch_size, source))
        if len(uavs) != 1:
            found = ", ".join(f"{n:g}" for n in uavs)
            raise ValueError(f"{source}: field 'n_uavs' mixes {found}; store each fleet size in a separate file.")
        if not float(uavs[0]).is_integer() or not 1 <= uavs[0] <= MAX_UAVS:
            raise ValueError(
                f"{source}: field 'n_uavs' is {uavs[0]:g}, but a fleet has a whole number of UAVs, at least 1, "
                f"and {MAX_UAVS} at most."
            )
        fleet = fleet_arrays(depot, batch_size, max_distance, start, end, int(uavs[0]), is_single, source)
        per_task = task_arrays(
            {"values": values, "task_mask": task_mask, "service": service, "must_serve": must_serve}, is_single, source
        )
        per_task = {"values": np.ones((batch_size, n_tasks)), "task_mask": np.ones((batch_size, n_tasks), bool), **per_task}
        try:
            fields: dict[str, Any] = {
                name: th.from_numpy(array) for name, array in {"depot": depot, "tasks": tasks, **fleet, **per_task}.items()
            }
            instances = cls(**fields, n_uavs=int(uavs[0]))
            instances.validate()
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error
        return instances

    def validate(self) -> None:
        """
        Check the contents.

        :raises ValueError: If a number is NaN or infinite, a value or a service cost is negative, the sum of the values is
            infinite, no UAV can fly, there is no UAV, padding is not at the end of its row, or a dtype is not float64; the
            message names the field, the row and the value found
        """
        check_contents(self)

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
    def has_equal_uavs(self) -> bool:
        """Whether all UAVs fly from the depot to the depot, equally far."""
        return self.start is None and self.end is None and self.max_distance.dim() == 1

    @property
    def is_plain(self) -> bool:
        """Whether this is the paper's problem: equal UAVs, no service costs, no tasks that must be served."""
        return self.has_equal_uavs and self.service is None and self.must_serve is None

    @property
    def beyond_the_paper(self) -> list[str]:
        """Names of the fields that make this another problem than the paper's; ``must_serve`` only changes :attr:`prizes`."""
        ranges = ["max_distance per UAV"] if self.max_distance.dim() == 2 else []
        return ranges + [name for name in ("start", "end", "service") if getattr(self, name) is not None]

    @property
    def useful_fleet(self) -> int:
        """Number of UAVs that can be of use, of equal ones at most one per task; allocate memory for these only."""
        return min(self.n_uavs, max(self.n_tasks, 1)) if self.has_equal_uavs else self.n_uavs

    @property
    def unit(self) -> th.Tensor:
        """The maximum flight distance of the UAV that flies farthest, ``(batch,)``."""
        return self.max_distance if self.max_distance.dim() == 1 else self.max_distance.amax(1)

    @property
    def uav_distance(self) -> th.Tensor:
        """The maximum flight distance of every UAV, ``(batch, n_uavs)``."""
        return self.max_distance[:, None].expand(-1, self.n_uavs) if self.max_distance.dim() == 1 else self.max_distance

    @property
    def uav_start(self) -> th.Tensor:
        """Where every UAV is, ``(batch, n_uavs, 2)``."""
        return self.depot[:, None].expand(-1, self.n_uavs, -1) if self.start is None else self.start

    @property
    def uav_end(self) -> th.Tensor:
        """Where every UAV has to arrive, ``(batch, n_uavs, 2)``."""
        return self.depot[:, None].expand(-1, self.n_uavs, -1) if self.end is None else self.end

    @property
    def can_fly(self) -> th.Tensor:
        """Which UAVs can fly from their start straight to their end, ``(batch, n_uavs)`` bool."""
        return euclidean(self.uav_start, self.uav_end) <= distance_limit(self.uav_distance)

    @property
    def service_cost(self) -> th.Tensor:
        """What serving every task costs, ``(batch, n_tasks)``."""
        return th.zeros_like(self.values) if self.service is None else self.service

    @property
    def prizes(self) -> th.Tensor:
        """
        What schedules are compared by, ``(batch, n_tasks)``: the values, and for tasks that must be served so much more that
        one of them outweighs all values together.
        """
        if self.must_serve is None:
            return self.values
        total = (self.values * self.task_mask).sum(1, keepdim=True)
        return self.values + self.must_serve * th.where(total > 0, 2 * total, 1.0)

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
        fields: dict[str, Any] = {name: function(getattr(self, name)) for name in self.present_fields()}
        return replace(self, **fields)

    def present_fields(self) -> list[str]:
        """:return: Names of the tensors, without those that are None"""
        return [*_TENSOR_FIELDS, *(name for name in _OPTIONAL_FIELDS if getattr(self, name) is not None)]

    @staticmethod
    def _alike(parts: Sequence[Instances]) -> list[Instances]:
        """:return: The parts, each with the fields that any of them has"""
        present = {name for part in parts for name in part.present_fields()}
        ranges_differ = any(part.max_distance.dim() == 2 for part in parts)
        defaults = {"start": "uav_start", "end": "uav_end", "service": "service_cost"}
        filled = []
        for part in parts:
            fields: dict[str, Any] = {name: getattr(part, of) for name, of in defaults.items() if name in present}
            if "must_serve" in present and part.must_serve is None:
                fields["must_serve"] = th.zeros_like(part.task_mask)
            if ranges_differ:
                fields["max_distance"] = part.uav_distance
            filled.append(replace(part, **fields))
        return filled

    def with_fleet(self, n_uavs: int) -> Instances:
        """
        :param n_uavs: Number of UAVs
        :return: The instances with the first so many of their UAVs, or with more of equal ones
        :raises ValueError: If UAVs differ and there are not so many
        """
        if n_uavs == self.n_uavs:
            return self
        if n_uavs > self.n_uavs and not self.has_equal_uavs:
            raise ValueError(
                f"The instances have {self.n_uavs} UAVs that differ, so there cannot be {n_uavs}; give at most that."
            )
        fields: dict[str, Any] = {
            name: getattr(self, name)[:, :n_uavs] for name in ("start", "end") if name in self.present_fields()
        }
        if self.max_distance.dim() == 2:
            distance = self.max_distance[:, :n_uavs]
            fields["max_distance"] = distance[:, 0] if n_uavs == 1 else distance
        return replace(self, n_uavs=n_uavs, **fields)

    def replace_rows(self, rows: th.Tensor, others: Instances) -> Instances:
        """
        Replace some rows by other instances of the same size.

        :param rows: ``(n,)`` int64, the rows to replace
        :param others: ``n`` instances
        :return: A copy with the other instances in these rows
        """
        mine, new = self._alike([self, others])
        fields: dict[str, Any] = {
            name: getattr(mine, name).index_copy(0, rows, getattr(new, name)) for name in mine.present_fields()
        }
        return replace(mine, **fields)

    def trim(self, n_tasks: int) -> Instances:
        """Keep the first ``n_tasks`` task slots of every row."""
        return self._map_tasks(lambda field: field[:, :n_tasks], "task_mask")

    def _map_tasks(self, function: Callable[[th.Tensor], th.Tensor], *others: str) -> Instances:
        """Apply a function to what is known of every task, and to fields named beside that."""
        names = ["tasks", "values", *(name for name in ("service", "must_serve") if getattr(self, name) is not None), *others]
        fields: dict[str, Any] = {name: function(getattr(self, name)) for name in names}
        return replace(self, **fields)

    def reorder(self, order: th.Tensor) -> Instances:
        """
        Reorder the tasks.

        :param order: ``(batch, n_tasks)`` int64, the index of the task in each place; padded tasks stay at the end
        :return: The instances, tasks in the new order
        """

        def gather(field: th.Tensor) -> th.Tensor:
            return field.gather(1, order if field.dim() == 2 else order[..., None].expand(-1, -1, 2))

        return self._map_tasks(gather)

    def pad(self, n_tasks: int) -> Instances:
        """Append padded task slots (at the depot, value 0) up to ``n_tasks``."""
        missing = n_tasks - self.n_tasks
        if missing <= 0:
            return self

        def append(field: th.Tensor) -> th.Tensor:
            zeros = field.new_zeros(self.batch_size, missing)
            return th.cat([field, zeros if field.dim() == 2 else self.depot[:, None].expand(-1, missing, -1)], dim=1)

        return self._map_tasks(append, "task_mask")

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
        padded = Instances._alike([part.pad(n_tasks) for part in parts])
        fields: dict[str, Any] = {
            name: th.cat([getattr(part, name) for part in padded]) for name in padded[0].present_fields()
        }
        return replace(padded[0], **fields)

    def digest(self, header: str | None = None) -> str:
        """
        SHA-256 of the contents. Equal instances have equal digests.

        :param header: Text hashed before the tensors; number of UAVs, batch size and number of tasks when None
        :return: 64 hexadecimal digits
        """
        header = f"{self.n_uavs} {tuple(self.task_mask.shape)}\n" if header is None else header
        digest = hashlib.sha256(header.encode())
        for name in self.present_fields():
            if name in _OPTIONAL_FIELDS:
                digest.update(name.encode())
            digest.update(getattr(self, name).detach().cpu().numpy().tobytes())
        return digest.hexdigest()

    def near_origin(self) -> Instances:
        """
        Translate each row whose depot is far from the origin, relative to the maximum flight distance, so that its depot is at
        the origin. Where UAVs have ends of their own, that of the first one that can fly counts: the depot may be anywhere.

        float32 resolves coordinates around 1e7 only to whole units. Call this before converting to float32, so that a
        network's input does not depend on where the instance lies. Rows near the origin, such as the paper's, stay bit-equal.

        :return: The translated instances
        """
        place = self.depot
        if self.end is not None:
            place = self.end.gather(1, self.can_fly.to(th.int8).argmax(1)[:, None, None].expand(-1, 1, 2))[:, 0]
        is_far = place.abs().amax(1) > _FAR_FROM_ORIGIN * self.unit
        shift = place.where(is_far[:, None], 0.0)
        moved = replace(self, depot=self.depot - shift)
        return moved.map_points(lambda points: points - shift[:, None])

    def map_points(self, function: Callable[[th.Tensor], th.Tensor]) -> Instances:
        """
        :param function: Moves ``(batch, n, 2)`` points, row by row
        :return: The instances with tasks, starts and ends moved; the depots stay
        """
        names = ["tasks", *(name for name in ("start", "end") if getattr(self, name) is not None)]
        fields: dict[str, Any] = {name: function(getattr(self, name)) for name in names}
        return replace(self, **fields)

    def home_distance(self) -> th.Tensor:
        """Distance of every task to its depot, ``(batch, n_tasks)`` float64."""
        return euclidean(self.tasks, self.depot[:, None])

    def reachable(self) -> th.Tensor:
        """Whether a UAV could serve the task, and no other; ``(batch, n_tasks)`` bool; padded tasks are not."""
        if self.is_plain:
            return self.task_mask & (2 * self.home_distance() <= distance_limit(self.max_distance)[:, None])
        return self.reachable_by_uav().any(1)

    def reachable_by_uav(self) -> th.Tensor:
        """Which UAV could serve which task, and no other; ``(batch, n_uavs, n_tasks)`` bool."""
        tasks = self.tasks[:, None]
        outward, homeward = (euclidean(tasks, points[:, :, None]) for points in (self.uav_start, self.uav_end))
        length = outward + self.service_cost[:, None] + homeward
        return self.task_mask[:, None] & (length <= distance_limit(self.uav_distance)[..., None])

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write an ``.npz`` file (float64, no pickles) under a temporary name and rename it.

        :param path: The file to write; ``.npz`` is appended when missing, and missing folders are created
        :raises ValueError: If the batch is empty
        """
        if len(self) == 0:
            raise ValueError(f"{path}: there are no instances to save; a file holds at least one.")
        fields = {name: getattr(self, name).detach().cpu() for name in self.present_fields()}
        arrays = {name: (field if field.dtype == th.bool else field.double()).numpy() for name, field in fields.items()}
        if self.task_mask.all():
            del arrays["task_mask"]
        write_arrays(Path(path), {**arrays, "n_uavs": np.full(self.batch_size, self.n_uavs)})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Instances:
        """
        Read an ``.npz`` file with arrays ``depot``, ``tasks``, ``max_distance``, ``n_uavs``, and optionally ``values``,
        ``task_mask``, ``start``, ``end``, ``service`` and ``must_serve``.

        :param path: The file
        :return: The validated instances
        :raises FileNotFoundError: If there is no such file
        :raises ValueError: If the file is not an intact ``.npz``, lacks an array, holds an unknown array, or holds bad numbers
        """
        known = (*_TENSOR_FIELDS, "n_uavs", *_OPTIONAL_FIELDS)
        return cls.from_arrays(**read_arrays(Path(path), known), source=str(path))

"""What instances must be like, checked when they come from outside."""

from __future__ import annotations

from typing import Any

import torch as th

# Larger fleets would not fit the integers of files and solvers.
MAX_UAVS = 2**31 - 1


def check_shapes(instances: Any) -> None:
    """
    :param instances: The ``Instances``, whose module imports this one
    :raises ValueError: If a tensor does not match ``tasks``
    """
    batch_size, n_tasks = instances.tasks.shape[:2]
    per_task, per_uav = (batch_size, n_tasks), (batch_size, instances.n_uavs, 2)
    expected = {
        "depot": (batch_size, 2),
        "tasks": (batch_size, n_tasks, 2),
        "values": per_task,
        "max_distance": (batch_size,) if instances.max_distance.dim() != 2 else (batch_size, instances.n_uavs),
        "task_mask": per_task,
        "start": per_uav,
        "end": per_uav,
        "service": per_task,
        "must_serve": per_task,
    }
    for name, shape in expected.items():
        field = getattr(instances, name)
        if field is not None and tuple(field.shape) != shape:
            raise ValueError(
                f"Instances.{name} has shape {tuple(field.shape)}, expected {shape} to match tasks and fleet; check the array."
            )


_NUMBERS = ("depot", "tasks", "values", "max_distance", "start", "end", "service")


def require_finite_instances(instances: Any, generator: Any) -> None:
    """
    The part of :func:`check_contents` that every batch of a training undergoes.

    :param instances: The ``Instances`` that were drawn
    :param generator: What drew them
    :raises ValueError: If a number is NaN or infinite; the message names generator, field and place
    """
    for name in _NUMBERS:
        field = getattr(instances, name)
        if field is not None and not bool(th.isfinite(field.float()).all()):
            where = tuple(int(i) for i in (~th.isfinite(field.float())).nonzero()[0])
            # Generators of the router's instances wrap the one of the fleet.
            generator = getattr(generator, "generator", generator)
            raise ValueError(
                f"{getattr(generator, '__name__', type(generator).__name__)} drew an instance whose field '{name}' holds "
                f"{field[where].item()} at index {where}; every number must be finite in float32. Nothing was learned from "
                "it: mend the generator, or the file that it reads."
            )


def check_contents(instances: Any) -> None:
    """
    :param instances: The ``Instances``, whose module imports this one
    :raises ValueError: See :meth:`~sb3_uav.envs.instances.Instances.validate`
    """
    for name in ("task_mask", "must_serve"):
        field = getattr(instances, name)
        if field is not None and field.dtype != th.bool:
            raise ValueError(f"field '{name}' has dtype {field.dtype}; it must be bool.")
    for name in _NUMBERS:
        field = getattr(instances, name)
        if field is not None:
            _check_numbers(name, field)
    if not 1 <= instances.n_uavs <= MAX_UAVS:
        raise ValueError(f"field 'n_uavs' is {instances.n_uavs}, but a fleet needs at least 1 UAV, and {MAX_UAVS} at most.")
    _check_distances(instances)
    for name in ("values", "service"):
        field = getattr(instances, name)
        if field is not None and (field < 0).any():
            where = tuple(int(i) for i in (field < 0).nonzero()[0])
            what = "task values" if name == "values" else "service costs"
            raise ValueError(f"field '{name}' holds {field[where].item()} at index {where}; {what} must be >= 0.")
    total = (instances.prizes * instances.task_mask).sum(1)
    too_great = ~th.isfinite(total.float())
    if too_great.any():
        row = int(too_great.nonzero()[0, 0])
        found = (instances.values * instances.task_mask).sum(1)[row].item()
        raise ValueError(
            f"field 'values' adds up to {found:g} in instance {row}; the sum must be finite in float32; divide them all."
        )
    if (instances.task_mask[:, 1:] & ~instances.task_mask[:, :-1]).any():
        raise ValueError("field 'task_mask' marks a real task after a padded one; put the padding at the end of each row.")


def _check_numbers(name: str, field: th.Tensor) -> None:
    if field.dtype != th.float64:
        raise ValueError(f"field '{name}' has dtype {field.dtype}; feasibility is decided in float64.")
    # In float32, because observations are: 1e39 would reach a network as inf.
    bad = ~th.isfinite(field.float())
    if bad.any():
        where = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(
            f"field '{name}' holds {field[where].item()} at index {where}; every number must be finite in float32."
        )


def _check_distances(instances: Any) -> None:
    too_short = instances.unit.float() <= 0
    if too_short.any():
        row = int(too_short.nonzero()[0, 0])
        found = instances.unit[row].item()
        raise ValueError(f"field 'max_distance' is {found} in instance {row}; the maximum flight distance must be > 0.")
    negative = instances.uav_distance < 0 if instances.max_distance.dim() == 2 else too_short
    if negative.any():
        row, uav = (int(i) for i in negative.nonzero()[0])
        found = instances.max_distance[row, uav].item()
        raise ValueError(
            f"field 'max_distance' is {found} for UAV {uav} of instance {row}; give 0 to one that cannot fly any more."
        )

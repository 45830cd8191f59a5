"""Leaving tasks out of instances."""

from __future__ import annotations

from dataclasses import replace

import torch as th

from sb3_uav.envs.instances import Instances


def compact(instances: Instances, kept: th.Tensor) -> tuple[Instances, th.Tensor]:
    """
    Keep some of the tasks, in their order, at the beginning of each row.

    :param instances: ``batch`` instances, possibly padded
    :param kept: ``(batch, n_tasks)`` bool, the tasks to keep, none of them padded
    :return: The instances, padded to the largest, with at least one slot; and ``(batch, n_slots)`` int64, the original task in
        each slot
    """
    index = (~kept).long().argsort(dim=1, stable=True)
    task_mask = kept.gather(1, index)
    # A row without tasks keeps one padded slot.
    n_slots = max(int(task_mask.sum(1).max()), 1)
    arranged = replace(instances.reorder(index), task_mask=task_mask).trim(n_slots)
    padded = ~arranged.task_mask
    compacted = replace(
        arranged,
        tasks=th.where(padded[..., None], arranged.depot[:, None], arranged.tasks),
        values=arranged.values.masked_fill(padded, 0.0),
        service=None if arranged.service is None else arranged.service.masked_fill(padded, 0.0),
        must_serve=None if arranged.must_serve is None else arranged.must_serve & ~padded,
    )
    return compacted, index[:, :n_slots]

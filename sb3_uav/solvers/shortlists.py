"""The best schedules that the networks have found so far for every instance of a batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch.nn import functional

from sb3_uav.envs.allocation import schedules
from sb3_uav.envs.schedule import Schedule


class Block(NamedTuple):
    """
    Some schedules of every instance.

    :param value: ``(batch, n_schedules)`` float64
    :param tours: ``(batch, n_schedules, n_uavs, n_steps)`` int64, tasks in the order of the input, -1 as padding
    """

    value: th.Tensor
    tours: th.Tensor

    @classmethod
    def concatenate(cls, blocks: Sequence[Block]) -> Block:
        """
        :param blocks: Blocks of different instances with the same number of UAVs and of schedules
        :return: One block of all instances
        """
        n_steps = max(block.tours.shape[-1] for block in blocks)
        padded = [functional.pad(block.tours, (0, n_steps - block.tours.shape[-1]), value=-1) for block in blocks]
        return cls(th.cat([block.value for block in blocks]), th.cat(padded))


class Shortlists:
    """
    The best schedules of every instance so far.

    :param n_instances: Number of instances
    :param length: How many to keep of each
    """

    def __init__(self, n_instances: int, length: int) -> None:
        self.length = length
        self._found: list[dict[Schedule, float]] = [{} for _ in range(n_instances)]

    def add(self, block: Block) -> None:
        """:param block: More schedules of the same instances"""
        values, order = block.value.sort(dim=1, descending=True, stable=True)
        for found, tours, value, places in zip(self._found, block.tours, values.tolist(), order, strict=True):
            worst = min(found.values()) if len(found) >= self.length else -math.inf
            new: dict[Schedule, float] = {}
            for place, objective in zip(places, value, strict=True):
                if objective <= worst or len(new) == self.length:
                    break
                new.setdefault(schedules(tours[place, None])[0], objective)
            # A stable sort: among equal schedules, earlier ones stay.
            best = sorted((found | new).items(), key=lambda item: -item[1])
            found.clear()
            found.update(best[: self.length])

    def schedules(self) -> list[list[Schedule]]:
        """:return: The shortlist of each instance, the best first"""
        return [list(found) for found in self._found]

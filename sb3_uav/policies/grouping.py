"""Transitions sorted by the instance that they belong to, so that each instance is encoded once per minibatch."""

from __future__ import annotations

from typing import NamedTuple

import torch as th

# Key of an episode rollout buffer's samples: the row of the static part that each transition belongs to.
EPISODE_INDEX = "episode_index"


class Grouping(NamedTuple):
    """
    A table with one row per instance and one column per transition; short rows are filled with copies of a transition.

    :param source: ``(n_instances, n_columns)`` int64, the transition in each slot
    :param slot: ``(batch,)`` int64, the flat slot of each transition
    """

    source: th.Tensor
    slot: th.Tensor

    @classmethod
    def by_instance(cls, index: th.Tensor, n_instances: int) -> Grouping:
        """
        :param index: ``(batch,)`` int64, the instance of each transition; every instance has at least one
        :param n_instances: Number of instances
        :return: The transitions in rows, in their order
        """
        counts = index.bincount(minlength=n_instances)
        n_columns = int(counts.max())
        order = index.argsort(stable=True)
        first = counts.cumsum(0) - counts
        transition = th.arange(len(index), device=index.device)
        column = th.empty_like(index).index_copy(0, order, transition - first[index[order]])
        slot = index * n_columns + column
        # Copies of a real transition, because a state without any legal action would turn gradients to NaN.
        source = order[first].repeat_interleave(n_columns).index_copy(0, slot, transition)
        return cls(source.view(n_instances, n_columns), slot)

    def gather(self, field: th.Tensor) -> th.Tensor:
        """
        :param field: ``(batch, ...)``
        :return: ``(n_instances, n_columns, ...)``
        """
        return field[self.source]

    def scatter(self, table: th.Tensor) -> th.Tensor:
        """
        :param table: ``(n_instances, n_columns, ...)``
        :return: ``(batch, ...)``
        """
        return table.flatten(0, 1)[self.slot]

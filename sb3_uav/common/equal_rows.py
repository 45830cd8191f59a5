"""Finding equal rows of integers."""

from __future__ import annotations

import torch as th


def equal_rows(table: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    :param table: ``(n, width)`` int64
    :return: The first row of each kind, in ascending order; and which of them each row is equal to, ``(n,)`` int64, an index
        into the former
    """
    everything = th.arange(len(table), device=table.device)
    found, kind = table.unique(dim=0, return_inverse=True)
    first = everything.new_full((len(found),), len(table)).scatter_reduce(0, kind, everything, "amin")
    is_first = first[kind] == everything
    number = is_first.cumsum(0) - 1
    return is_first.nonzero()[:, 0], number[first[kind]]

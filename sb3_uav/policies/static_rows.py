"""Rows of the static part of observations: a named tuple of tensors (or None) that all lead with the batch dimension."""

from __future__ import annotations

from typing import Any, TypeVar

import torch as th

StaticT = TypeVar("StaticT", bound=Any)


def select_rows(static: StaticT, rows: th.Tensor) -> StaticT:
    """
    :param static: ``batch`` observations
    :param rows: ``(n,)`` int64
    :return: These rows, in this order
    """
    return type(static)(*(None if field is None else field[rows] for field in static))


def distinct_rows(static: StaticT) -> tuple[StaticT, th.Tensor]:
    """
    :param static: ``batch`` observations
    :return: The distinct rows, and the index among them of every row, ``(batch,)`` int64
    """
    flat = th.cat([field.flatten(1).float() for field in static if field is not None], dim=1)
    different, index = flat.unique(dim=0, return_inverse=True)
    # Any row of each kind; index_copy with repeated targets keeps one of them.
    row = th.arange(len(index), device=index.device)
    return select_rows(static, index.new_zeros(len(different)).index_copy(0, index, row)), index


def have_equal_shapes(static: StaticT, other: StaticT) -> bool:
    """
    :param static: Any observations
    :param other: Observations of the same kind
    :return: Whether they have as many rows of the same size
    """
    return [_shape(field) for field in static] == [_shape(field) for field in other]


def _shape(field: th.Tensor | None) -> th.Size | None:
    return None if field is None else field.shape


def changed_rows(static: StaticT, other: StaticT) -> th.Tensor:
    """
    :param static: ``batch`` observations
    :param other: As many observations of the same size
    :return: ``(n,)`` int64, the rows that differ in any field
    """
    pairs = [(old, new) for old, new in zip(static, other, strict=True) if old is not None]
    return th.stack([(old != new).flatten(1).any(1) for old, new in pairs]).any(0).nonzero()[:, 0]


def copy_rows(static: StaticT) -> StaticT:
    """
    :param static: Any observations
    :return: A copy that shares no memory
    """
    return type(static)(*(None if field is None else field.clone() for field in static))

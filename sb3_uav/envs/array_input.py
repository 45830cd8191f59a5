"""Conversion of user input (arrays, row numbers, names of arrays) for instances, with helpful errors."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th

# Other common names of the arrays of an instance file, in lower case and without underscores.
_SYNONYMS = {
    "depot": "depots base home start origin launch",
    "tasks": "task customers nodes points targets locations locs positions coordinates coords xy sites cities",
    "values": "value prize prizes reward rewards score scores profit profits weight weights priority priorities",
    "max_distance": "d dmax tmax distance maxdist maxlength maxrange limit distancelimit budget range",
    "n_uavs": "v m uavs nuav numuavs fleet fleetsize drones ndrones vehicles nvehicles",
    "task_mask": "mask masks padding paddingmask real valid",
}


def advice_on(name: str, known: Sequence[str]) -> str:
    """
    :param name: Name of an unknown array
    :param known: Names of the known ones
    :return: Advice that names the array that was probably meant, or all known ones
    """
    plain = name.lower().replace("_", "").replace("-", "").replace(" ", "")
    meant = [field for field, synonyms in _SYNONYMS.items() if plain in synonyms.split()]
    meant = meant or difflib.get_close_matches(name.lower(), known, 1, 0.7)
    if meant:
        return f"did you mean '{meant[0]}'? Rename or remove it"
    return f"remove it; the known ones are {', '.join(known)}"


def row_index(rows: Any, n_rows: int, device: th.device) -> slice | th.Tensor:
    """
    :param rows: The argument of ``Instances.__getitem__``
    :param n_rows: Number of rows
    :param device: Where the rows are
    :return: An index into the first dimension of a tensor
    :raises IndexError: If there is no such row, or ``rows`` does not select rows
    """
    if isinstance(rows, slice):
        # Tensors do not support negative steps.
        return rows if rows.step is None or rows.step > 0 else th.tensor(range(n_rows)[rows], dtype=th.int64, device=device)
    if isinstance(rows, th.Tensor):
        index = rows.to(device)
    else:
        index = th.as_tensor(np.asarray(rows), device=device)
    if index.numel() == 0 and index.ndim == 1:
        index = index.to(th.int64)
    if index.is_floating_point() or index.ndim > 1 or (index.dtype == th.bool and index.shape != (n_rows,)):
        raise IndexError(f"{rows!r:.80} is not a selection of instances; use row numbers, or {n_rows} bools.")
    if index.ndim == 0:
        row = int(index)
        if not -n_rows <= row < n_rows:
            # This also ends iteration, which Python builds from __getitem__.
            raise IndexError(f"instance {row} of a batch of {n_rows}")
        return slice(row % n_rows, row % n_rows + 1)
    return index if index.dtype == th.bool else index.to(th.int64)


def as_numbers(name: str, array: Any, source: str) -> np.ndarray:
    """
    :param name: Name of the field, for errors
    :param array: Anything that holds real numbers; gradients are dropped
    :param source: Where it comes from, for errors
    :return: A float64 copy
    :raises ValueError: If it is not an array of real numbers, or has masked entries
    """
    try:
        if isinstance(array, th.Tensor):
            array = array.detach().cpu()
            array = array.double() if array.is_floating_point() else array
        # np.asarray would drop the masks of masked arrays, including masked arrays in a list.
        found = np.ma.asarray(array) if isinstance(array, list | tuple) else np.asanyarray(array)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{source}: field '{name}' must be an array of real numbers: {error}") from error
    if isinstance(found, np.ma.MaskedArray):
        masked = np.argwhere(np.ma.getmaskarray(found))
        if len(masked) > 0:
            where = tuple(int(i) for i in masked[0])
            raise ValueError(
                f"{source}: field '{name}' has masked entries, the first at index {where}; fill them or leave the tasks out."
            )
    found = np.asarray(found)
    if found.dtype.kind not in "biuf":
        raise ValueError(f"{source}: field '{name}' must be an array of real numbers, found {array!r:.80}.")
    return found.astype(np.float64)


def per_instance(name: str, array: Any, batch_size: int, source: str) -> np.ndarray:
    """
    :param name: Name of the field, for errors
    :param array: One number per instance, or one for all
    :param batch_size: Number of instances
    :param source: Where it comes from, for errors
    :return: ``(batch_size,)`` float64
    """
    numbers = as_numbers(name, array, source)
    if numbers.shape not in ((), (1,), (batch_size,)):
        raise ValueError(f"{source}: field '{name}' has shape {numbers.shape}, expected ({batch_size},).")
    return np.broadcast_to(numbers, (batch_size,)).copy()

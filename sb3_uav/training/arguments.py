"""Checks of constructor arguments."""

from __future__ import annotations


def check_counts(least: int, **counts: int | None) -> None:
    """
    :param least: The smallest number allowed
    :param counts: Arguments by name; None stands for a default
    :raises ValueError: If one of them is not a whole number, or smaller
    """
    for name, value in counts.items():
        if value is not None and (not isinstance(value, int) or value < least):
            raise ValueError(f"{name} is {value!r}; it must be a whole number of at least {least}.")

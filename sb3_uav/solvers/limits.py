"""Time limits of solvers."""

from __future__ import annotations

import math
import time

from sb3_uav.solvers.base import OneByOneSolver
from sb3_uav.solvers.unavailable import UnavailableError


class _TimeLimitError(UnavailableError):
    """A time limit that is not a finite number above 0."""


def deadline_after(time_limit: float, whose: str) -> float:
    """
    :param time_limit: Seconds from now
    :param whose: Name of the solver, for errors
    :return: End of the time limit, in seconds of ``time.perf_counter``
    :raises TimeLimitError: If the limit is not a finite number above 0
    """
    if not 0 < time_limit < math.inf:
        raise _TimeLimitError(f"time_limit of {whose} is {time_limit:g} seconds; it must be more than 0, and finite.")
    return time.perf_counter() + time_limit


class TimeLimitedSolver(OneByOneSolver):
    """
    A solver that searches until a time limit.

    :param time_limit: Seconds per instance when :meth:`solve` is given none
    :raises TimeLimitError: If it is not a finite number above 0
    """

    def __init__(self, time_limit: float) -> None:
        deadline_after(time_limit, self.name)
        self.time_limit = time_limit

    def deadline(self, time_limit: float | None) -> float:
        """
        :param time_limit: Seconds from now, or None for the solver's own limit
        :return: End of the time limit, in seconds of ``time.perf_counter``
        :raises TimeLimitError: If the limit is not a finite number above 0
        """
        return deadline_after(self.time_limit if time_limit is None else time_limit, self.name)

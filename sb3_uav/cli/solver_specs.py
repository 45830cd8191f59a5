"""The solvers that a command line names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_uav.solvers import Solver


def solvers_of(
    specs: Sequence[str], device: str = "auto", batch_size: int | None = None
) -> tuple[list[Solver], list[Exception]]:
    """
    :param specs: As of :func:`~sb3_uav.solvers.registry.make_solver`
    :param device: Device of networks
    :param batch_size: How many instances networks solve at once
    :return: The solvers, in place of one that cannot be made one that refuses all instances; and errors of those that are
        wrong, not merely missing here
    """
    from sb3_uav.solvers import make_solver
    from sb3_uav.solvers.unavailable import UnavailableError, UnavailableSolver

    solvers: list[Solver] = []
    wrong: list[Exception] = []
    for spec in specs:
        try:
            solvers.append(make_solver(spec, device=device, batch_size=batch_size))
        except (ImportError, ValueError, OSError) as error:
            # The others can do without it.
            solvers.append(UnavailableSolver(spec, str(error)))
            wrong += [] if isinstance(error, ImportError | UnavailableError) else [error]
    return solvers, wrong

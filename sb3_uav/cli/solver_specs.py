"""The solvers that a command line names, and how they are to be run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_uav.solvers import Solver


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Gets the options that every command has that runs solvers
    """
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="solve N instances at once in processes of one thread each; networks stay in this one (default: %(default)s)",
    )
    parser.add_argument("--overwrite", action="store_true", help="start over instead of resuming from the results in DIR")
    parser.add_argument(
        "--shard",
        metavar="I/N",
        help="evaluate only part I of N, from 1, of every set, for several machines; `sb3-uav merge` joins their folders",
    )
    networks = parser.add_argument_group("networks")
    networks.add_argument("--device", default="auto", help="cpu, cuda, cuda:0, ... (default: %(default)s)")
    networks.add_argument("--batch-size", type=int, help="instances solved at once, default: as many as memory allows")


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

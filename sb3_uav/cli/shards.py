"""One command on several machines or processes: which part is whose, and who joins them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path
from typing import TypeVar

from sb3_uav.common.distributed import barrier, is_launched, is_main, on_main, process_group, rank, world_size
from sb3_uav.evaluation.shard import Shard

ResultT = TypeVar("ResultT")
# One process may have nothing left to do when a run is resumed, and another one all of its shard. torchrun ends all of them if
# one fails.
_LONGEST_WAIT = timedelta(days=365)


def run_shard(
    args: argparse.Namespace,
    run: Callable[[Shard, Path], ResultT],
    join: Callable[[Sequence[Path], Path], ResultT],
) -> ResultT | None:
    """
    Run the part of a command that ``--shard`` names. Under ``torchrun`` each process runs one, in a folder of its own in
    ``--out``; the first process then joins them.

    :param args: With ``shard`` and ``out``
    :param run: Runs a shard and writes a folder
    :param join: Joins the folders of all shards into one
    :return: The result; None in other processes than the first
    :raises ValueError: If ``--shard`` is given under ``torchrun``, or is wrong
    """
    if not is_launched():
        return run(Shard.parse(args.shard or "1/1"), args.out)
    if args.shard is not None:
        raise ValueError(f"--shard is {args.shard}, but torchrun shares out the instances itself; leave it out.")
    with process_group(_LONGEST_WAIT):
        folders = [args.out / f"shard-{number}-of-{world_size()}" for number in range(1, world_size() + 1)]
        run(Shard(rank() + 1, world_size()), folders[rank()])
        barrier()
        result = on_main(lambda: join(folders, args.out))
        return result if is_main() else None

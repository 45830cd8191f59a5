"""Runs a function in several connected processes."""

import pickle
import socket
import traceback
from collections.abc import Callable
from datetime import timedelta
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch as th
import torch.distributed as dist

# Seconds; the functions of the tests take a few.
_TIMEOUT = 120


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def _child(rank: int, size: int, folder: Path, function: Callable[[int], Any]) -> None:
    # Threads do not survive a fork.
    th.set_num_threads(1)
    try:
        dist.init_process_group(
            "gloo",
            init_method=f"file://{folder / 'rendezvous'}",
            rank=rank,
            world_size=size,
            timeout=timedelta(seconds=_TIMEOUT),
        )
        result: Any = function(rank)
    except BaseException as error:
        traceback.print_exc()
        result = error
    (folder / f"result_{rank}").write_bytes(pickle.dumps(result))


def run_ranks(size: int, folder: Path, function: Callable[[int], Any]) -> list[Any]:
    """
    :param size: Number of processes
    :param folder: An empty folder
    :param function: Called with the rank in each of them, which are forks of this one
    :return: What it returned; the exception where it failed
    """
    folder.mkdir(parents=True, exist_ok=True)
    context = get_context("fork")
    processes = [context.Process(target=_child, args=(rank, size, folder, function)) for rank in range(size)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(_TIMEOUT)
        if process.is_alive():
            process.kill()
            process.join()
    return [pickle.loads((folder / f"result_{rank}").read_bytes()) for rank in range(size)]

"""Runs a function in several connected processes."""

import os
import pickle
import socket
import sys
import traceback
from collections.abc import Callable
from datetime import timedelta
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path
from typing import Any

import pytest
import torch as th
import torch.distributed as dist

# Seconds; the functions of the tests take a few.
_TIMEOUT = 120


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def _child(rank: int, size: int, folder: Path, function: Callable[[int], Any], port: int | None) -> None:
    # Threads do not survive a fork.
    th.set_num_threads(1)
    if sys.platform == "linux":
        # The name of the machine need not lead to it.
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    try:
        if port is None:
            store = f"file://{folder / 'rendezvous'}"
            timeout = timedelta(seconds=_TIMEOUT)
            dist.init_process_group("gloo", init_method=store, rank=rank, world_size=size, timeout=timeout)
        else:
            numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "LOCAL_WORLD_SIZE": size, "MASTER_PORT": port}
            os.environ.update({"MASTER_ADDR": "127.0.0.1", **{name: str(number) for name, number in numbers.items()}})
        result: Any = function(rank)
    except BaseException as error:
        traceback.print_exc()
        result = error
    (folder / f"result_{rank}").write_bytes(pickle.dumps(result))


def run_ranks(size: int, folder: Path, function: Callable[[int], Any], connected: bool = True) -> list[Any]:
    """
    :param size: Number of processes
    :param folder: An empty folder
    :param function: Called with the rank in each of them, which are forks of this one
    :param connected: Whether they are connected; otherwise they only have the environment variables that torchrun sets
    :return: What it returned; the exception where it failed, None where it was killed
    """
    if "fork" not in get_all_start_methods():
        pytest.skip("these processes are forks")
    folder.mkdir(parents=True, exist_ok=True)
    context = get_context("fork")
    port = None if connected else free_port()
    processes = [context.Process(target=_child, args=(rank, size, folder, function, port)) for rank in range(size)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(_TIMEOUT)
        if process.is_alive():
            process.kill()
            process.join()
    results = [folder / f"result_{rank}" for rank in range(size)]
    return [pickle.loads(path.read_bytes()) if path.is_file() else None for path in results]

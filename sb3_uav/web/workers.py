"""
Processes that work for the server: started ahead, stopped at any moment, replaced at once.

On Linux they are forked from a server process that has imported everything and loaded the networks (see
https://docs.python.org/3/library/multiprocessing.html#contexts-and-start-methods), so a new one is ready within a
moment; elsewhere it takes some seconds.
Messages are JSON, followed by as many blocks of bytes as they announce; nothing is pickled after the start.
"""

from __future__ import annotations

import json
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

PRELOADED = "sb3_uav.web.preload"
# Beside what the imported packages take.
_MEMORY_BYTES = 4 * 2**30
# Given to a process that was told to end, before it is killed.
_PATIENCE = 2.0

#: ``(message, blocks)``
Message = tuple[dict[str, Any], list[bytes]]
Send = Callable[[dict[str, Any], list[bytes]], None]


def send_message(connection: Connection, message: dict[str, Any], blocks: list[bytes]) -> None:
    """
    :param connection: The other side
    :param message: Plain data
    :param blocks: Bytes that go with it
    :raises OSError: If the other side is gone
    """
    connection.send_bytes(json.dumps({**message, "blocks": len(blocks)}).encode())
    for block in blocks:
        connection.send_bytes(block)


def receive_message(connection: Connection) -> Message:
    """
    :param connection: The other side
    :return: What it sent
    :raises EOFError: If the other side is gone
    :raises OSError: Likewise
    """
    message = json.loads(connection.recv_bytes())
    return message, [connection.recv_bytes() for _ in range(message.pop("blocks"))]


class Worker:
    """
    One process, started at once. It does one job after the other.

    :ivar process: The process
    :ivar connection: For :func:`send_message` and :func:`receive_message`; the first message says that it is ready
    """

    def __init__(self) -> None:
        # Not on macOS, whose libraries do not survive a fork.
        if sys.platform == "linux":
            context: Any = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload([PRELOADED])
        else:
            context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_main, args=(theirs,), daemon=True, name="sb3-uav worker")
        self.process.start()
        theirs.close()

    @property
    def waitable(self) -> list[Any]:
        """For :func:`multiprocessing.connection.wait`: the connection, and what becomes ready when the process ends."""
        return [self.connection, self.process.sentinel]

    def end(self) -> None:
        """End the process, whatever it does. May be called from any thread, and twice."""
        if self.process.is_alive():
            self.process.kill()
        self.process.join(_PATIENCE)
        self.connection.close()


def _main(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        # A job may take minutes and say nothing: without this, it would go on when the server is gone.
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    from sb3_uav.web.work import do, warm

    try:
        try:
            warm()
        except Exception as error:
            # The server repeats it to everybody who waits.
            text = f"The solver cannot be started: {type(error).__name__}: {' '.join(str(error).split())[:500]}"
            send_message(connection, {"event": "broken", "error": text}, [])
            return
        _limit_memory()
        send_message(connection, {"event": "ready"}, [])
        while True:
            request, blocks = receive_message(connection)
            _do_one(do, connection, request, blocks)
    except (EOFError, OSError):
        return


def _do_one(do: Callable[..., Message], connection: Connection, request: dict[str, Any], blocks: list[bytes]) -> None:
    def send(message: dict[str, Any], parts: list[bytes]) -> None:
        send_message(connection, message, parts)

    try:
        message, parts = do(request, blocks, send)
    except (ValueError, ImportError) as error:
        message, parts = {"event": "refused", "error": " ".join(str(error).split())[:2000]}, []
    except MemoryError:
        message, parts = {"event": "refused", "error": "This needs more memory than one solve may take; give fewer tasks."}, []
    except (BrokenPipeError, ConnectionError):
        raise
    except Exception as error:
        traceback.print_exc(file=sys.stderr)
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"
        message, parts = {"event": "broken", "error": f"This is a fault of the program, not of your input ({text})."}, []
    send_message(connection, message, parts)


def _end_with(sentinel: Any) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def _limit_memory() -> None:
    """Where the system can do it, let a job that grows without end fail alone."""
    status = Path("/proc/self/statm")
    if not status.exists():
        return
    import resource

    used = int(status.read_text().split()[0]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    limit = used + _MEMORY_BYTES
    if hard == resource.RLIM_INFINITY or limit < hard:
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))

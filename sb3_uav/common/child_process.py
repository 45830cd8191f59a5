"""
Child processes that end with their parent, however that ends.

``python -m sb3_uav.common.child_process MODULE ARGUMENTS`` runs a module, or the script of that path, as Python does. Its
standard input is a pipe that the parent holds open, and that the system closes when the parent is gone.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

# Seconds that an interrupted process gets to end by itself.
_PATIENCE = 10.0
_STDIN = 0
_FAILED = 1


def start_module(words: Sequence[str], **kwargs: Any) -> subprocess.Popen[bytes]:
    """
    :param words: A module, or the path of a script, and its arguments
    :param kwargs: Of ``subprocess.Popen``
    :return: Its process. Ctrl-C on the terminal does not reach it: whoever started it ends it, by :func:`end_all` or by
        ending
    """
    command = [sys.executable, "-m", "sb3_uav.common.child_process", *words]
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True, **kwargs)


def end_all(processes: Sequence[Any]) -> None:
    """
    End processes: ask all of them, and kill those that take too long.

    :param processes: Of ``subprocess`` or ``multiprocessing``
    """
    for process in processes:
        process.terminate()
    last = time.monotonic() + _PATIENCE
    for process in processes:
        wait: Callable[..., Any] = process.wait if isinstance(process, subprocess.Popen) else process.join
        try:
            wait(max(last - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            pass
        # Without effect on one that has ended.
        process.kill()
        wait()


def end_with_parent() -> None:
    """End a process of ``multiprocessing`` when its parent has ended, which otherwise nobody would notice."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch(parent: Any = parent) -> None:
        parent.join()
        os._exit(_FAILED)

    threading.Thread(target=watch, daemon=True, name="end with parent").start()


def _end_with_stdin() -> None:
    while os.read(_STDIN, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_PATIENCE)
    os._exit(_FAILED)


def main(argv: Sequence[str]) -> None:
    """:param argv: Name of a module or path of a script, and its arguments"""
    threading.Thread(target=_end_with_stdin, daemon=True, name="end with parent").start()
    module, *arguments = argv
    sys.argv = [module, *arguments]
    if module.endswith(".py"):
        runpy.run_path(module, run_name="__main__")
    else:
        runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1:])

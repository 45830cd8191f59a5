"""Ctrl-C during a search that cannot be stopped."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_INTERRUPTED = 130


@contextmanager
def ends_at_once(prog: str, clean_up: Callable[[], None] = lambda: None) -> Iterator[None]:
    """
    Let Ctrl-C end the process at once. Compiled code runs in threads until its time is up, and both leaving their pool and
    the end of the interpreter would wait for them. For blocks that leave nothing behind.

    :param prog: Name of the command, which the message begins with
    :param clean_up: Called before, for what a terminal needs
    """

    def leave(*_: Any) -> None:
        clean_up()
        print(f"{prog}: interrupted", file=sys.stderr, flush=True)
        os._exit(_INTERRUPTED)

    # Whoever started the command may have had it ignore Ctrl-C; and only the main thread may say what it does.
    is_ours = (
        threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if is_ours:
        signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)

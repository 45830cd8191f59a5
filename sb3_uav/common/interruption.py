"""Ctrl-C and SIGTERM: both raise KeyboardInterrupt, and the command that was interrupted says how it goes on."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

# As shells report a command that a signal has ended.
_SIGNAL_BASE = 128
_SIGNALS = (signal.SIGINT, signal.SIGTERM)

# The signal that has interrupted the command, if one has.
_received: int | None = None


class Interruption(KeyboardInterrupt):
    """
    An interruption after which it is known how to go on.

    :param words: The command that continues, word by word; none if there is nothing to continue from
    :param changes: Those of its words that the interrupted command did not have
    """

    def __init__(self, words: Sequence[str], changes: Sequence[str] = ()) -> None:
        super().__init__()
        self.words = list(words)
        self.changes = list(changes)


def without_option(arguments: Sequence[str], names: Sequence[str]) -> list[str]:
    """
    :param arguments: Arguments of a command
    :param names: Names of an option that takes one value
    :return: The arguments without it
    """
    kept: list[str] = []
    words = iter(arguments)
    for word in words:
        if word in names:
            next(words, None)
        elif not any(word.startswith(f"{name}=") for name in names):
            kept.append(word)
    return kept


@contextmanager
def continued_by(words: Sequence[str]) -> Iterator[None]:
    """
    Name the command that continues what is interrupted in the ``with`` block.

    :param words: The command, word by word
    :raises Interruption: In place of any KeyboardInterrupt
    """
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interruption(words) from error


def interruption_line(prog: str, words: Sequence[str]) -> str:
    """
    :param prog: Name of the command, which the line begins with
    :param words: The command that continues; none if there is none
    :return: What is said of an interruption
    """
    return f"{prog}: interrupted" + (f"; continue with {shlex.join(words)}" if words else "")


def is_interruption(code: int) -> bool:
    """
    :param code: Exit code of a command
    :return: Whether it was interrupted
    """
    return code - _SIGNAL_BASE in _SIGNALS


def was_received() -> bool:
    """:return: Whether a signal has interrupted this command"""
    return _received is not None


def exit_code() -> int:
    """:return: That of an interrupted command: 143 after SIGTERM, 130 after Ctrl-C"""
    return _SIGNAL_BASE + (signal.SIGINT if _received is None else _received)


@contextmanager
def interruptible() -> Iterator[None]:
    """
    Let Ctrl-C and SIGTERM raise KeyboardInterrupt in the ``with`` block, and the same signal end the process at once when it
    comes again.

    A signal that is ignored remains so: whoever started the command, such as ``nohup``, chose that. Inside another such block,
    and outside the main thread, nothing changes.
    """
    global _received
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours = [number for number in _SIGNALS if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)]
    former = {number: signal.signal(number, _interrupt) for number in ours}
    if former:
        _received = None
    try:
        with _second_ends_compiled_code() if former else nullcontext():
            yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def _second_ends_compiled_code() -> Iterator[None]:
    """
    End the process by the second signal of a kind even while compiled code, such as an exact solver, keeps the main thread
    busy, and Python has not answered the first one. https://docs.python.org/3/library/signal.html#signal.set_wakeup_fd
    """
    if sys.platform == "win32":
        # Which takes sockets only there.
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def watch() -> None:
        seen: set[int] = set()
        while received := os.read(reader, 1):
            number = received[0]
            if number in seen and signal.getsignal(number) is _interrupt:
                os._exit(_SIGNAL_BASE + number)
            seen.add(number)

    thread = threading.Thread(target=watch, daemon=True, name="second signal")
    thread.start()
    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(writer)
        thread.join()
        os.close(reader)


def _interrupt(number: int, _frame: Any) -> None:
    global _received
    signal.signal(number, signal.SIG_DFL)
    if _received is None:
        # The other signal, which launchers send after Ctrl-C, does not disturb the end that the first one began.
        _received = number
        raise KeyboardInterrupt


@contextmanager
def ends_at_once(prog: str, clean_up: Callable[[], None] = lambda: None, words: Sequence[str] = ()) -> Iterator[None]:
    """
    Let Ctrl-C and SIGTERM end the process at once. Compiled code runs in threads until its time is up, and both leaving their
    pool and the end of the interpreter would wait for them. For blocks that leave nothing behind.

    :param prog: Name of the command, which the message begins with
    :param clean_up: Called before, for what a terminal needs
    :param words: The command that starts over
    """

    def leave(number: int, _frame: Any) -> None:
        clean_up()
        print(interruption_line(prog, words), file=sys.stderr, flush=True)
        os._exit(_SIGNAL_BASE + number)

    former: dict[signal.Signals, Any] = {}
    # Only the main thread may say what signals do.
    if threading.current_thread() is threading.main_thread():
        found = {number: signal.getsignal(number) for number in _SIGNALS}
        former = {number: handler for number, handler in found.items() if handler in (_interrupt, signal.default_int_handler)}
    for number in former:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)

"""Error handling of all commands: one line on the standard error and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from sb3_uav.common.interruption import Interruption, exit_code, interruptible, interruption_line

_LONGEST_MESSAGE = 3000
_OK, _USER_ERROR = 0, 2


def run_command(prog: str, function: Callable[[], int | None]) -> int:
    """
    Run a command and report its errors in one line, as argparse reports a wrong argument.

    :param prog: Name of the command, which the line begins with
    :param function: The command; None stands for the exit code 0
    :return: Exit code: that of the command (0 on success), 2 if the input was wrong, 130 after Ctrl-C, 143 after
        SIGTERM
    """
    try:
        with interruptible():
            return function() or _OK
    except (ValueError, OSError, ImportError) as error:
        print(f"{prog}: error: {_shortened(' '.join(str(error).split()))}", file=sys.stderr)
        return _USER_ERROR
    except KeyboardInterrupt as error:
        print(interruption_line(prog, error.words if isinstance(error, Interruption) else ()), file=sys.stderr)
        return exit_code()


def _shortened(text: str) -> str:
    """:return: A message without its middle, where it quotes more of a file than anybody reads; its end says what to do"""
    return text if len(text) <= _LONGEST_MESSAGE else f"{text[: _LONGEST_MESSAGE // 2]} ... {text[-_LONGEST_MESSAGE // 2 :]}"


def main_function(prog: str, function: Callable[[Sequence[str]], int | None]) -> Callable[..., int]:
    """
    :param prog: Name of a command
    :param function: Takes its arguments
    :return: Its main function, which takes the arguments of the process when they are None, and returns an exit code
    """

    def main(argv: Sequence[str] | None = None) -> int:
        return run_command(prog, lambda: function(list(sys.argv[1:] if argv is None else argv)))

    return main

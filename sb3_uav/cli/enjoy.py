"""``sb3-uav enjoy``: rl_zoo3's replay of a trained agent."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments, those of ``rl_zoo3.enjoy``
    :return: Exit code 0
    :raises ValueError: If there is no such agent, or another argument is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that replays need is not installed
    """
    from sb3_uav.zoo.enjoy import enjoy

    enjoy(argv)
    return 0

"""``sb3-uav push-to-hub``."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments of the command
    :return: Exit code 0
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that the command needs is not installed
    """
    from sb3_uav.zoo.push_to_hub import push_to_hub

    push_to_hub(argv)
    return 0

"""``sb3-uav record-video``."""

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
    from sb3_uav.zoo.record_video import record_video

    record_video(argv)
    return 0

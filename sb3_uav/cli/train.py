"""``sb3-uav train``: rl_zoo3's training with our algorithms, environments and YAMLs."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments, those of ``rl_zoo3.train``
    :return: Exit code 0
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that training needs is not installed
    """
    from sb3_uav.zoo.train import train

    train(argv)
    return 0

"""The origin that every file states."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass

from sb3_uav.evaluation.provenance import describe_machine
from sb3_uav.reproduce.paper import paper_tables
from sb3_uav.reproduce.scales import Scale

_KEYS = ("Command", "Scale", "Seed", "Versions", "Machine", "Figures of the paper")


@dataclass(frozen=True)
class Origin:
    """
    :param lines: A line for each of :data:`_KEYS`
    """

    lines: tuple[str, ...]

    @classmethod
    def of(cls, command: str, scale: Scale, seed: int) -> Origin:
        """
        :param command: The command line
        :param scale: The scale
        :param seed: The seed
        :return: These, with the versions and the machine of this process
        """
        versions = ", ".join(f"{package} {version}" for package, version in describe_machine()["versions"].items())
        texts = (
            command,
            f"{scale.name}, {scale.text}",
            str(seed),
            versions,
            # Only what is needed to interpret times: neither the kernel version nor the name of the machine.
            f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs",
            paper_tables()["source"],
        )
        return cls(tuple(f"{key}: {text}" for key, text in zip(_KEYS, texts, strict=True)))

    @classmethod
    def read(cls, comments: Sequence[str]) -> tuple[Origin, list[str]]:
        """
        :param comments: Comments of a table, in the order in which they were written
        :return: The origin among them, and the others
        :raises ValueError: If they do not begin with the origin
        """
        lines, others = comments[: len(_KEYS)], comments[len(_KEYS) :]
        if [line.partition(": ")[0] for line in lines] != list(_KEYS):
            raise ValueError(f"its comments do not begin with {', '.join(_KEYS)}")
        return cls(tuple(lines)), list(others)

    def __getitem__(self, key: str) -> str:
        """
        :param key: One of :data:`_KEYS`
        :return: What its line says
        """
        return self.lines[_KEYS.index(key)].partition(": ")[2]

    def metadata(self, suffix: str) -> dict[str, str | None]:
        """
        :param suffix: Of a picture
        :return: The same under the keys that its format has, without the time, so that equal data give equal files
        """
        title, text = self["Command"], " | ".join(self.lines)
        return (
            {"Title": title, "Subject": text, "CreationDate": None}
            if suffix == ".pdf"
            else {"Title": title, "Description": text}
        )

    def footer(self) -> str:
        """:return: The line at the bottom of a picture"""
        return f"sb3-uav reproduce, scale {self['Scale'].partition(',')[0]}, seed {self['Seed']}"

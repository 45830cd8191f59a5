"""Shards: the part of every set of instances that one process or machine evaluates."""

from __future__ import annotations

import re
from typing import NamedTuple


class Shard(NamedTuple):
    """
    One of several parts of an evaluation. Every set of instances is cut into as many blocks of consecutive rows.

    :param number: Number of the part, from 1
    :param parts: Number of parts
    """

    number: int = 1
    parts: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """
        :param text: ``i/n``, such as ``2/4``
        :return: The shard
        :raises ValueError: If it is something else
        """
        found = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise ValueError(f"The shard is {text!r}; give i/n with i from 1 to n, such as 1/4 for the first of four.")
        return cls(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.parts}"

    @property
    def is_whole(self) -> bool:
        """Whether this is all there is."""
        return self.parts == 1

    def rows(self, n_rows: int) -> range:
        """
        :param n_rows: Number of instances of a set
        :return: Those of this shard; possibly none
        """
        return range((self.number - 1) * n_rows // self.parts, self.number * n_rows // self.parts)

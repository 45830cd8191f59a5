"""The work of every browser, so that a reload loses nothing."""

from __future__ import annotations

import secrets
import threading
import zlib
from collections import OrderedDict


class Sessions:
    """
    Safe to use from any thread.

    :param most: Sessions that are kept; the one that was not used for longest is dropped
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._drafts: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._drafts)

    def open(self, name: str) -> str:
        """
        :param name: Id that the browser has sent, possibly empty
        :return: The same if it is known, a new one otherwise
        """
        with self._lock:
            if name in self._drafts:
                self._drafts.move_to_end(name)
                return name
            name = secrets.token_urlsafe(24)
            self._drafts[name] = b""
            while len(self._drafts) > self._most:
                self._drafts.popitem(last=False)
            return name

    def load(self, name: str) -> bytes | None:
        """:return: The draft of a session as JSON; None if there is none yet"""
        with self._lock:
            packed = self._drafts.get(name)
        return zlib.decompress(packed) if packed else None

    def save(self, name: str, draft: bytes) -> None:
        """
        :param name: An open session
        :param draft: JSON
        """
        packed = zlib.compress(draft, 1)
        with self._lock:
            if name in self._drafts:
                self._drafts[name] = packed

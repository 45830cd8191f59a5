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

    def load(self, name: str) -> bytes | None:
        """
        :param name: Id that the browser has sent, possibly empty
        :return: Its draft as JSON; None if there is none
        """
        with self._lock:
            packed = self._drafts.get(name)
            if packed is not None:
                self._drafts.move_to_end(name)
        return None if packed is None else zlib.decompress(packed)

    def save(self, name: str, draft: bytes) -> str:
        """
        :param name: Id that the browser has sent, possibly empty
        :param draft: JSON
        :return: The same id if it is known, a new one otherwise: nobody can choose the id of somebody else
        """
        packed = zlib.compress(draft, 1)
        with self._lock:
            if name not in self._drafts:
                name = secrets.token_urlsafe(24)
            self._drafts[name] = packed
            self._drafts.move_to_end(name)
            while len(self._drafts) > self._most:
                self._drafts.popitem(last=False)
        return name

"""The callbacks of a training, which are nested in lists and in event callbacks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback

CallbackT = TypeVar("CallbackT", bound=BaseCallback)


def walk_callbacks(callback: Any) -> Iterator[BaseCallback]:
    """
    :param callback: A callback or None
    :return: The callback and all callbacks inside it
    """
    if isinstance(callback, CallbackList):
        for child in callback.callbacks:
            yield from walk_callbacks(child)
    elif isinstance(callback, BaseCallback):
        yield callback
        if isinstance(callback, EventCallback):
            yield from walk_callbacks(callback.callback)


def siblings(callback: BaseCallback, kind: type[CallbackT]) -> list[CallbackT]:
    """
    :param callback: A callback whose training has started
    :param kind: A class
    :return: The other callbacks of this class in the same training
    """
    found = walk_callbacks(callback.locals.get("callback"))
    return [other for other in found if isinstance(other, kind) and other is not callback]

"""Plain data from pickles of strangers: numbers, strings, containers, and what the caller makes of the names it allows."""

from __future__ import annotations

import pickletools
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

# Their largest size and number of operations. Those of the shipped networks have 40 kB and 6,000.
MAX_BYTES, MAX_OPERATIONS = 2 * 2**20, 250_000
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_NUMBERS = {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
_TEXTS = {"BINUNICODE", "SHORT_BINUNICODE"}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3, "TUPLE": -1}
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "MARK": lambda: _Mark}
_FILLS = {"APPEND", "APPENDS", "SETITEM", "SETITEMS", "BUILD"}
_PUTS, _GETS = {"BINPUT", "LONG_BINPUT", "MEMOIZE"}, {"BINGET", "LONG_BINGET"}


class Name(NamedTuple):
    """A class or function that a pickle names. It is not imported."""

    module: str
    name: str


class _Mark:
    """Where the items of a container begin on the stack."""


class NotPlainError(ValueError):
    """What a pickle holds beside plain data."""


class PlainPickle:
    """
    A walk through the operations of a pickle. Nothing is imported; a name can only be called if the caller gives a function.

    :param calls: What stands for the classes and functions that may be called, by module and name
    :param persistent: Makes an object of a persistent id; None if there may be none
    """

    def __init__(self, calls: Mapping[Name, Callable[..., Any]], persistent: Callable[[Any], Any] | None = None) -> None:
        self._calls = calls
        self._persistent = persistent

    def load(self, content: bytes) -> Any:
        """
        :param content: A pickle
        :return: What it holds
        :raises NotPlainError: If it is damaged, too large, or holds more than plain data
        """
        if len(content) > MAX_BYTES:
            raise NotPlainError(f"its pickle has {len(content)} bytes, more than the {MAX_BYTES} that are read")
        try:
            return self._walk(content)
        except NotPlainError:
            raise
        except (ValueError, LookupError, TypeError, AttributeError, OverflowError, UnicodeError) as error:
            raise NotPlainError(f"its pickle is damaged: {error!s:.100}") from error

    def _walk(self, content: bytes) -> Any:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}
        for number, (operation, argument, _) in enumerate(pickletools.genops(content)):
            name: str = operation.name
            if number >= MAX_OPERATIONS:
                raise NotPlainError(f"its pickle has more than {MAX_OPERATIONS} operations")
            if name == "STOP":
                return self._stack[-1]
            if name in _PUTS:
                self._memo[len(self._memo) if argument is None else int(argument)] = self._stack[-1]
            elif name in _FILLS:
                self._fill(name)
            elif name not in ("PROTO", "FRAME"):
                self._stack.append(self._value(name, argument))
        raise NotPlainError("its pickle has no end")

    def _value(self, name: str, argument: Any) -> Any:
        """:return: What an operation puts on the stack"""
        if name in _GETS:
            return self._memo[argument]
        if name in _NUMBERS or name in _TEXTS:
            return argument
        if name in _CONSTANTS:
            return _CONSTANTS[name]
        if name in _TUPLES:
            return tuple(self._since_mark() if name == "TUPLE" else self._pop(_TUPLES[name]))
        if name in _EMPTY:
            return _EMPTY[name]()
        if name in ("GLOBAL", "STACK_GLOBAL"):
            module, called = argument.split(" ") if name == "GLOBAL" else self._pop(2)
            return Name(str(module), str(called))
        if name == "REDUCE":
            return self._call(*self._pop(2))
        if name == "BINPERSID" and self._persistent is not None:
            return self._persistent(*self._pop(1))
        raise NotPlainError(f"its pickle has the operation {name}, which plain data do not need")

    def _fill(self, name: str) -> None:
        """Put values of the stack into the container below them."""
        values = self._since_mark() if name in ("APPENDS", "SETITEMS") else self._pop(2 if name == "SETITEM" else 1)
        target = self._stack[-1]
        if name in ("APPEND", "APPENDS"):
            if not isinstance(target, list | deque):
                raise NotPlainError("its pickle appends to what is no list")
            target.extend(values)
        elif not isinstance(target, dict):
            raise NotPlainError("its pickle sets items or attributes of what is no dictionary")
        elif name != "BUILD":
            # The attributes of an ordered dictionary, such as versions of modules, are not data.
            self._set_items(target, values)

    def _pop(self, number: int) -> list[Any]:
        """The last values of the stack, which are removed."""
        if number == 0:
            return []
        values = self._stack[-number:]
        if len(values) < number or any(value is _Mark for value in values):
            raise NotPlainError("its pickle is damaged: a value is missing")
        del self._stack[-number:]
        return values

    def _since_mark(self) -> list[Any]:
        values: list[Any] = []
        while (value := self._stack.pop()) is not _Mark:
            values.append(value)
        return values[::-1]

    def _set_items(self, target: dict[Any, Any], items: list[Any]) -> None:
        for key, value in zip(items[::2], items[1::2], strict=True):
            # Nothing else, as the hash of a deep tuple would exhaust the stack of the processor.
            if not isinstance(key, str | int):
                raise NotPlainError(f"its pickle has a key of type {type(key).__name__}")
            target[key] = value

    def _call(self, called: Any, arguments: Any) -> Any:
        if not isinstance(called, Name) or not isinstance(arguments, tuple):
            raise NotPlainError("its pickle calls what is no function")
        if called not in self._calls:
            raise NotPlainError(f"its pickle calls {called.module:.60}.{called.name:.60}, which is not executed here")
        return self._calls[called](*arguments)

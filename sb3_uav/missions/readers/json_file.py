"""JSON of strangers: values of known types, or an error that says where and what to do."""

from __future__ import annotations

import json
import math
import reprlib
import unicodedata
from typing import Any, NoReturn

_LONGEST_ID = 200
# Values that a file may have, each of which takes many times its bytes once read. A file of 100,000 tasks has half as many.
_MOST_VALUES = 3_000_000
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 40
_SHORT.maxlist = _SHORT.maxdict = 4
_SHORT.maxlevel = 2


def decode_utf8(data: bytes, source: str) -> str:
    """
    :param data: A text file, possibly with a byte order mark
    :param source: Its name, for errors
    :return: The text
    :raises ValueError: If it is not UTF-8
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{source}: byte {error.start} is not UTF-8; save the file as UTF-8 text.") from error


def parse_json(data: bytes, source: str) -> dict[str, Any]:
    """
    :param data: The file
    :param source: Its name, for errors
    :return: The object that it holds
    :raises ValueError: If it is not an object of JSON in UTF-8, or has NaN, infinity or endless digits, which JSON has not
    """

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no number of JSON")

    text = decode_utf8(data, source)
    if text.count(",") >= _MOST_VALUES:
        raise ValueError(f"{source}: the file has more than {_MOST_VALUES} values; divide it.")
    try:
        content = json.loads(text, parse_constant=refuse)
    except RecursionError as error:
        raise ValueError(f"{source}: lists or objects are nested too deeply; this is no file of tasks.") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"{source}: this is not JSON ({error}).") from error
    except ValueError as error:
        # Python refuses to read thousands of digits, for the time that it would take.
        what = error if "JSON" in str(error) else "a number has thousands of digits"
        raise ValueError(f"{source}: this is not JSON ({what}).") from error
    if not isinstance(content, dict):
        raise ValueError(f"{source}: there is {shown(content)} where an object of JSON is expected.")
    return content


def shown(value: Any) -> str:
    """:return: A value as it may stand in an error, however large it is"""
    return {"None": "null", "True": "true", "False": "false"}.get(text := _SHORT.repr(value), text)


def number_of(value: Any, what: str, where: str, least: float = -math.inf) -> float:
    """
    :param value: A value of JSON
    :param what: Its name, for errors
    :param where: File and place, for errors
    :param least: The smallest that is allowed
    :return: The number
    :raises ValueError: If it is none, not finite or too small
    """
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{where}: {what} is {shown(value)}; write a finite number.")
    if number < least:
        raise ValueError(f"{where}: {what} is {shown(value)}; write {least:g} or more.")
    return number


def whole_of(value: Any, what: str, where: str) -> int:
    """
    :param value: A value of JSON
    :param what: Its name, for errors
    :param where: File and place, for errors
    :return: The whole number
    :raises ValueError: If it is none, or negative
    """
    number = number_of(value, what, where, 0.0)
    if not number.is_integer():
        raise ValueError(f"{where}: {what} is {shown(value)}; write a whole number.")
    return int(number)


def flag_of(value: Any, what: str, where: str) -> bool:
    """
    :param value: A value of JSON; many systems have no flags and write 0 and 1
    :param what: Its name, for errors
    :param where: File and place, for errors
    :return: Whether it is set; no for null
    :raises ValueError: If it is something else
    """
    if value is None or isinstance(value, bool):
        return bool(value)
    if isinstance(value, int | float) and value in (0, 1):
        return value == 1
    raise ValueError(f"{where}: {what} is {shown(value)}; write true or false.")


def id_of(value: Any, what: str, where: str) -> str:
    """
    :param value: A value of JSON
    :param what: Its name, for errors
    :param where: File and place, for errors
    :return: It as the name of a task
    :raises ValueError: If it is no text that every file format can hold, and no number
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        number = number_of(value, what, where)
        return str(value) if isinstance(value, int) else repr(int(number)) if number.is_integer() else repr(number)
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{where}: {what} is {shown(value)}; write a text or a number.")
    if len(value) > _LONGEST_ID or any(unicodedata.category(letter) in ("Cc", "Cs") for letter in value):
        raise ValueError(f"{where}: {what} is {shown(value)}; write at most {_LONGEST_ID} letters, no control characters.")
    return value

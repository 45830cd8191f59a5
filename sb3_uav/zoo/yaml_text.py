"""Reading YAML that may be damaged or hostile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from sb3_uav.common.regular_file import open_regular

# The zoo's own files have a few thousand values in 40 KiB. PyYAML makes 50,000 values a second.
_MOST_BYTES = 2**18
_MOST_WRITTEN, _MOST_VALUES = 20_000, 100_000
# Of a number: those to the base of 60 (`1:1:1`) take time that grows with the square of their length.
_MOST_DIGITS = 100
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_MOST_DEPTH = 50


def load_yaml(path: Path, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """
    :param path: A YAML file
    :param loader: A safe loader
    :return: Its content
    :raises ValueError: If it cannot be read, or aliases make it endless or huge; the message names the file
    """
    try:
        with open_regular(path) as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise ValueError(f"it has more than {_MOST_BYTES} bytes")
        reader = _limited(loader(data.decode("utf-8")))
        try:
            node = reader.get_single_node()
            if node is None:
                return None
            # Before anything is made of them: each merge of an alias (`<<: *name`) copies it.
            _count(node, {}, 0)
            return reader.construct_document(node)
        finally:
            reader.dispose()
    except Exception as error:
        # Beside YAMLError and ValueError (no UTF-8, dates that do not exist), PyYAML raises whatever its conversions raise:
        # KeyError for `!!bool no`, AttributeError for `!!timestamp x`, RecursionError for brackets without end.
        found = str(error) if isinstance(error, yaml.YAMLError | ValueError | OSError) else repr(error)
        raise ValueError(f"{path}: cannot be read as YAML: {found:.1000}") from error


def _limited(reader: yaml.SafeLoader) -> yaml.SafeLoader:
    """
    :param reader: A loader that has not begun
    :return: The same, which stops at the first value too many
    """
    compose, found = reader.compose_node, 0

    def counted(*place: Any) -> yaml.Node | None:
        nonlocal found
        found += 1
        if found > _MOST_WRITTEN:
            raise ValueError(f"it has more than {_MOST_WRITTEN} values")
        return compose(*place)

    # Of this object only, as the class of loader is the caller's.
    vars(reader)["compose_node"] = counted
    return reader


def _count(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """
    :param node: A node
    :param known: Sizes of nodes by identity; 0 of those that are being counted
    :param depth: How many nodes it is in
    :return: The number of values of the node, with aliases written out
    :raises ValueError: If there are too many, or the node contains itself
    """
    found = known.get(id(node))
    if found == 0:
        raise ValueError("an alias stands inside of what it names")
    if found is not None:
        return found
    if depth > _MOST_DEPTH:
        raise ValueError("lists or mappings are nested too deeply")
    known[id(node)] = 0
    total = 1
    if isinstance(node, yaml.ScalarNode) and node.tag in _NUMBERS and len(node.value) > _MOST_DIGITS:
        raise ValueError(f"a number has {len(node.value)} digits, more than the {_MOST_DIGITS} that are read")
    if isinstance(node, yaml.CollectionNode):
        for item in node.value:
            total += sum(_count(part, known, depth + 1) for part in (item if isinstance(item, tuple) else (item,)))
    if total > _MOST_VALUES:
        raise ValueError(f"aliases written out, it has more than {_MOST_VALUES} values")
    known[id(node)] = total
    return total

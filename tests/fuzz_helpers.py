"""The scripts of the fuzz run, as modules."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

FOLDER = str(Path(__file__).parents[1] / "benchmarks")


def fuzz_module(name: str = "fuzz") -> Any:
    """:return: A script of the folder ``benchmarks``"""
    sys.path.insert(0, FOLDER)
    try:
        return import_module(name)
    finally:
        sys.path.remove(FOLDER)

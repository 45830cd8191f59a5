"""Optional packages: what is said where one is missing."""

from __future__ import annotations

import re
import shlex
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

import sb3_uav
from sb3_uav.common import optional
from sb3_uav.common.optional import install_command, require


def test_a_package_that_is_there() -> None:
    assert require("shlex", "This test", "solvers") is shlex


def test_advice_works_from_a_checkout_in_any_folder() -> None:
    """pip finds the project, and the extra in it, by the path: the package is on no index."""
    *command, target = shlex.split(install_command("solvers"))
    assert command == ["pip", "install", "-e"]
    found = re.fullmatch(r"(.*)\[solvers\]", target)
    assert found is not None and (Path(found[1]) / "sb3_uav" / "version.txt").read_text().strip() == sb3_uav.__version__
    assert "solvers" in distribution("sb3-uav").metadata.get_all("Provides-Extra", [])


def test_advice_without_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optional, "ROOT", tmp_path)
    assert install_command("plots") == "pip install 'sb3-uav[plots]'"


def test_advice_for_a_folder_with_spaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "my projects"
    root.mkdir()
    for name in ("pyproject.toml", "setup.cfg"):
        (root / name).touch()
    monkeypatch.setattr(optional, "ROOT", root)
    assert shlex.split(install_command("zoo")) == ["pip", "install", "-e", f"{root}[zoo]"]


def test_a_package_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "a_missing_package", None)
    with pytest.raises(ImportError) as error:
        require("a_missing_package", "Solver milp", "solvers")
    assert str(error.value).startswith("Solver milp needs a_missing_package (")
    assert str(error.value).endswith(f"; run: {install_command('solvers')}")

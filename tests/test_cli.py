"""The command ``sb3-uav``: its help, its commands and their exit codes."""

from __future__ import annotations

import importlib
import sys
import types
from typing import Any

import pytest

import sb3_uav
from sb3_uav.cli import main as cli


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    for option, text in (("--version", f"sb3-uav {sb3_uav.__version__}\n"), ("--help", "evaluate zips and solvers")):
        with pytest.raises(SystemExit) as stop:
            cli.main([option])
        assert stop.value.code == 0
        assert text in capsys.readouterr().out


def test_unknown_command_names_the_choices(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fly"])
    assert stop.value.code == 2
    assert "evaluate" in capsys.readouterr().err


@pytest.mark.parametrize("argv", [[], ["--"], ["--", "evaluate"], ["--nonsense"]])
def test_no_command(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(argv)
    assert stop.value.code == 2 and "sb3-uav: error: " in capsys.readouterr().err


@pytest.mark.parametrize("command", sorted(cli._FORWARDED))
def test_forwarded_commands(command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Everything after the command reaches its own parser, options included; its exit code comes back."""
    name, _, function = cli._FORWARDED[command][0].partition(":")
    module = types.ModuleType(name)
    received: list[Any] = []

    def main(argv: list[str]) -> int | None:
        received.append(argv)
        if "fail" in argv:
            raise FileNotFoundError("no\nsuch file")
        return 3 if "three" in argv else None

    setattr(module, function, main)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    assert cli.main([command, "--help", "-f", "x", "three"]) == 3
    assert cli.main([command]) == 0
    assert received == [["--help", "-f", "x", "three"], []]
    assert cli.main([command, "fail"]) == 2
    assert capsys.readouterr().err == f"sb3-uav {command}: error: no such file\n"


@pytest.mark.parametrize("command", cli._FORWARDED)
def test_commands_exist(command: str) -> None:
    """What a command names can be called."""
    pytest.importorskip("rl_zoo3")
    name, _, function = cli._FORWARDED[command][0].partition(":")
    assert callable(getattr(importlib.import_module(name), function))

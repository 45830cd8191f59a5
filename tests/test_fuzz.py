"""
The short form of ``benchmarks/fuzz.py``: damaged files of every format end in a result, or in an error that names the file.

The long form is in ``docs/fuzzing.md``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fuzz_helpers import fuzz_module

pytest.importorskip("rl_zoo3")
pytest.importorskip("pydantic")
pytest.importorskip("vrplib")

N_CASES = 200
# Of readers that run trainings, and evaluations.
N_SLOW_CASES = {
    "YAML configs, trained": 4,
    "results.csv": 60,
    "schedules.jsonl": 60,
    "evaluation.json": 60,
    "policy zips": 100,
}


@pytest.fixture(scope="module")
def fuzz() -> Any:
    return fuzz_module()


@pytest.fixture(scope="module")
def readers() -> list[Any]:
    return fuzz_module("_fuzz_readers").all_readers()


def test_no_case_ends_in_a_traceback(fuzz: Any, readers: list[Any], tmp_path: Path) -> None:
    failures = [
        failure for reader in readers for failure in fuzz.short_run(reader, N_SLOW_CASES.get(reader.name, N_CASES), tmp_path)
    ]
    assert failures == []


def test_valid_files_are_accepted(fuzz: Any, readers: list[Any], tmp_path: Path) -> None:
    """Otherwise nothing but the first check of a reader would be tried."""
    for reader in readers:
        # Solvers of files that are not there, and uploads under the name of another format, are refused, and say so.
        if reader.name not in ("solver specs", "web uploads"):
            outcomes = [fuzz.run_case(reader, content, tmp_path / "folder") for content in reader.corpus]
            assert all(fault is None and accepted for fault, _, accepted in outcomes), reader.name


def test_cases_are_the_same_in_every_run(fuzz: Any, readers: list[Any]) -> None:
    for reader in readers[:4]:
        assert [fuzz.case_data(reader, 3, number) for number in range(5)] == [
            fuzz.case_data(reader, 3, number) for number in range(5)
        ]


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (KeyError("x"), "KeyError: 'x'"),
        (RecursionError("deep"), "RecursionError: deep"),
        (SystemExit(1), "SystemExit: 1"),
        (ValueError("wrong"), "the message of ValueError does not name 'its_state.json': wrong"),
        (ValueError("its_state.json " + "a" * 9999), "the message has 10014 characters"),
        (ValueError("its_state.json: wrong"), None),
        (FileNotFoundError("its_state.json: missing"), None),
    ],
)
def test_what_counts_as_a_failure(fuzz: Any, tmp_path: Path, error: BaseException, fault: str | None) -> None:
    reader = _reader(error)
    assert fuzz.run_case(reader, b"{}", tmp_path / "folder")[0] == fault


def test_a_case_that_takes_too_long_fails(fuzz: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "MOST_SECONDS", 0.05)

    def spin(path: Path) -> None:
        try:
            while True:
                pass
        except Exception as error:
            raise ValueError(path) from error

    reader = _reader(None)
    reader.read = spin
    assert "more than 0.05 s" in fuzz.run_case(reader, b"{}", tmp_path / "folder")[0]


def test_a_killed_process_is_a_failure_and_the_rest_still_runs(fuzz: Any, tmp_path: Path, capfd: Any) -> None:
    """As after a crash in the code of a library; the state then says where to go on."""
    import os
    import signal

    figures, reader = fuzz.new_figures(), _reader(None)
    third = fuzz.case_data(reader, 0, 2)

    def read(path: Path) -> None:
        if path.read_bytes() == third:
            os.kill(os.getpid(), signal.SIGKILL)

    reader.read = read
    while figures["done"] < 6:
        fuzz.run_in_process(reader, 0, 6, figures, tmp_path)
    assert figures["done"] == 6
    assert len(figures["failures"]) == 1 and "case 2: the process ended with 9" in figures["failures"][0]
    assert len(list((tmp_path / "failures").iterdir())) == 1
    assert "case 2" in capfd.readouterr().out


def test_failures_are_made_shorter(fuzz: Any, tmp_path: Path) -> None:
    def read(path: Path) -> None:
        json.loads(path.read_bytes() and '{"a": 1}')
        if b"!" in path.read_bytes():
            raise KeyError("!")

    reader = _reader(None)
    reader.read = read
    assert fuzz.minimized(reader, b"a" * 500 + b"!" + b"b" * 300, "KeyError: '!'", tmp_path / "folder") == b"!"


def _reader(error: BaseException | None) -> Any:
    module = fuzz_module("_fuzz_readers")

    def read(path: Path) -> None:
        if error is not None:
            raise error

    content = json.dumps({"epoch": 1, "records": [1, 2, 3]}).encode()
    return module.Reader("its_state.json", 1, "its_state.json", [content], module.mutations.json_changed, read)

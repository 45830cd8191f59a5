"""Ctrl-C and SIGTERM: one line with the command that continues, an exit code, and nothing that looks final."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sb3_uav.common.errors import run_command
from sb3_uav.common.interruption import Interruption, continued_by, interruptible, without_option

HANDLED = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(autouse=True)
def signals_as_on_a_terminal() -> Iterator[None]:
    former = {number: signal.getsignal(number) for number in HANDLED}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    for number, handler in former.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_both_signals_end_a_command_with_a_line_and_a_code(
    number: signal.Signals, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    def work() -> None:
        with continued_by(["sb3-uav", "work", "a b.npz"]):
            signal.raise_signal(number)

    assert run_command("sb3-uav work", work) == code
    assert capsys.readouterr() == ("", "sb3-uav work: interrupted; continue with sb3-uav work 'a b.npz'\n")
    # The next command of the process is not interrupted, and a KeyboardInterrupt without a signal is Ctrl-C.
    assert run_command("sb3-uav work", lambda: None) == 0
    assert run_command("sb3-uav work", raise_interrupt) == 130
    assert capsys.readouterr().err == "sb3-uav work: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def raise_interrupt(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


def test_the_second_signal_of_a_kind_ends_the_process() -> None:
    """The system does that, whatever the process is busy with; the other kind does not disturb the end."""
    with interruptible():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
        signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a lock that is zero bytes")
def test_the_second_signal_ends_compiled_code_too() -> None:
    """Python's handlers wait until the main thread leaves it, which here would be never."""
    script = """
import ctypes, os, signal, threading, time
from sb3_uav.common.interruption import interruptible
signal.signal(signal.SIGINT, signal.default_int_handler)
def twice():
    for _ in range(2):
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)
with interruptible():
    threading.Thread(target=twice, daemon=True).start()
    lock = ctypes.create_string_buffer(64)
    for _ in range(2):
        ctypes.CDLL(None).pthread_mutex_lock(lock)
"""
    assert subprocess.run([sys.executable, "-c", script], check=False, timeout=60).returncode == 130


def test_ignored_signals_stay_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruptible():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_only_the_outer_block_handles_signals() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        with interruptible():
            pass
        signal.raise_signal(signal.SIGTERM)


def test_arguments_without_an_option() -> None:
    words = ["--env", "E", "-i", "a.zip", "--trained-agent=b.zip", "-f", "logs"]
    assert without_option(words, ("-i", "--trained-agent")) == ["--env", "E", "-f", "logs"]


# -------------------------------------------------------------------------------------------------------------- trainings


def at_call(number: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which is interrupted at its n-th call."""
    calls: list[None] = []

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        calls.append(None)
        if len(calls) == number:
            signal.raise_signal(signal.SIGINT)
        return function(*args, **kwargs)

    return interrupted


def continuation(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The command that the last line of the standard error names."""
    line = capsys.readouterr().err.splitlines()[-1]
    assert ": interrupted; continue with " in line
    return shlex.split(line.split("; continue with ")[1])


@pytest.mark.slow
def test_a_training_continues_with_the_command_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    from tiny_zoo import ENV, run, write_config

    from sb3_uav.cli.main import main
    from sb3_uav.training import its

    config, logs = write_config(tmp_path), tmp_path / "logs" / "reinforce"
    with monkeypatch.context() as patch:
        # While the state of epoch 0 is there, and the zips of epoch 1 are not.
        patch.setattr(its, "write_checkpoint", at_call(2, its.write_checkpoint))
        assert run(tmp_path, config, "--eval-freq", "-1") == 130
    assert not (logs / f"{ENV}_1" / f"{ENV}.zip").exists()
    words = continuation(capsys)
    assert words[:2] == ["sb3-uav", "train"]
    assert words[-2:] == ["-i", str(logs / f"{ENV}_1" / "its_checkpoint" / "allocator_0.zip")]
    # Once more, before anything new is saved: the same command continues.
    with monkeypatch.context() as patch:
        patch.setattr(its, "write_checkpoint", at_call(1, its.write_checkpoint))
        assert main(words[1:]) == 130
    assert continuation(capsys) == words
    assert main(words[1:]) == 0
    assert (logs / f"{ENV}_3" / f"{ENV}.zip").is_file()


@pytest.mark.slow
def test_a_training_without_a_checkpoint_names_no_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    from tiny_zoo import run, write_config

    from sb3_uav.training import its

    monkeypatch.setattr(its, "write_checkpoint", at_call(1, its.write_checkpoint))
    assert run(tmp_path, write_config(tmp_path), "--eval-freq", "-1") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "sb3-uav train: interrupted"


@pytest.mark.slow
def test_an_interrupted_study_reports_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """rl_zoo3 would report its best trial so far, or that all of them were pruned."""
    pytest.importorskip("rl_zoo3")
    from tiny_zoo import ENV, run, write_config

    from sb3_uav.zoo import experiment

    monkeypatch.setattr(experiment, "note_worker", raise_interrupt)
    config, flags = write_config(tmp_path), ["-optimize", "--n-trials", "1", "--no-optim-plots"]
    assert run(tmp_path, config, *flags) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "sb3-uav train: interrupted"
    study = ["--storage", str(tmp_path / "study.log"), "--study-name", "small"]
    assert run(tmp_path, config, *flags, *study) == 130
    words = continuation(capsys)
    assert words[:4] == ["sb3-uav", "train", "--env", ENV] and words[-4:] == study
    assert not list(tmp_path.rglob("report_*"))


def test_the_demo_evaluates_no_unfinished_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    pytest.importorskip("matplotlib")
    from sb3_uav.cli.main import main
    from sb3_uav.studies import demo
    from sb3_uav.zoo import train

    def interrupted(_: Any) -> None:
        raise Interruption([], ["-i", "a.zip"])

    evaluated: list[Any] = []
    monkeypatch.setattr(train, "train", interrupted)
    monkeypatch.setattr(demo, "evaluate_run", lambda *args: evaluated.append(args))
    assert main(["demo", "--out", str(tmp_path), "-i", "older.zip"]) == 130
    assert continuation(capsys) == ["sb3-uav", "demo", "--out", str(tmp_path), "-i", "a.zip"] and not evaluated
    # In the evaluation of a run without checkpoints.
    monkeypatch.setattr(train, "train", lambda _: None)
    monkeypatch.setattr(demo, "newest_run", lambda *_: tmp_path)
    monkeypatch.setattr(demo, "evaluate_run", raise_interrupt)
    assert main(["demo", "--out", str(tmp_path)]) == 130
    assert continuation(capsys) == ["sb3-uav", "demo", "--out", str(tmp_path)]


def test_a_comparison_and_a_reproduction_name_their_own_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    pytest.importorskip("matplotlib")
    from sb3_uav.cli import reproduce
    from sb3_uav.cli.main import main
    from sb3_uav.studies.compare import study

    monkeypatch.setattr(study, "run_study", raise_interrupt)
    monkeypatch.setattr(reproduce, "_make_session", raise_interrupt)
    for words in (
        ["compare", "--env", "RoutePlanning-N20-v0", "--out", str(tmp_path)],
        ["reproduce", "table1", "--scale", "smoke", "--out", str(tmp_path)],
    ):
        assert main(words) == 130
        assert continuation(capsys) == ["sb3-uav", *words]


def handling(*_: Any) -> tuple[int, Any]:
    return 0, signal.getsignal(signal.SIGINT)


@pytest.mark.slow
def test_processes_of_bounds_leave_the_interruption_to_the_main_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each would print a traceback."""
    from sb3_uav.cli import bound

    monkeypatch.setattr(bound, "_bound_of", handling)
    found: list[Any] = list(bound._bounds(Path(), 2, 1.0, 2))
    assert found == [(0, signal.SIG_IGN)] * 2

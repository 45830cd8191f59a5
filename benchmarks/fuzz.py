"""
Damaged and hostile files for every reader: no traceback, bounded time and bounded memory.

    python benchmarks/fuzz.py --cases 100000 --seed 1

Each case is a valid small file, changed blindly or by its format, which one reader reads. It passes if the reader accepts it,
or raises a ValueError or an OSError whose message names the file. Cases run in worker processes with a limit of memory; one
that takes too long, grows too large or kills its process fails. Failures are printed with their numbers and kept in OUT,
made shorter; so is the state, from which an interrupted run continues. Ends with 1 after any failure.
"""

from __future__ import annotations

import argparse
import io
import json
import logging
import mmap
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch as th
from _fuzz_mutations import bytes_changed
from _fuzz_readers import Reader, all_readers

MOST_SECONDS, MOST_MEBIBYTES = 5.0, 512
# Beyond what the process has at first. Torch and numpy fail to allocate, in place of filling the machine.
_ADDRESS_SPACE = 3 * 2**30
_LONGEST_MESSAGE = 4000
_CHUNK = 500
_STUCK_SECONDS = 120.0
_STATE = "state.json"


class TooSlow(BaseException):
    """The time of a case is over; not an Exception, which readers turn into their own."""


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: Those of the command line when None
    :return: Exit code
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000, help="in all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="only readers whose name contains this")
    parser.add_argument("--out", type=Path, default=Path("fuzz"), help="folder of state and failures (default: %(default)s)")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    readers = [reader for reader in all_readers() if args.only is None or args.only in reader.name]
    args.out.mkdir(parents=True, exist_ok=True)
    key = {"seed": args.seed, "cases": args.cases, "only": args.only}
    state = _state(args.out / _STATE, key)
    total = sum(reader.weight for reader in readers)
    for reader in readers:
        figures = state["readers"].setdefault(reader.name, new_figures())
        n_cases = -(-args.cases * reader.weight // total)
        while figures["done"] < n_cases:
            run_in_process(reader, args.seed, n_cases, figures, args.out)
            (args.out / f"{_STATE}.tmp").write_text(json.dumps(state, indent=1))
            os.replace(args.out / f"{_STATE}.tmp", args.out / _STATE)
        print(table_row(reader.name, figures), flush=True)
    print(table_row("all", _sum(list(state["readers"].values()))))
    return int(any(figures["failures"] for figures in state["readers"].values()))


def _state(path: Path, key: dict[str, Any]) -> dict[str, Any]:
    if path.is_file():
        state: dict[str, Any] = json.loads(path.read_text())
        if state["key"] == key:
            return state
        print(f"{path}: of other cases, which are left out", file=sys.stderr)
    return {"key": key, "readers": {}}


def new_figures() -> dict[str, Any]:
    """:return: Figures of no cases"""
    return {
        "done": 0,
        "accepted": 0,
        "refused": 0,
        "seconds": 0.0,
        "slowest": 0.0,
        "slowest_case": 0,
        "mebibytes": 0.0,
        "failures": [],
    }


def _sum(all_figures: list[dict[str, Any]]) -> dict[str, Any]:
    found = new_figures()
    for figures in all_figures:
        for name in ("done", "accepted", "refused", "seconds", "failures"):
            found[name] = found[name] + figures[name]
        for name in ("slowest", "mebibytes"):
            found[name] = max(found[name], figures[name])
    return found


def table_row(name: str, figures: dict[str, Any]) -> str:
    """:return: A line of the table in docs/fuzzing.md"""
    return (
        f"| {name} | {figures['done']:,} | {figures['accepted']:,} | {figures['refused']:,} | {len(figures['failures'])} | "
        f"{1000 * figures['seconds'] / max(1, figures['done']):.1f} | {figures['slowest']:.2f} | {figures['mebibytes']:.0f} |"
    )


def run_in_process(reader: Reader, seed: int, n_cases: int, figures: dict[str, Any], out: Path) -> None:
    """
    Run the next cases of a reader in a process of their own.

    :param reader: What reads
    :param seed: Seed of the run
    :param n_cases: How many cases the reader has
    :param figures: Its figures, which are brought up to date
    :param out: Where failures are kept
    """
    first, last = figures["done"], min(figures["done"] + _CHUNK, n_cases)
    at, report = mmap.mmap(-1, 8), out / "chunk.json"
    report.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        code = 1
        try:
            _work(reader, seed, range(first, last), report, at, out)
            code = 0
        finally:
            os._exit(code)
    status = _waited(child, at)
    if report.is_file():
        found = json.loads(report.read_text())
    else:
        number = int.from_bytes(at, "little")
        data = case_data(reader, seed, number)
        failure = _kept(out, reader, seed, number, data, f"the process ended with {status}")
        found = {**new_figures(), "done": number + 1 - first, "refused": number - first, "failures": [failure]}
    if found["slowest"] > figures["slowest"]:
        figures["slowest_case"] = found["slowest_case"]
    figures.update({key: value for key, value in _sum([figures, found]).items() if key != "slowest_case"})


def _waited(child: int, at: mmap.mmap) -> int:
    """:return: Status of a process, which is ended if it makes no progress"""
    seen, since = b"", time.monotonic()
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status
        if at[:] != seen:
            seen, since = at[:], time.monotonic()
        if time.monotonic() - since > _STUCK_SECONDS:
            os.kill(child, signal.SIGKILL)
            return os.waitpid(child, 0)[1]
        time.sleep(0.02)


def _work(reader: Reader, seed: int, numbers: range, report: Path, at: mmap.mmap, out: Path) -> None:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _ADDRESS_SPACE, used + _ADDRESS_SPACE))
    figures = new_figures()
    before = _peak()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        for number in numbers:
            at[:] = number.to_bytes(8, "little")
            data = case_data(reader, seed, number)
            fault, seconds, accepted = run_case(reader, data, Path(folder) / "folder")
            grown = (_peak() - before) / 1024
            if fault is None and grown > MOST_MEBIBYTES:
                fault = f"memory grew by {grown:.0f} MiB"
                before = _peak()
            if fault is not None:
                shorter = minimized(reader, data, fault, Path(folder) / "folder")
                figures["failures"].append(_kept(out, reader, seed, number, shorter, fault))
            figures["accepted" if accepted else "refused"] += 1
            figures["seconds"] += seconds
            if seconds > figures["slowest"]:
                figures["slowest"], figures["slowest_case"] = seconds, number
    figures["done"], figures["mebibytes"] = len(numbers), grown
    (report.parent / "chunk.tmp").write_text(json.dumps(figures))
    os.replace(report.parent / "chunk.tmp", report)


def _peak() -> int:
    """:return: The most memory that the process has had, in KiB"""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def case_data(reader: Reader, seed: int, number: int) -> bytes:
    """
    :param reader: What reads
    :param seed: Seed of the run
    :param number: Number of the case
    :return: The file of the case, always the same
    """
    rng = random.Random(f"{seed} {reader.name} {number}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chosen = rng.choice(reader.corpus)
        try:
            return reader.change(rng, chosen, reader.corpus)
        except Exception:
            # A second change of what is no longer of its format.
            return bytes_changed(rng, chosen, reader.corpus)


def run_case(reader: Reader, data: bytes, folder: Path) -> tuple[str | None, float, bool]:
    """
    Let a reader read one file.

    :param reader: What reads
    :param data: Content of the file
    :param folder: A folder for it, which is emptied
    :return: What is wrong with how it did, None if nothing is; its CPU seconds; whether it accepted the file
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in reader.beside.items():
        (folder / name).write_bytes(content)
    (folder / reader.file).write_bytes(data)
    start = time.process_time()
    before = signal.signal(signal.SIGPROF, _stop)
    fault, accepted, output = None, False, (sys.stdout, sys.stderr)
    sys.stdout = sys.stderr = io.StringIO()
    logging.disable(logging.CRITICAL)
    try:
        signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader.read(folder / reader.file)
        accepted = True
    except (ValueError, OSError) as error:
        text, name = str(error), reader.file if reader.must_name is None else reader.must_name
        if name not in text or not text:
            fault = f"the message of {type(error).__name__} does not name {name!r}: {text:.200}"
        elif len(text) > _LONGEST_MESSAGE and name:
            fault = f"the message has {len(text)} characters"
    except TooSlow:
        accepted = reader.may_take_long
        fault = None if accepted else f"more than {MOST_SECONDS:g} s of CPU"
    except ImportError:
        # An optional package that is not here.
        pass
    except (Exception, SystemExit) as error:
        fault = f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        sys.stdout, sys.stderr = output
        logging.disable(logging.NOTSET)
    return fault, time.process_time() - start, accepted


def _stop(*_: object) -> None:
    raise TooSlow


def minimized(reader: Reader, data: bytes, fault: str, folder: Path, n_tries: int = 40) -> bytes:
    """
    :param reader: What failed
    :param data: The file of the case
    :param fault: What was wrong
    :param folder: For the tries
    :param n_tries: How many parts to leave out at most
    :return: A shorter file with which the same kind of fault is there, if one is found
    """
    if fault.startswith(("more than", "memory")):
        return data
    kind, part = fault.partition(":")[0], len(data) // 2
    place = 0
    for _ in range(n_tries):
        if part == 0:
            break
        shorter = data[:place] + data[place + part :]
        found = run_case(reader, shorter, folder)[0]
        if found is not None and found.partition(":")[0] == kind:
            data = shorter
        else:
            place += part
        if place >= len(data):
            place, part = 0, part // 2
    return data


def _kept(out: Path, reader: Reader, seed: int, number: int, data: bytes, fault: str) -> str:
    """:return: The failure in one line, after its file has been written"""
    name = "".join(char if char.isalnum() else "_" for char in reader.name)
    path = out / "failures" / f"{name}-{seed}-{number}-{reader.file}"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    line = f"{reader.name}, seed {seed}, case {number}: {' '.join(fault.split())}"
    print(f"{line} ({path})", file=sys.__stdout__, flush=True)
    return line


def short_run(
    reader: Reader, n_cases: int, folder: Path, seed: int = 1, on_case: Callable[[int], None] | None = None
) -> list[str]:
    """
    The first cases of a reader in this process, as the tests run them.

    :param reader: What reads
    :param n_cases: How many
    :param folder: A folder for files
    :param seed: Seed of the run
    :param on_case: Called with the number of each case
    :return: The failures
    """
    failures = []
    for number in range(n_cases):
        if on_case is not None:
            on_case(number)
        fault, _, _ = run_case(reader, case_data(reader, seed, number), folder / "folder")
        if fault is not None:
            failures.append(f"{reader.name}, seed {seed}, case {number}: {fault}")
    return failures


if __name__ == "__main__":
    sys.exit(main())

"""The files of an evaluation: written row by row, and read back to go on where an earlier run stopped."""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import sb3_uav
from sb3_uav.common.files import file_hash, replaced_when_complete, write_csv
from sb3_uav.envs.instances import Instances
from sb3_uav.solvers.base import Solver

if sys.platform != "win32":
    import fcntl

RESULTS_FILE = "results.csv"
SCHEDULES_FILE = "schedules.jsonl"
SETTINGS_FILE = "evaluation.json"
FORMAT = 1
OK, INFEASIBLE, FAILED = "ok", "infeasible", "failed"
# Packages whose version may change what a solver finds.
PACKAGES = ("torch", "numpy", "stable-baselines3", "scipy", "numba", "ortools", "pyvrp", "highspy", "gurobipy")


class ResultKey(NamedTuple):
    """
    What a result belongs to.

    :param solver: Name of the solver
    :param instance: Index of the instance, counted through all sets
    :param time_limit: Seconds that the solver was given; None if it had none, or ignores it
    :param seed: Seed of the solver
    """

    solver: str
    instance: int
    time_limit: float | None
    seed: int


@dataclass(frozen=True)
class ResultRow:
    """
    One line of ``results.csv``. What is not known is None, and an empty cell.

    :param solver: Name of the solver
    :param instance: Index of the instance, counted through all sets
    :param n_uavs: Number of UAVs
    :param n_tasks: Number of tasks
    :param objective: Total value of the visited tasks; None without a feasible schedule
    :param length: Total length of the tours; None without a feasible schedule
    :param seconds: Wall time of the instance: that of its batch, divided by the size of the batch
    :param feasible: Whether the checker accepted the schedule
    :param source: Name of the set of instances
    :param time_limit: Seconds that the solver was given
    :param seed: Seed of the solver
    :param batch_size: How many instances were solved at once
    :param bound: A proven upper bound of the objective
    :param status: ``ok``; ``infeasible`` if the checker refused the schedule; ``failed`` if the solver returned none
    :param message: What the checker or the solver said, in one line
    """

    solver: str
    instance: int
    n_uavs: int
    n_tasks: int
    objective: float | None
    length: float | None
    seconds: float | None
    feasible: bool
    source: str
    time_limit: float | None
    seed: int
    batch_size: int | None
    bound: float | None
    status: str
    message: str

    @property
    def key(self) -> ResultKey:
        return ResultKey(self.solver, self.instance, self.time_limit, self.seed)


RESULT_COLUMNS = tuple(field.name for field in fields(ResultRow))
WHOLE_NUMBERS = {"instance", "n_uavs", "n_tasks", "seed", "batch_size"}
NUMBERS = {"objective", "length", "seconds", "time_limit", "bound"}
OPTIONAL = {"objective", "length", "seconds", "time_limit", "batch_size", "bound"}


def one_line(text: object) -> str:
    """
    :param text: Anything that can be printed
    :return: It, without line breaks
    """
    return " ".join(str(text).split())


def describe_solver(solver: Solver) -> dict[str, Any]:
    """
    :param solver: A solver
    :return: What ``evaluation.json`` says of it
    """
    files = {purpose: {"path": str(path), "sha256": file_hash(path)} for purpose, path in solver.files.items()}
    # As it comes back from the file, where there are no tuples.
    return json.loads(json.dumps({"spec": solver.spec, "settings": solver.settings(), "files": files}))


def describe_machine() -> dict[str, Any]:
    """
    :return: Versions of what takes part in an evaluation, and on what it runs
    """
    versions = {"sb3-uav": sb3_uav.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {"versions": versions, "platform": platform.platform(), "cpu_count": os.cpu_count()}


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """
    Keep a second evaluation out of the folder, as long as the ``with`` block or the process lasts.

    :param folder: The folder, created if missing
    :raises ValueError: If another process holds it, or it cannot be created
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        results = folder / RESULTS_FILE
        raise ValueError(f"{results}: cannot be written ({error.strerror}); choose another output folder.") from error
    if sys.platform == "win32":
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{folder}: another evaluation is writing there; wait for it, or choose another folder."
            ) from None
        except OSError:
            # Some network file systems have no locks.
            pass
        yield
    finally:
        os.close(descriptor)


def read_results(path: Path) -> list[ResultRow]:
    """
    :param path: A ``results.csv``; a last line that a crash cut short is left out
    :return: Its rows
    :raises ValueError: If another program, or another version, wrote it, or it was damaged
    """
    header, *lines = _whole_lines(path) or [""]
    if header != ",".join(RESULT_COLUMNS):
        raise ValueError(
            f"{path}: its columns are not those that this version writes ({header!r:.120}); "
            "choose another folder, or start anew with --overwrite."
        )
    rows = []
    for number, line in enumerate(lines, start=2):
        try:
            rows.append(_parse_row(next(csv.reader([line], strict=True))))
        except (ValueError, csv.Error, StopIteration) as error:
            raise ValueError(
                f"{path}, line {number}: is damaged ({error}); mend or delete that line, or start anew with --overwrite."
            ) from error
    return rows


def _whole_lines(path: Path) -> list[str]:
    """
    :param path: A text file that was written line by line
    :return: Its lines, but for a last one without a line break
    :raises ValueError: If it is no text
    """
    try:
        text, end, _ = path.read_bytes().rpartition(b"\n")
        # Not splitlines, which also splits at characters that a name may hold.
        return text.decode("utf-8").split("\n") if end else []
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is damaged ({error}); start anew with --overwrite.") from error


def _parse_row(cells: Sequence[str]) -> ResultRow:
    """
    :param cells: One line of ``results.csv``
    :return: The row
    :raises ValueError: If a cell cannot be what it is said to be
    """
    if len(cells) != len(RESULT_COLUMNS):
        raise ValueError(f"{len(cells)} cells instead of {len(RESULT_COLUMNS)}")
    values: dict[str, Any] = dict(zip(RESULT_COLUMNS, cells, strict=True))
    for name in WHOLE_NUMBERS | NUMBERS:
        if values[name] == "" and name in OPTIONAL:
            values[name] = None
        else:
            values[name] = int(values[name]) if name in WHOLE_NUMBERS else float(values[name])
    if values["feasible"] not in ("True", "False") or values["status"] not in (OK, INFEASIBLE, FAILED):
        raise ValueError(f"feasible is {values['feasible']!r} and status is {values['status']!r}")
    values["feasible"] = values["feasible"] == "True"
    return ResultRow(**values)


def _read_schedules(path: Path) -> dict[ResultKey, str]:
    """
    :param path: A ``schedules.jsonl``, which may be missing
    :return: Its lines, by what they belong to
    :raises ValueError: If it was damaged
    """
    lines = _whole_lines(path) if path.is_file() else []
    schedules = {}
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            key = ResultKey(*(record[name] for name in ResultKey._fields))
            schedules[key] = line
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path}, line {number}: is damaged ({error!r}); mend or delete that line, or start anew with --overwrite."
            ) from error
    return schedules


def _abridged(setting: Any) -> str:
    """A setting of a solver for a message, where the beginning of a hash is enough."""
    is_hash = isinstance(setting, str) and re.fullmatch("[0-9a-f]{64}", setting) is not None
    return repr(setting[:8] if is_hash else setting)


class EvaluationFolder:
    """
    ``results.csv``, ``schedules.jsonl`` and ``evaluation.json`` of one folder.

    Each result is appended and flushed as soon as it is known, its schedule first, and counts as present when both lines are
    whole. When a result comes twice, the later one counts.

    :param folder: The folder; it exists
    :param sources: The sets of instances, on the CPU
    :param solvers: The solvers that are going to run
    :param run: What ``evaluation.json`` shall say of this run
    :param resume: Whether to go on with what is there, instead of starting anew
    :raises ValueError: If there are results to go on with, but of other instances, of other solvers with the same names, or of
        another format; or if the folder cannot be written
    :ivar rows: The results that are present
    :ivar changed_versions: Packages that have changed since the run before, with their versions
    """

    def __init__(
        self,
        folder: Path,
        sources: Mapping[str, Instances],
        solvers: Sequence[Solver],
        run: Mapping[str, Any],
        resume: bool,
    ) -> None:
        self.folder = folder
        self.rows: dict[ResultKey, ResultRow] = {}
        self.changed_versions: list[str] = []
        self._schedules: dict[ResultKey, str] = {}
        settings: dict[str, Any] = {
            "format": FORMAT,
            "instances": [
                {"name": name, "n_instances": len(batch), "sha256": batch.digest()} for name, batch in sources.items()
            ],
            "solvers": {solver.name: describe_solver(solver) for solver in solvers},
            "runs": [{**run, **describe_machine()}],
        }
        resume = resume and (folder / RESULTS_FILE).exists()
        if resume:
            settings = self._merged(settings)
        self._source_order = {source["name"]: position for position, source in enumerate(settings["instances"])}
        self._solver_order = {name: position for position, name in enumerate(settings["solvers"])}
        if resume:
            self._read({solver.name for solver in solvers if not solver.uses_time_limit})
        # In this order, so that old results never stand beside the settings of new ones.
        self._write_in_order()
        with replaced_when_complete(folder / SETTINGS_FILE) as file:
            json.dump(settings, file, indent=2, allow_nan=False)
            file.write("\n")
        self._results_file = open(folder / RESULTS_FILE, "a", encoding="utf-8", newline="")
        self._schedules_file = open(folder / SCHEDULES_FILE, "a", encoding="utf-8", newline="")

    def __enter__(self) -> EvaluationFolder:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self._results_file.close()
        self._schedules_file.close()
        if error is None:
            self._write_in_order()

    def add(self, row: ResultRow, schedule: Mapping[str, Any] | None) -> None:
        """
        Append a result to the files.

        :param row: The line of ``results.csv``
        :param schedule: The line of ``schedules.jsonl``, if the solver found a schedule
        """
        if schedule is not None:
            line = json.dumps({**schedule, "time_limit": row.time_limit, "seed": row.seed})
            self._schedules_file.write(line + "\n")
            self._schedules_file.flush()
            self._schedules[row.key] = line
        csv.writer(self._results_file, lineterminator="\n").writerow(asdict(row).values())
        self._results_file.flush()
        self.rows[row.key] = row

    def _write_in_order(self) -> None:
        """Write both files anew: set by set, and in a set the solvers in the order in which they first came."""

        def position(row: ResultRow) -> tuple[float, ...]:
            limit = -math.inf if row.time_limit is None else row.time_limit
            return self._source_order[row.source], self._solver_order[row.solver], row.seed, limit, row.instance

        ordered = sorted(self.rows.values(), key=position)
        with replaced_when_complete(self.folder / SCHEDULES_FILE) as file:
            file.writelines(self._schedules[row.key] + "\n" for row in ordered if row.status != FAILED)
        with replaced_when_complete(self.folder / RESULTS_FILE) as file:
            write_csv(file, RESULT_COLUMNS, (asdict(row).values() for row in ordered))

    def _merged(self, settings: dict[str, Any]) -> dict[str, Any]:
        """
        :param settings: Of the present evaluation
        :return: Also those of the earlier ones of this folder
        :raises ValueError: If they do not belong into the same folder
        """
        path = self.folder / SETTINGS_FILE
        anew = "choose another folder, or start anew with --overwrite"
        try:
            earlier = json.loads(path.read_text(encoding="utf-8"))
            if earlier["format"] != FORMAT:
                raise ValueError(f"its format is {earlier['format']!r}, expected {FORMAT}")
            sources = [{key: source[key] for key in ("name", "n_instances", "sha256")} for source in earlier["instances"]]
            solvers = {name: dict(solver["settings"]) for name, solver in earlier["solvers"].items()}
            versions = dict(earlier["runs"][-1]["versions"])
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path}: does not tell what the {RESULTS_FILE} beside it holds ({one_line(error)}); {anew}."
            ) from error
        # Instances are numbered through all sets, so that one list must be the beginning of the other.
        for before, now in zip(sources, settings["instances"], strict=False):
            if before != now:
                told = [f"{source['name']} ({source['n_instances']}, {source['sha256'][:8]})" for source in (before, now)]
                raise ValueError(
                    f"{self.folder}: holds results of other instances, {told[0]} where now comes {told[1]}; give the same "
                    f"files in the same order, {anew}."
                )
        for name, solver in settings["solvers"].items():
            was, is_now = solvers.get(name, solver["settings"]), solver["settings"]
            for key in sorted({*was, *is_now}):
                if was.get(key) != is_now.get(key):
                    raise ValueError(
                        f"{self.folder}: holds results of another {name!r}, whose {key} was {_abridged(was.get(key))} and not "
                        f"{_abridged(is_now.get(key))}; give it another name, {anew}."
                    )
        installed = settings["runs"][0]["versions"]
        self.changed_versions = [
            f"{package} {versions.get(package, 'none')} -> {installed.get(package, 'none')}"
            for package in sorted({*versions, *installed})
            if versions.get(package) != installed.get(package)
        ]
        return {
            "format": FORMAT,
            "instances": max(sources, settings["instances"], key=len),
            "solvers": {**earlier["solvers"], **settings["solvers"]},
            "runs": [*earlier["runs"], *settings["runs"]],
        }

    def _read(self, without_limit: Collection[str]) -> None:
        """
        Read what is there; results without their schedule are left out.

        :param without_limit: Names of solvers that use no time limit. Their failures at one are of a time when nobody could
            know that, and are left out: nothing would ever take their place
        :raises ValueError: If a file is damaged, or of another format
        """
        self._schedules = _read_schedules(self.folder / SCHEDULES_FILE)
        for row in read_results(self.folder / RESULTS_FILE):
            if row.source not in self._source_order or row.solver not in self._solver_order:
                raise ValueError(
                    f"{self.folder / RESULTS_FILE}: holds results of {row.solver!r} on {row.source!r}, of which "
                    f"{SETTINGS_FILE} knows nothing; choose another folder, or start anew with --overwrite."
                )
            if row.status == FAILED and row.time_limit is not None and row.solver in without_limit:
                continue
            if row.status == FAILED or row.key in self._schedules:
                self.rows[row.key] = row

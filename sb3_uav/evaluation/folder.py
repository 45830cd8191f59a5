"""The folder of an evaluation: written row by row, and read back to resume an earlier run."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from sb3_uav.common.files import remove_leftovers, replaced_when_complete
from sb3_uav.common.json_text import read_json_file
from sb3_uav.common.regular_file import open_regular
from sb3_uav.evaluation.instance_sets import InstanceSet
from sb3_uav.evaluation.provenance import describe_machine, describe_solver
from sb3_uav.evaluation.result_index import Place, ResultIndex
from sb3_uav.evaluation.result_lines import ResultLines, copy_in_order, read_index
from sb3_uav.evaluation.results import RESULT_COLUMNS, RESULTS_FILE, SCHEDULES_FILE, SETTINGS_FILE, ResultRow, one_line
from sb3_uav.evaluation.shard import Shard
from sb3_uav.solvers.base import Solver

# Of ``evaluation.json``.
FORMAT = 1
_HEADER = (",".join(RESULT_COLUMNS) + "\n").encode()


def _abridged(setting: Any) -> str:
    """A setting of a solver for a message, where the beginning of a hash is enough."""
    is_hash = isinstance(setting, str) and re.fullmatch("[0-9a-f]{64}", setting) is not None
    return repr(setting[:8] if is_hash else setting)


class EvaluationFolder:
    """
    ``results.csv``, ``schedules.jsonl`` and ``evaluation.json`` of one folder.

    Each result is appended and flushed as soon as it is known, its schedule first, and counts as present when both lines are
    whole. Of an instance on which a solver failed, a later result counts. Memory holds the place of each result and its
    figures, not its lines.

    :param folder: The folder; it exists
    :param sets: The sets of instances
    :param solvers: The solvers that are going to run
    :param run: Description of this run for ``evaluation.json``
    :param resume: Whether to keep the results that are present, instead of starting over
    :param shard: The part of the instances that this folder is for
    :raises ValueError: If there are results to resume, but of other instances, of other solvers with the same names, of
        another shard or of another format; if a result is not what the checker says of its routes; or if the folder cannot be
        written
    :ivar index: The results that are present
    :ivar changed_versions: Packages that have changed since the run before, with their versions
    """

    def __init__(
        self,
        folder: Path,
        sets: Sequence[InstanceSet],
        solvers: Sequence[Solver],
        run: Mapping[str, Any],
        resume: bool,
        shard: Shard = Shard(),  # noqa: B008 (a tuple)
    ) -> None:
        self.folder = folder
        remove_leftovers(folder)
        self.changed_versions: list[str] = []
        settings: dict[str, Any] = {
            "format": FORMAT,
            **({} if shard.is_whole else {"shard": str(shard)}),
            "instances": [one.description() for one in sets],
            "solvers": {solver.name: describe_solver(solver) for solver in solvers},
            "runs": [{**run, **describe_machine()}],
        }
        resume = resume and _holds_results(folder / RESULTS_FILE)
        if resume:
            settings = self._merged(settings)
        self._sets: list[dict[str, Any]] = settings["instances"]
        self._solvers: list[str] = list(settings["solvers"])
        self.index = ResultIndex(sum(one["n_instances"] for one in self._sets))
        if resume:
            self._read(sets, {solver.name for solver in solvers if not solver.uses_time_limit})
        # In this order, so that old results never stand beside new settings.
        self._write_in_order()
        with replaced_when_complete(folder / SETTINGS_FILE) as file:
            json.dump(settings, file, indent=2, allow_nan=False)
            file.write("\n")
        self._results_file = open(folder / RESULTS_FILE, "ab")
        self._schedules_file = open(folder / SCHEDULES_FILE, "ab")

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
        schedule_at = -1
        if schedule is not None:
            schedule_at = _append(self._schedules_file, json.dumps(schedule) + "\n")
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(row.cells)
        result_at = _append(self._results_file, line.getvalue())
        self.index.of(row.key).set(row, Place(result_at, schedule_at))

    def _write_in_order(self) -> None:
        """Rewrite both files: set by set, and within a set in the order in which the solvers first appeared."""
        copy_in_order(self.index, self._sets, self._solvers, [self.folder], self.folder)

    def _merged(self, settings: dict[str, Any]) -> dict[str, Any]:
        """
        :param settings: Settings of the present evaluation
        :return: The settings of both, the present and earlier evaluations of this folder
        :raises ValueError: If they do not belong into the same folder
        """
        path = self.folder / SETTINGS_FILE
        remedy = "choose another folder, or start over with --overwrite"
        try:
            earlier = read_json_file(path)
            # It is written again, without NaN.
            json.dumps(earlier, allow_nan=False)
            if earlier["format"] != FORMAT:
                raise ValueError(f"its format is {earlier['format']!r}, expected {FORMAT}")
            sources = [{key: source[key] for key in ("name", "n_instances", "sha256")} for source in earlier["instances"]]
            if not all(type(source["n_instances"]) is int and 0 < source["n_instances"] < 2**31 for source in sources):
                raise ValueError("n_instances is no number of instances")
            shard = earlier.get("shard")
            # None for solvers that could not be made.
            solvers = {
                name: None if solver["settings"] is None else dict(solver["settings"])
                for name, solver in earlier["solvers"].items()
            }
            versions = dict(earlier["runs"][-1]["versions"])
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path}: does not describe the {RESULTS_FILE} beside it ({one_line(error):.300}); {remedy}."
            ) from error
        if shard != settings.get("shard"):
            raise ValueError(
                f"{self.folder}: holds results of {_shard_of(shard)}, not of {_shard_of(settings.get('shard'))}; {remedy}."
            )
        # Instances are numbered through all sets, so that one list must be the beginning of the other.
        for before, now in zip(sources, settings["instances"], strict=False):
            if before != now:
                pair = [
                    f"{source['name']!s:.80} ({source['n_instances']}, {str(source['sha256'])[:8]})"
                    for source in (before, now)
                ]
                raise ValueError(
                    f"{self.folder}: holds results of other instances: {pair[0]}, not {pair[1]}; give the same "
                    f"files in the same order, {remedy}."
                )
        for name, solver in settings["solvers"].items():
            was, is_now = solvers.get(name), solver["settings"]
            if was is None or is_now is None:
                continue
            for key in sorted({*was, *is_now}):
                if was.get(key) != is_now.get(key):
                    raise ValueError(
                        f"{self.folder}: holds results of another {name!r}, whose {key} was {_abridged(was.get(key))} and not "
                        f"{_abridged(is_now.get(key))}; give it another name, {remedy}."
                    )
        # A solver that cannot be made now keeps its earlier description.
        described = {
            name: solver
            for name, solver in settings["solvers"].items()
            if solver["settings"] is not None or name not in earlier["solvers"]
        }
        installed = settings["runs"][0]["versions"]
        self.changed_versions = [
            f"{package} {versions.get(package, 'none')} -> {installed.get(package, 'none')}"
            for package in sorted({*versions, *installed})
            if versions.get(package) != installed.get(package)
        ]
        return {
            "format": FORMAT,
            **({} if shard is None else {"shard": shard}),
            "instances": max(sources, settings["instances"], key=len),
            "solvers": {**earlier["solvers"], **described},
            "runs": [*earlier["runs"], *settings["runs"]],
        }

    def _read(self, sets: Sequence[InstanceSet], without_limit: Collection[str]) -> None:
        """
        Read the results that are present, and check those of the given instances again; those without their schedule are
        left out.

        :param sets: The sets of instances at hand
        :param without_limit: Names of solvers that use no time limit. Their failures at a time limit date from runs in which
            that was unknown; they are left out, because no later result would replace them
        :raises ValueError: If a file is damaged or was changed, or is of another format
        """
        self.index = read_index(self.folder, self._sets, self._solvers, without_limit)
        with ResultLines(self.folder) as lines:
            for one in sets:
                for first, size in one.places():
                    start = one.first_index + first
                    if any(run.present[start : start + size].any() for run in self.index.runs.values()):
                        lines.check_again(self.index, one.part_at(first), start)


def _holds_results(path: Path) -> bool:
    """Whether there is a file that is not only a header of ours: all there is where a run was killed in its first instants."""
    try:
        with open_regular(path) as file:
            return file.read(len(_HEADER) + 1) != _HEADER
    except FileNotFoundError:
        return False


def _append(file: IO[bytes], text: str) -> int:
    """:return: Where the text begins in the file, which has it when this returns"""
    place = file.tell()
    file.write(text.encode())
    file.flush()
    return place


def _shard_of(shard: object) -> str:
    """:return: The shard of a folder, for messages"""
    return "all instances" if shard is None else f"shard {shard}"

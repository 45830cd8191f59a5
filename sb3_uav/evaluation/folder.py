"""The folder of an evaluation: written row by row, and read back to resume an earlier run."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sb3_uav.common.files import replaced_when_complete, write_csv
from sb3_uav.common.json_text import parse_json
from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.provenance import describe_machine, describe_solver
from sb3_uav.evaluation.results import (
    FAILED,
    RESULT_COLUMNS,
    RESULTS_FILE,
    SCHEDULES_FILE,
    SETTINGS_FILE,
    ResultKey,
    ResultRow,
    one_line,
    read_results,
    read_schedules,
)
from sb3_uav.solvers.base import Solver

# Of ``evaluation.json``.
FORMAT = 1


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
    :param run: Description of this run for ``evaluation.json``
    :param resume: Whether to keep the results that are present, instead of starting over
    :raises ValueError: If there are results to resume, but of other instances, of other solvers with the same names, or of
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
        # In this order, so that old results never stand beside new settings.
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
        """Rewrite both files: set by set, and within a set in the order in which the solvers first appeared."""

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
        :param settings: Settings of the present evaluation
        :return: The settings of both, the present and earlier evaluations of this folder
        :raises ValueError: If they do not belong into the same folder
        """
        path = self.folder / SETTINGS_FILE
        remedy = "choose another folder, or start over with --overwrite"
        try:
            earlier = parse_json(path.read_text(encoding="utf-8"))
            # It is written again, without NaN.
            json.dumps(earlier, allow_nan=False)
            if earlier["format"] != FORMAT:
                raise ValueError(f"its format is {earlier['format']!r}, expected {FORMAT}")
            sources = [{key: source[key] for key in ("name", "n_instances", "sha256")} for source in earlier["instances"]]
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
        # Instances are numbered through all sets, so that one list must be the beginning of the other.
        for before, now in zip(sources, settings["instances"], strict=False):
            if before != now:
                pair = [f"{source['name']} ({source['n_instances']}, {str(source['sha256'])[:8]})" for source in (before, now)]
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
            "instances": max(sources, settings["instances"], key=len),
            "solvers": {**earlier["solvers"], **described},
            "runs": [*earlier["runs"], *settings["runs"]],
        }

    def _read(self, without_limit: Collection[str]) -> None:
        """
        Read the results that are present; those without their schedule are left out.

        :param without_limit: Names of solvers that use no time limit. Their failures at a time limit date from runs in which
            that was unknown; they are left out, because no later result would replace them
        :raises ValueError: If a file is damaged, or of another format
        """
        self._schedules = read_schedules(self.folder / SCHEDULES_FILE)
        for row in read_results(self.folder / RESULTS_FILE):
            if row.source not in self._source_order or row.solver not in self._solver_order:
                raise ValueError(
                    f"{self.folder / RESULTS_FILE}: holds results of {row.solver!r:.80} on {row.source!r:.80}, of which "
                    f"{SETTINGS_FILE} holds no description; choose another folder, or start over with --overwrite."
                )
            if row.status == FAILED and row.time_limit is not None and row.solver in without_limit:
                continue
            if row.status == FAILED or row.key in self._schedules:
                self.rows[row.key] = row

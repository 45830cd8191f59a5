"""Joining the folders of the shards of an evaluation."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.files import replaced_when_complete
from sb3_uav.common.json_text import read_json_file
from sb3_uav.evaluation.folder import FORMAT
from sb3_uav.evaluation.locking import locked_folder
from sb3_uav.evaluation.result_index import Figures, ResultIndex
from sb3_uav.evaluation.result_lines import copy_in_order, read_index
from sb3_uav.evaluation.results import RESULTS_FILE, SETTINGS_FILE, one_line
from sb3_uav.evaluation.summary import SUMMARY_CSV, SUMMARY_JSON, SummaryRow, summarize, write_summary

# Of a run, what has to be the same in all shards.
_SAME_IN_RUNS = ("solvers", "reference", "seed", "time_limits", "benchmark")


class _Part(NamedTuple):
    """
    The folder of a shard.

    :param folder: The folder
    :param settings: Its ``evaluation.json``
    """

    folder: Path
    settings: dict[str, Any]

    @property
    def last_run(self) -> dict[str, Any]:
        run: dict[str, Any] = self.settings["runs"][-1]
        return run

    def described(self) -> dict[str, Any]:
        """:return: Everything in which shards have to agree, by what a message calls it"""
        said: dict[str, Any] = {"number of sets of instances": len(self.settings["instances"])}
        for number, source in enumerate(self.settings["instances"]):
            said |= {f"{key} of set {number} of the instances": source[key] for key in ("name", "n_instances", "sha256")}
        said |= {key: self.last_run.get(key) for key in _SAME_IN_RUNS}
        said["names of the solvers"] = list(self.settings["solvers"])
        for name, solver in self.settings["solvers"].items():
            for key, value in (solver["settings"] or {}).items():
                said[f"{key} of solver {name!r}"] = value
            # Paths differ from machine to machine.
            for purpose, file in solver["files"].items():
                said[f"sha256 of the {purpose} of solver {name!r}"] = file["sha256"]
        for run in self.settings["runs"]:
            for package, version in run["versions"].items():
                key = f"version of {package}"
                said[key] = version if said.get(key, version) == version else f"{said[key]} and {version}"
        return said


def _read(folder: Path) -> _Part:
    """
    :param folder: Folder of a shard
    :return: The folder with its settings
    :raises FileNotFoundError: If it is not the folder of an evaluation
    :raises ValueError: If its settings are damaged
    """
    path = folder / SETTINGS_FILE
    if not path.is_file() or not (folder / RESULTS_FILE).is_file():
        raise FileNotFoundError(f"{folder}: holds no {RESULTS_FILE} with {SETTINGS_FILE}; give the folders of the shards.")
    try:
        settings = read_json_file(path)
        if settings["format"] != FORMAT:
            raise ValueError(f"its format is {settings['format']!r}, expected {FORMAT}")
        part = _Part(folder, settings)
        part.described()
        if not all(type(one["n_instances"]) is int and 0 < one["n_instances"] < 2**31 for one in settings["instances"]):
            raise ValueError("n_instances is no number of instances")
        if not settings["instances"] or not set(part.last_run["solvers"]) <= set(settings["solvers"]):
            raise ValueError("it describes no run")
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: does not describe an evaluation ({one_line(error)}); run that shard again with --overwrite."
        ) from error
    return part


def merge(folders: Sequence[Path], out_dir: str | os.PathLike[str], overwrite: bool = False) -> list[SummaryRow]:
    """
    Join the folders of all shards of an evaluation into one, as an evaluation without shards writes it.

    Memory holds some 50 bytes for each result. The schedules are not checked again: running the same evaluation with the new
    folder does that, and solves nothing.

    :param folders: Folders that :func:`~sb3_uav.evaluation.run.evaluate` wrote for the shards, in any order
    :param out_dir: Folder of the result, created if missing
    :param overwrite: Whether to replace an evaluation in it; what an earlier merge wrote is always replaced
    :return: The summary of the last run
    :raises FileNotFoundError: If a folder holds no evaluation
    :raises ValueError: If a folder is damaged, they differ in instances, solvers, settings or versions, two hold the same
        result, results are missing, or the folder cannot be written
    """
    out = Path(out_dir)
    if not folders:
        raise ValueError("There is nothing to merge; give the folders of the shards.")
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise ValueError(f"{out}: is one of the folders to merge; give another --out.")
    parts = [_read(folder) for folder in folders]
    for part in parts[1:]:
        _check_alike(parts[0], part)
    settings = parts[0].settings
    index = _joined(parts)
    _check_complete(index, parts)
    runs = [run for part in parts for run in part.settings["runs"]]
    shards = [part.settings.get("shard", "1/1") for part in parts]
    with locked_folder(out):
        _check_replaceable(out, overwrite)
        for name in (SUMMARY_CSV, SUMMARY_JSON):
            (out / name).unlink(missing_ok=True)
        copy_in_order(index, settings["instances"], list(settings["solvers"]), [part.folder for part in parts], out)
        with replaced_when_complete(out / SETTINGS_FILE) as file:
            whole = {key: value for key, value in settings.items() if key not in ("shard", "runs")}
            json.dump({**whole, "runs": runs, "merged": shards}, file, indent=2, allow_nan=False)
            file.write("\n")
        summary = _summary(index, settings)
        last = parts[0].last_run
        write_summary(summary, out, {"reference": last["reference"], "seed": last["seed"]})
    return summary


def benchmark_of(folder: Path) -> dict[str, Any] | None:
    """
    :param folder: Folder of an evaluation
    :return: What its last run says of the benchmark, if it was one
    :raises FileNotFoundError: If it is not the folder of an evaluation
    :raises ValueError: If its settings are damaged
    """
    found = _read(folder).last_run.get("benchmark")
    return dict(found) if isinstance(found, Mapping) else None


def _check_replaceable(out: Path, overwrite: bool) -> None:
    """
    :raises ValueError: If the folder holds an evaluation that no merge has written
    """
    if overwrite or not (out / RESULTS_FILE).exists():
        return
    try:
        is_merged = "merged" in read_json_file(out / SETTINGS_FILE)
    except (OSError, ValueError, TypeError):
        is_merged = False
    if not is_merged:
        raise ValueError(f"{out}: holds results of an evaluation; choose another --out, or replace them with --overwrite.")


def _check_alike(first: _Part, other: _Part) -> None:
    """
    :raises ValueError: If two shards are of different evaluations; the message names the difference
    """
    said, heard = first.described(), other.described()
    for key in {**said, **heard}:
        if said.get(key) != heard.get(key):
            raise ValueError(
                f"{other.folder}: is of another evaluation than {first.folder}: {key} is {heard.get(key)!r} and not "
                f"{said.get(key)!r}; merge shards of one evaluation only, run by the same versions."
            )


def _joined(parts: Sequence[_Part]) -> ResultIndex:
    """
    :param parts: The shards
    :return: The results of all
    :raises ValueError: If one is damaged, or two hold the same result
    """
    sets, solvers = parts[0].settings["instances"], parts[0].settings["solvers"]
    joined = ResultIndex(sum(one["n_instances"] for one in sets))
    for number, part in enumerate(parts):
        for (solver, limit, seed), run in read_index(part.folder, sets, solvers).runs.items():
            whole = joined.run(solver, limit, seed)
            both = np.nonzero(whole.present & run.present)[0]
            if len(both) > 0:
                other = parts[int(whole.folder[both[0]])].folder
                raise ValueError(
                    f"{part.folder}: overlaps with {other}: both hold {len(both)} results of {solver!r} with seed {seed}, the "
                    f"first on instance {both[0]}; give each shard once, all with the same number of shards."
                )
            run.folder[:] = number
            whole.add(run)
    return joined


def _check_complete(index: ResultIndex, parts: Sequence[_Part]) -> None:
    """
    :raises ValueError: If results are missing
    """
    settings, last = parts[0].settings, parts[0].last_run
    needed = {
        (solver, limit, last["seed"]): _figures(index, solver, limit, last["seed"])
        for solver in last["solvers"]
        for limit in last["time_limits"]
    }
    starts = list(accumulate((one["n_instances"] for one in settings["instances"]), initial=0))
    given = {part.settings.get("shard", "1/1") for part in parts}
    counts = {shard.partition("/")[2] for shard in given}
    # Where the shards are of one evaluation, they can be named.
    lost = [f"{i}/{n}" for n in counts for i in range(1, int(n) + 1) if f"{i}/{n}" not in given] if len(counts) == 1 else []
    hint = f"shard {', '.join(lost[:5])} is missing" if lost else "run the commands of the shards again, and give all folders"
    for (solver, limit, seed), run in {**index.runs, **needed}.items():
        for first, one in zip(starts, settings["instances"], strict=False):
            absent = ~run.present[first : first + one["n_instances"]]
            # Earlier runs may have left sets out.
            if absent.any() and (not absent.all() or (solver, limit, seed) in needed):
                name, at = one["name"], "" if limit is None else f" at {limit:g} s"
                raise ValueError(
                    f"the shards hold no result of {solver!r}{at} with seed {seed} on {int(absent.sum())} of {len(absent)} "
                    f"instances of {name!r}, the first is instance {int(absent.argmax())}; {hint}."
                )


def _figures(index: ResultIndex, solver: str, limit: float | None, seed: int) -> Figures:
    """:return: Results of a solver at a time limit; those without one if it uses none"""
    key = (solver, limit, seed)
    found = index.runs.get(key) or index.runs.get((solver, None, seed))
    return index.run(*key) if found is None else found


def _summary(index: ResultIndex, settings: Mapping[str, Any]) -> list[SummaryRow]:
    """
    :param index: The results
    :param settings: The ``evaluation.json`` of a shard
    :return: The summary of its last run
    """
    last = settings["runs"][-1]
    summary: list[SummaryRow] = []
    first = 0
    for one in settings["instances"]:
        rows = np.arange(one["n_instances"])
        for limit in last["time_limits"]:
            results = {
                solver: _figures(index, solver, limit, last["seed"]).selected(first + rows) for solver in last["solvers"]
            }
            summary += summarize(one["name"], rows, results, last["reference"], limit)
        first += len(rows)
    return summary

"""All files of a mission in one folder, which is complete or untouched."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from sb3_uav.common.files import file_hash
from sb3_uav.common.json_text import read_json_file
from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.plan_file import PLAN_FILE, save_plan
from sb3_uav.missions.remarks import remarks_on
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.writers.summary import FORMAT, SUMMARY_FILE, write_summary

# Folders that only an interrupted run leaves behind.
_TEMPORARY = ".sb3-uav-"


def write_mission(plan: Plan, folder: str | Path, flight: FlightOptions | None = None, overwrite: bool = False) -> list[Path]:
    """
    Check the plan once more and write everything that is made of it: ``mission.json``, ``routes.csv``, ``routes.geojson``,
    ``map.png``, ``map.html``, ``summary.json``, and for latitudes and longitudes ``routes.kml``, a ``.plan`` and a
    ``.waypoints`` per UAV.

    The files of an earlier mission are replaced all at once, those of its UAVs included; other files are left alone.

    :param plan: The plan
    :param folder: The folder, made if missing
    :param flight: How it is flown; the defaults when None
    :param overwrite: Also replace files of an earlier mission that somebody has changed since
    :return: The files, the summary last
    :raises InfeasibleScheduleError: If the plan breaks a constraint
    :raises ValueError: If the folder holds files that are not of an earlier mission
    :raises OSError: If a file cannot be written; the folder is as before then
    :raises ImportError: If a package is missing
    """
    folder, flight = Path(folder), FlightOptions() if flight is None else flight
    plan = checked(plan, flight)
    former = check_folder(folder, overwrite)
    with _temporary_folder(folder) as made:
        names = [path.name for path in _write_files(plan, made, flight)]
        hashes = {name: file_hash(made / name) for name in names}
        write_summary(plan, made / SUMMARY_FILE, flight, hashes)
        names.append(SUMMARY_FILE)
        foreign = [name for name in names if name not in former and (folder / name).exists()]
        if foreign:
            raise ValueError(f"{folder / foreign[0]}: this file is not of an earlier mission; choose another folder.")
        if folder.exists():
            _replace(folder, made, former, names)
        else:
            made.rename(folder)
    return [folder / name for name in names]


def checked(plan: Plan, flight: FlightOptions) -> Plan:
    """
    :param plan: A plan, of whatever origin
    :param flight: How it is flown
    :return: The same plan, checked and measured anew, with remarks on how it is flown too
    :raises InfeasibleScheduleError: If it breaks a constraint
    """
    schedule = Schedule([route.stops for route in plan.routes])
    again = make_plan(plan.tasks, plan.fleet, schedule, plan.solver, plan.seed, plan.seconds)
    kept = ("bound", "time_limit", "past_tasks", "past_uavs", "notes")
    again = replace(again, **{name: getattr(plan, name) for name in kept})
    return replace(again, remarks=remarks_on(again, flight))


def check_folder(folder: Path, overwrite: bool = False) -> list[str]:
    """
    :param folder: Where a mission is to be written
    :param overwrite: Whether files that were changed may be replaced
    :return: Names of the files of the earlier mission that is there
    :raises ValueError: If it is no folder, or holds files but no mission, or a mission that was changed
    """
    if not folder.exists():
        return []
    if not folder.is_dir():
        raise ValueError(f"{folder}: this is a file; choose a folder for the mission.")
    there = {path.name for path in folder.iterdir() if not path.name.startswith(_TEMPORARY)}
    if not there:
        return []
    hashes = _files_of(folder / SUMMARY_FILE)
    if hashes is None:
        example = min(there)
        raise ValueError(f"{folder}: this folder holds other files, such as {example}; choose a new one for the mission.")
    present = [name for name in hashes if (folder / name).is_file()]
    if not overwrite:
        for name in present:
            if file_hash(folder / name) != hashes[name]:
                raise ValueError(
                    f"{folder / name}: it was changed since the mission was written; --overwrite replaces it all the same."
                )
    return [*present, SUMMARY_FILE]


def _files_of(summary: Path) -> dict[str, str] | None:
    """
    :param summary: Possibly the summary of an earlier mission
    :return: Digests of its files by their names; None if it is no such summary
    """
    try:
        data = read_json_file(summary)
    except (OSError, ValueError, RecursionError):
        return None
    files = data.get("files") if isinstance(data, dict) and data.get("format") == FORMAT else None
    if not isinstance(files, dict):
        return None
    # Of a changed summary, nothing outside the folder.
    return {name: str(digest) for name, digest in files.items() if Path(name).name == name}


def _write_files(plan: Plan, folder: Path, flight: FlightOptions) -> list[Path]:
    # Imported here, because each needs packages of its own.
    from sb3_uav.missions.writers.geojson_routes import write_routes_geojson
    from sb3_uav.missions.writers.map_html import write_map_html
    from sb3_uav.missions.writers.map_png import write_map_png
    from sb3_uav.missions.writers.routes_csv import write_routes_csv

    save_plan(plan, folder / PLAN_FILE)
    write_routes_csv(plan, folder / "routes.csv")
    write_routes_geojson(plan, folder / "routes.geojson")
    write_map_png(plan, folder / "map.png")
    write_map_html(plan, folder / "map.html")
    files = [folder / name for name in (PLAN_FILE, "routes.csv", "routes.geojson", "map.png", "map.html")]
    if plan.tasks.system != "wgs84":
        return files
    from sb3_uav.missions.writers.kml import write_kml
    from sb3_uav.missions.writers.qgc_plan import write_plan_files
    from sb3_uav.missions.writers.wpl import write_wpl_files

    write_kml(plan, folder / "routes.kml", flight)
    files.append(folder / "routes.kml")
    return [*files, *write_plan_files(plan, folder, flight), *write_wpl_files(plan, folder, flight)]


@contextmanager
def _temporary_folder(folder: Path) -> Iterator[Path]:
    """:return: A new folder on the same disk, removed at the end if it is still there"""
    parent = folder if folder.is_dir() else folder.parent
    made = parent / f"{_TEMPORARY}{uuid.uuid4().hex}"
    made.mkdir(parents=True)
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _replace(folder: Path, made: Path, former: list[str], names: list[str]) -> None:
    """
    Put new files in the place of former ones, and the former ones back if that fails halfway. The folder itself stays, because
    it may be the current one of a shell. The summary goes first and comes last: with it, a mission is complete.

    :param folder: The folder
    :param made: Holds the new files; a folder in it
    :param former: Names of the files to remove
    :param names: Names of the new files
    """
    old = made / "old"
    old.mkdir()
    moved: list[tuple[Path, Path]] = []
    try:
        for name in reversed(former):
            moved.append((folder / name, old / name))
            (folder / name).rename(old / name)
        for name in names:
            moved.append((made / name, folder / name))
            (made / name).rename(folder / name)
    except BaseException:
        for source, target in reversed(moved):
            if target.exists():
                target.rename(source)
        raise

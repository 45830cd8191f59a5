"""``sb3-uav replan``: a mission planned again while its UAVs are in the air."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_uav.cli.solve import add_flight_options, flight_of
from sb3_uav.common.interruption import continued_by
from sb3_uav.common.json_text import read_json_file
from sb3_uav.common.optional import require
from sb3_uav.missions.flight import FlightOptions

if TYPE_CHECKING:
    from sb3_uav.missions.replan import Replanned

_EPILOG = """\
STATUS.csv, for example (x and y in place of lat and lon for a plane):
  what,id,lat,lon,remaining_m,value,service_s,must
  uav,uav-1,47.3812,8.5412,5200,,,       where a UAV is, and how far it still flies, reserve included
  lost,uav-3                             a UAV that flies no more; its tasks are free again
  done,t17                               a task that is done
  drop,t40                               a task that nobody wants any more
  task,new-1,47.3811,8.5523,,5,20,yes    a new task
  remaining_percent (of the whole range) or remaining_min may stand in place of remaining_m. Without lat and lon, or without a
  row, a UAV is where its route begins.

The rest of every route keeps its order. Stops that the range no longer admits are left out, and free and new tasks are put
between the others. Routes change further only if that serves more tasks that must be served, or adds --min-gain to the
value. The reserve of a UAV stays the same in meters.

A replan starts from the newest plan: for the next one, name the folder that this one has written. A status file may grow
during a mission; what an earlier replan has taken in does no harm. OUT is never changed.

exit code:
  0    a plan that serves something, and all tasks that must be served
  1    the plan is empty, or a task that must be served is not; the files are written all the same
  2    the input was wrong, or nothing is left to plan, and nothing was written
  130  interrupted by Ctrl-C; nothing was written
"""


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav replan",
        description="Plan a mission again: UAVs in the air, tasks done, UAVs lost, new tasks. What need not change stays.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mission", type=Path, metavar="OUT", help="folder of a mission, or its mission.json")
    parser.add_argument("--status", type=Path, required=True, metavar="STATUS.csv", help="what has happened; see below")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="NEW", help="folder of the new mission (default: OUT-replanned, a new one)"
    )
    parser.add_argument("--overwrite", action="store_true", help="also replace files of an earlier mission that were changed")
    parser.add_argument(
        "--time-limit", type=float, default=0.5, metavar="SECONDS", help="of the search (default: %(default)g)"
    )
    parser.add_argument(
        "--min-gain",
        type=float,
        # Pilots in the air are not given new routes for a task of many.
        default=5.0,
        metavar="PERCENT",
        help="value that changing routes further has to add; 0 for the most value (default: %(default)g)",
    )
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    add_flight_options(parser)
    return parser


def _former_flight(folder: Path) -> dict[str, Any]:
    """
    :param folder: Folder of a mission
    :return: How it is flown, as its summary says; nothing without a summary that says it
    """
    from sb3_uav.missions.writers.summary import SUMMARY_FILE

    try:
        flight = read_json_file(folder / SUMMARY_FILE)["flight"]
        known = {field.name: flight[field.name] for field in fields(FlightOptions)}
        FlightOptions(**known)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return known


def _new_folder(folder: Path) -> Path:
    """
    :param folder: Folder of a mission
    :return: One beside it that does not exist: ``OUT-replanned``, ``OUT-replanned-2``, ...
    """
    stem = re.sub(r"-replanned(-\d+)?$", "", folder.resolve().name)
    number = 1
    while True:
        new = folder.resolve().with_name(f"{stem}-replanned{'' if number == 1 else f'-{number}'}")
        if not new.exists():
            # As the user writes it: relative to the current folder, if the mission is.
            return folder.with_name(new.name) if folder.name not in ("", "..") else new
        number += 1


def main(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments
    :return: Exit code, see :data:`_EPILOG`
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package is missing
    """
    parser = _make_parser()
    args = parser.parse_args(argv)
    from sb3_uav.missions.plan_file import PLAN_FILE, load_plan

    folder = args.mission if args.mission.is_dir() else args.mission.parent
    parser.set_defaults(**_former_flight(folder))
    args = parser.parse_args(argv)
    flight = flight_of(args)
    new_folder = _new_folder(folder) if args.out is None else args.out
    if new_folder.resolve() == folder.resolve():
        raise ValueError(f"{new_folder}: a replan does not change the mission that it starts from; choose another folder.")
    from sb3_uav.cli.mission_report import exit_code, print_plan
    from sb3_uav.evaluation.table import require_rich
    from sb3_uav.missions.readers.status_csv import read_status
    from sb3_uav.missions.replan import replan
    from sb3_uav.missions.write import check_folder, checked, write_mission

    require_rich()
    for package in ("matplotlib", "plotly"):
        require(package, "The map of a mission", "missions")
    require("numba", "Replanning", "missions")
    path = folder / PLAN_FILE if args.mission.is_dir() else args.mission
    if not path.is_file() or path.suffix.lower() != ".json":
        raise ValueError(
            f"{args.mission}: this is no mission; name the folder that sb3-uav solve has written, with {PLAN_FILE}."
        )
    if not args.status.is_file():
        raise ValueError(f"{args.status}: there is no such file; --status names a CSV that says what has happened.")
    check_folder(new_folder, args.overwrite)
    plan = load_plan(path)
    status = read_status(args.status)
    from sb3_uav.local_search.search import warm_up

    # Not at the cost of the time limit.
    warm_up()
    with continued_by(["sb3-uav", "replan", *argv]):
        found = replan(plan, status, args.time_limit, args.seed, args.min_gain)
    files = write_mission(found.plan, new_folder, flight, args.overwrite)
    _print_changes(found)
    print_plan(checked(found.plan, flight), files)
    return exit_code(found.plan)


def _print_changes(found: Replanned) -> None:
    """Print what is new, before the plan itself."""
    from sb3_uav.evaluation.table import require_rich
    from sb3_uav.missions.labels import count, shown
    from sb3_uav.missions.remarks import named

    rich = require_rich()
    console = rich.console.Console(highlight=False)
    plan = found.plan
    ids = plan.tasks.ids
    served = {ids[task] for route in plan.routes for task in route.stops}
    # The remarks of the plan say how many legs are kept.
    lines = [] if plan.notes else [f"Nothing has changed: all of {count(found.n_remaining, 'leg')} left to fly are kept."]
    if found.unchanged:
        lines.append(f"Routes that stay as they are: {named(list(map(shown, found.unchanged)))}.")
    for what, names in (("Done or dropped", found.gone), ("Lost", found.lost)):
        if names:
            lines.append(f"{what}: {named(list(map(shown, names)))}.")
    for what, names in (("New tasks", found.added), ("Tasks of lost UAVs", found.freed)):
        if names:
            left_out = [shown(name) for name in names if name not in served]
            more = f", not {named(left_out)}" if left_out else ""
            lines.append(f"{what}: {len(names) - len(left_out)} of {len(names)} served{more}.")
    others = [shown(name) for name in found.removed if name not in found.freed]
    if others:
        lines.append(f"No longer served: {named(others)}.")
    for line in lines:
        console.print(rich.text.Text(line, overflow="fold"))
